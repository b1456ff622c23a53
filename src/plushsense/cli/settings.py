"""Options that several verbs share, the settings they resolve to, and the progress displays of long work."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.jobs.progress import JobProgress
    from plushsense.workflow.config import RunConfig


def listed(*values: str) -> list[str]:
    """Split the values of an option given with commas or several times: ``A,B``."""
    return [word.strip() for value in values for word in value.split(",") if word.strip()]


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add the options of network, training and windows; their defaults are those of the preset or of --config."""
    add = parser.add_argument
    add("--arch", metavar="SPEC", help="architecture: kernel lengths in samples, dilations after d (14d1_19d2_19d4)")
    add("--filters", metavar="N,N,...", help="filters of each layer (8,12,16)")
    add("--padding", help="stream, causal or mirror (default: the preset's; paper mirror, others stream)")
    add("--norm", help="normalisation: batch (default) or layer")
    add(
        "--preset",
        help="training schedule: people (default, 60 epochs), loso or paper (at most 150, stop early), search (250)",
    )
    add(
        "--context",
        help="what the window of a short gesture holds before it: stream, the recorded past; loop, the gesture "
        "repeated; anywhere, windows from all of the stream with idleness as a class, for live use, scored as stream "
        "(default: the preset's; people and loso stream, paper and search loop)",
    )
    add("--pool-s", type=float, metavar="S", help="seconds that a decision averages (default: 2.5 s in all)")
    add(
        "--classes",
        metavar="LABELS",
        help="shared (default: gestures that 90 %% of the people made, without free choice), all, or labels joined by "
        "commas",
    )
    add("--epochs", type=int, metavar="N", help="maximum number of epochs (default: the preset's)")
    add("--batch", type=int, metavar="N", help="windows in a batch (64)")
    add("--seed", type=int, metavar="N", help="seed of the split and of the training (0)")
    add("--device", choices=("auto", "cpu", "cuda"), help="where to train (default auto: cuda if available)")
    add(
        "--config",
        metavar="FILE",
        help="TOML file with the tables windows, model, training, evaluation, live; other options override it",
    )


def add_workers(parser: argparse.ArgumentParser, jobs: str) -> None:
    """Add the option for the number of processes; ``jobs`` names what runs in parallel: "folds", "trainings"."""
    parser.add_argument("--workers", type=int, metavar="N", help=f"{jobs} in parallel (default 0: one per processor)")


def add_work(parser: argparse.ArgumentParser, jobs: str) -> None:
    """Add the options of parallel work on this machine or a cluster."""
    add_workers(parser, jobs)
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="run on a Ray cluster: auto, local, HOST:PORT or ray://HOST:10001 (default: on this machine)",
    )


def add_out(parser: argparse.ArgumentParser, files: str, default: str, replaced: str) -> None:
    """Add ``--out``, a folder for ``files``, and ``--force``, which replaces what ``replaced`` names."""
    parser.add_argument("--out", metavar="DIR", help=f"folder for {files} (default: {default})")
    parser.add_argument("--force", action="store_true", help=f"replace {replaced} in --out")


# Options that change a key of a grid: its metavar and help.
_GRID_OPTIONS: dict[str, tuple[str | None, str]] = {
    "architectures": ("SPEC,...", "only these networks"),
    "filters": ("SETS", "only these filters: 4,6,8,8 or several sets, 4/6/8/8,8/12/16/16"),
    "batches": ("N,...", "only these batches: numbers of windows, or full"),
    "padding": (None, "stream, causal or mirror"),
    "norm": (None, "batch or layer"),
    "context": (None, "stream or loop"),
    "classes": ("LABELS", "all, shared, or labels joined by commas"),
    "device": (None, "auto, cpu or cuda"),
}


def add_grid(parser: argparse.ArgumentParser, defaults: Mapping[str, str]) -> None:
    """Add the options that change a grid; ``defaults`` says what applies without an option, else it is the grid's."""
    add = parser.add_argument
    for key, (metavar, words) in _GRID_OPTIONS.items():
        default = defaults.get(key, "the grid's")
        add(f"--{key}", metavar=metavar, help=f"{words} (default: {default})")
    default = defaults.get("seeds", "the grid's")
    add("--seeds", type=int, metavar="N", help=f"seeds 0 to N - 1 (default: {default})")
    add("--threads", type=int, metavar="N", help="threads of a training, part of its identity (1)")


def grid_changes(args: argparse.Namespace, *more: str) -> dict[str, Any]:
    """Return the keys of a grid that options change, and the options ``more`` of the verb."""
    # An empty tuple is reported with the other problems of the grid.
    return options(args, *_GRID_OPTIONS, "threads", *more) | {
        "seeds": None if args.seeds is None else tuple(range(args.seeds))
    }


def work_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options of `add_out` and `add_work` as a sweep and a search take them."""
    return {"overwrite": args.force, "workers": args.workers or 0} | options(args, "out", "cluster")


def options(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of some options by name, for a library function that has parameters of these names."""
    return {name: getattr(args, name) for name in names}


def marks(result: Mapping[str, Any]) -> list[str]:
    """Return the notices to print above scores: simulation, leaky split."""
    notices = []
    if result["simulated"]:
        notices.append("SIMULATION: these scores are of the virtual toy and say nothing about a real one.")
    if result["leaky"]:
        notices.append("LEAKY: windows of one recording are on both sides of this split; the scores are too high.")
    return notices


def settings(args: argparse.Namespace, **evaluation: Any) -> RunConfig:
    """Resolve the settings of a command."""
    from plushsense.workflow.config import resolve

    return resolve(
        args.config,
        windows=options(args, "context"),
        model=options(args, "arch", "filters", "padding", "norm", "pool_s"),
        training=options(args, "preset", "epochs", "batch", "seed", "device"),
        evaluation={"classes": args.classes, "seed": args.seed, **evaluation},
    )


def report_epochs(title: str = "training") -> Callable[[int, int, dict[str, Any]], None]:
    """Return a callback that reports the epochs of one training."""
    reporters: dict[str, ProgressReporter] = {}

    def report(epoch: int, epochs: int, row: dict[str, Any]) -> None:
        loss = row["train_loss"]  # the loss of fine-tuning is of another kind, and small
        text = f"loss {loss:{'.3f' if loss >= 0.01 else '.1e'}}"
        if row["validation_accuracy"] is not None:
            text += f", validation accuracy {row['validation_accuracy']:.3f}"
        phase = row.get("what", title)
        reporter = reporters.setdefault(phase, ProgressReporter(phase, "epochs", keep=True))
        reporter(epoch, epochs, detail=text)

    return report


def report_jobs(title: str, unit: str = "folds") -> Callable[[JobProgress], None]:
    """Return a callback that reports how many jobs are done, and the last job with its epoch."""
    reporter = ProgressReporter(title, unit, keep=True)

    def report(at: JobProgress) -> None:
        detail = f"{at.name} epoch {at.epoch}" if at.epoch else at.name
        reporter(at.done, at.total, detail=detail, resumed=at.resumed)

    return report


def report_stages(indent: str = "") -> Callable[[str, int, int], None]:
    """Return a callback that reports work in stages: (name of the stage, done, total)."""
    reporters: dict[str, ProgressReporter] = {}

    def report(stage: str, done: int, total: int) -> None:
        reporters.setdefault(stage, ProgressReporter(indent + stage))(done, total)

    return report
