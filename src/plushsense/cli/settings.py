"""The options that verbs share, and the settings they make."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import say
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.evaluation.crossval import FoldProgress
    from plushsense.workflow.config import RunConfig


def listed(*given: str) -> list[str]:
    """Split the values of an option given with commas or several times: ``A,B``."""
    return [word.strip() for each in given for word in each.split(",") if word.strip()]


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Network, training and windows. Nothing given: the preset's, or the configuration file's."""
    parser.add_argument(
        "--arch",
        metavar="SPEC",
        help="architecture symbol: kernel lengths in samples, dilations after d (14d1_19d2_19d4)",
    )
    parser.add_argument("--filters", metavar="N,N,...", help="filters by layer (8,12,16)")
    parser.add_argument(
        "--padding", help="stream, causal or mirror (default: the preset's; paper mirror, others stream)"
    )
    parser.add_argument("--norm", help="batch (default) or layer")
    parser.add_argument(
        "--preset",
        help="training schedule: people (default, 60 epochs), loso or paper (at most 150, stops early), search (250)",
    )
    parser.add_argument(
        "--context",
        help="what a short gesture's window holds before it: stream, the real past, or loop, the gesture over and "
        "over (default: the preset's; people and loso stream, paper and search loop); anywhere, to train for live "
        "work: decisions anywhere in the stream, idleness among them (scored as stream)",
    )
    parser.add_argument(
        "--pool-s",
        type=float,
        metavar="S",
        help="seconds of the signal that a decision averages (default: 2.5 s in all)",
    )
    parser.add_argument(
        "--classes",
        metavar="LABELS",
        help="shared (default: made by 90 %% of the people, no free choice), all, or labels joined by commas",
    )
    parser.add_argument("--epochs", type=int, metavar="N", help="epochs at most (default: the preset's)")
    parser.add_argument("--batch", type=int, metavar="N", help="windows a batch (64)")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of the split and of the training (0)")
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), help="where to train (default auto: cuda where it is available)"
    )
    parser.add_argument(
        "--config",
        metavar="FILE",
        help="TOML file with the tables windows, model, training, evaluation, live; options go over it (default: none)",
    )


def add_work(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the options of parallel work; ``what`` runs side by side: "folds", "trainings"."""
    parser.add_argument("--workers", type=int, metavar="N", help=f"{what} at a time (default 0: one a processor)")
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="work on a Ray cluster instead: auto, local, HOST:PORT or ray://HOST:10001 (default: on this machine)",
    )


def add_networks(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose networks of a grid; by default all of the grid."""
    parser.add_argument("--architectures", metavar="SPEC,...", help="only these networks (default: the grid's)")
    parser.add_argument(
        "--filters", metavar="SETS", help="only these filters: 4,6,8,8 or several sets, 4/6/8/8,8/12/16/16"
    )
    parser.add_argument("--threads", type=int, metavar="N", help="threads of a training, part of its identity (1)")


def marks(result: Mapping[str, Any]) -> list[str]:
    """Return the notes that must stand before any score: simulation, leaky split."""
    said = []
    if result["simulated"]:
        said.append("SIMULATION: these scores are of the virtual toy and say nothing about a real one.")
    if result["leaky"]:
        said.append("LEAKY: windows of one recording stand on both sides of this split; the scores flatter.")
    return said


def settings(args: argparse.Namespace, **evaluation: Any) -> RunConfig:
    """Resolve the settings of a command."""
    from plushsense.workflow.config import resolve

    return resolve(
        args.config,
        windows={"context": args.context},
        model={"arch": args.arch, "filters": args.filters, "padding": args.padding, "norm": args.norm}
        | {"pool_s": args.pool_s},
        training={
            "preset": args.preset,
            "epochs": args.epochs,
            "batch": args.batch,
            "seed": args.seed,
            "device": args.device,
        },
        evaluation={"classes": args.classes, "seed": args.seed, **evaluation},
    )


def warn(sentence: str) -> None:
    """Print a warning on standard error."""
    say(f"warning: {sentence}")


def report_epochs(title: str = "training") -> Callable[[int, int, dict[str, Any]], None]:
    """Return a callback that reports the epochs of one training."""
    reporters: dict[str, ProgressReporter] = {}

    def report(epoch: int, epochs: int, row: dict[str, Any]) -> None:
        loss = row["train_loss"]  # fine-tuning has a small one of another kind
        text = f"loss {loss:{'.3f' if loss >= 0.01 else '.1e'}}"
        if row["validation_accuracy"] is not None:
            text += f", validation accuracy {row['validation_accuracy']:.3f}"
        phase = row.get("what", title)
        reporter = reporters.setdefault(phase, ProgressReporter(phase, "epochs", keep=True))
        reporter(epoch, epochs, detail=text)

    return report


def report_folds(title: str) -> Callable[[FoldProgress], None]:
    """Return a callback that reports the folds of a cross-validation."""
    reporter = ProgressReporter(title, "folds", keep=True)

    def report(at: FoldProgress) -> None:
        detail = f"{at.fold} epoch {at.epoch}" if at.epoch else ""
        reporter(at.done, at.folds, detail=detail, resumed=at.resumed)

    return report
