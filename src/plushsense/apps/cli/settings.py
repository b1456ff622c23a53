"""The options that verbs share, and the settings they make."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from plushsense.apps.cli.output import say

if TYPE_CHECKING:
    from plushsense.apps.config import RunConfig


def listed(*given: str) -> list[str]:
    """What an option lists, with commas or by being given again: ``A,B``."""
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
    """Where it is worked, and how much at a time; ``what`` is done side by side: "folds", "trainings"."""
    parser.add_argument("--workers", type=int, metavar="N", help=f"{what} at a time (default 0: one a processor)")
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="work on a Ray cluster instead: auto, local, HOST:PORT or ray://HOST:10001 (default: on this machine)",
    )


def add_networks(parser: argparse.ArgumentParser) -> None:
    """Which networks of a grid; nothing given: the grid's."""
    parser.add_argument("--architectures", metavar="SPEC,...", help="only these networks (default: the grid's)")
    parser.add_argument(
        "--filters", metavar="SETS", help="only these filters: 4,6,8,8 or several sets, 4/6/8/8,8/12/16/16"
    )
    parser.add_argument("--threads", type=int, metavar="N", help="threads of a training, part of its identity (1)")


def marks(result: Mapping[str, Any]) -> list[str]:
    """What has to be said before any score: that it is a simulation's, that the split is leaky."""
    said = []
    if result["simulated"]:
        said.append("SIMULATION: these scores are of the virtual toy and say nothing about a real one.")
    if result["leaky"]:
        said.append("LEAKY: windows of one recording stand on both sides of this split; the scores flatter.")
    return said


def settings(args: argparse.Namespace, **evaluation: Any) -> RunConfig:
    """The resolved settings of a command."""
    from plushsense.apps.config import resolve

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
    """A warning, on standard error."""
    say(f"warning: {sentence}")


def epochs_shown(what: str = "training") -> Callable[[int, int, dict[str, Any]], None]:
    """Progress of one training: a line that is rewritten on a terminal, else a line every tenth epoch."""
    rewritten = sys.stderr.isatty()

    def show(epoch: int, epochs: int, row: dict[str, Any]) -> None:
        loss = row["train_loss"]  # fine-tuning's is a small one of another kind
        text = f"{row.get('what', what)}: epoch {epoch} of {epochs}, loss {loss:{'.3f' if loss >= 0.01 else '.1e'}}"
        if row["validation_accuracy"] is not None:
            text += f", validation accuracy {row['validation_accuracy']:.3f}"
        if rewritten:
            sys.stderr.write("\r\x1b[K" + text + ("\n" if epoch == epochs else ""))
            sys.stderr.flush()
        elif epoch == 1 or epoch % 10 == 0 or epoch == epochs:
            say(text)

    return show


def folds_shown(what: str) -> Callable[[Any], None]:
    """Progress of a cross-validation, from `plushsense.evaluation.crossval.FoldProgress`."""
    import time

    rewritten = sys.stderr.isatty()
    began = time.monotonic()
    told = -1

    def show(at: Any) -> None:
        nonlocal told
        fresh = at.done - at.resumed
        left = (time.monotonic() - began) / fresh * (at.folds - at.done) if fresh else 0.0
        text = f"{what}: {at.done} of {at.folds} folds"
        text += f" ({at.resumed} from before)" if at.resumed else ""
        text += f", about {left / 60:.0f} min left" if left > 60 else f", about {left:.0f} s left" if left else ""
        if rewritten:
            now = f", {at.fold} epoch {at.epoch}" if at.epoch else ""
            sys.stderr.write("\r\x1b[K" + text + now + ("\n" if at.done == at.folds else ""))
            sys.stderr.flush()
        elif at.done != told:
            told = at.done
            say(text)

    return show
