"""Resolve options that several verbs share, and report the progress of long work."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import say
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.jobs.progress import JobProgress
    from plushsense.training.spec import EpochProgress, EpochRow
    from plushsense.workflow.config import RunConfig

SIMULATION = "SIMULATION: these scores say nothing about a real toy."


def listed(*values: str) -> list[str]:
    """Split the values of an option that accepts lists such as ``A,B`` and may be given several times."""
    return [word.strip() for value in values for word in value.split(",") if word.strip()]


def seconds_between(option: str, text: str) -> tuple[float | None, float | None]:
    """Return the seconds of ``FROM:TO``; None where one is left out.

    Raises:
        ConfigError: for another text; the message names ``option``.
    """
    start, colon, stop = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return (float(start) if start.strip() else None, float(stop) if stop.strip() else None)
    except ValueError:
        raise ConfigError(f"{option} was given '{text}': seconds as FROM:TO are accepted, such as 0.35:2.1.") from None


def marks(result: Mapping[str, Any]) -> list[str]:
    """Return the notices to print above scores if they come from simulated data or a leaky split."""
    notices = []
    if result["simulated"]:
        notices.append(SIMULATION)
    if result["leaky"]:
        notices.append("LEAKY: windows of one recording are on both sides of this split; the scores are too high.")
    return notices


def settings(args: argparse.Namespace, **evaluation: Any) -> RunConfig:
    """Resolve the settings of a run from the configuration file and options; ``evaluation`` adds further settings."""
    from plushsense.workflow.config import resolve

    return resolve(
        args.config,
        windows=options(args, "context", "window_s"),
        model=options(args, "arch", "filters", "padding", "norm", "pool_s", "pooling"),
        training=options(args, "preset", "epochs", "batch", "seed", "device", "scaling", "weight_decay"),
        evaluation={"classes": args.classes, "seed": args.seed, **evaluation},
    )


def say_advice(dataset: str, window_s: float) -> None:
    """Say on standard error, in one line, what would change the scores and is not used, with what it brings if known.

    A run with long windows warns of them, so that a window is named only where its gain was measured.
    """
    from plushsense.dataset.importing.proposals import WINDOW
    from plushsense.workflow.advice import unused_advice

    advice = unused_advice(dataset, window_s, ProgressReporter("checking"))
    if texts := [f"{a.text} ({a.gain.text})" if a.gain else a.text for a in advice if a.gain or a.kind != WINDOW]:
        unmeasured = any(a.gain is None and a.kind != WINDOW for a in advice)
        say(f"not used: {'; '.join(texts)}" + "; evaluate --advice measures what it brings" * unmeasured)


def report_epochs(title: str = "training") -> EpochProgress:
    """Return a callback that displays the epochs of one training."""
    reporters: dict[str, ProgressReporter] = {}

    def report(epoch: int, epochs: int, row: EpochRow) -> None:
        loss = row["train_loss"]  # the loss of fine-tuning is of another kind, and small
        text = f"loss {loss:{'.3f' if loss >= 0.01 else '.1e'}}"
        if row["accuracy"] is not None:
            text += f", validation accuracy {row['accuracy']:.3f}"
        phase = row.get("what", title)
        reporter = reporters.setdefault(phase, ProgressReporter(phase, "epochs", keep=True))
        reporter(epoch, epochs, detail=text)

    return report


def report_jobs(title: str, unit: str = "folds") -> Callable[[JobProgress], None]:
    """Return a callback that displays how many jobs are done, and the latest job with its epoch."""
    reporter = ProgressReporter(title, unit, keep=True)

    def report(at: JobProgress) -> None:
        detail = f"{at.name} epoch {at.epoch}" if at.epoch else at.name
        reporter(at.done, at.total, detail=detail, resumed=at.resumed)

    return report


def report_stages(indent: str = "") -> Callable[[str, int, int], None]:
    """Return a callback ``(stage, done, total)`` that displays the progress of work in stages."""
    reporters: dict[str, ProgressReporter] = {}

    def report(stage: str, done: int, total: int) -> None:
        reporters.setdefault(stage, ProgressReporter(indent + stage))(done, total)

    return report
