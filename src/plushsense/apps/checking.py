"""Checking a data set from Python: findings, figures, a page, decisions."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from plushsense.apps.preparation import opened
from plushsense.core.errors import ConfigError
from plushsense.dataset.marks import append_marks
from plushsense.dataset.quality import deciding
from plushsense.dataset.quality.checking import Checked, Progress, check
from plushsense.dataset.quality.finding import Limits
from plushsense.dataset.store import Dataset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = 50


@dataclass(frozen=True)
class CheckResult(Checked):
    """What the checks found: ``findings``, ``counts()``, ``undecided``; shows itself in a notebook."""

    def figure(self, gesture: str) -> Figure:
        """All recordings of a gesture over each other, the odd ones named, and their durations.

        Raises:
            GestureError: for a gesture that the data set has not.
        """
        from plushsense.reports.quality import gesture_figure

        return gesture_figure(self, self.dataset.gestures.get(gesture).label)

    def report(self, path: str | os.PathLike[str], progress: Progress | None = None) -> Path:
        """One self-contained HTML page, with plots; replaces an older page of PlushSense, never another file."""
        from plushsense.reports.quality import write_report

        return write_report(Path(path), self, progress=progress)

    def __repr__(self) -> str:
        n = self.counts()["by_severity"]
        return (
            f"CheckResult({self.dataset.head.name!r}: {self.recordings} recordings, "
            f"{n['error']} errors, {n['warning']} warnings, {n['info']} notes)"
        )

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{f.severity}</td><td>{html.escape(f.check)}</td><td>{html.escape(f.about or 'data set')}</td>"
            f"<td>{html.escape(f.message)}{' (accepted)' if f.accepted else ''}</td></tr>"
            for f in self.findings[:_SHOWN]
        )
        more = f"<p>… and {len(self.findings) - _SHOWN} more</p>" if len(self.findings) > _SHOWN else ""
        head = "".join(f"<th>{h}</th>" for h in ("severity", "check", "about", "finding"))
        return f"<p>{html.escape(repr(self))}</p><table><tr>{head}</tr>{rows}</table>{more}"


def check_dataset(
    dataset: Dataset | str | os.PathLike[str],
    *,
    only: Iterable[str] = (),
    limits: Limits | Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> CheckResult:
    """Look at every recording and stream of a data set.

    Args:
        only: names of checks (`plushsense.dataset.quality.CHECKS`); all by default.
        limits: from where on something is worth saying, e.g. ``{"duration": 0.5}``.
        progress: called with (files done, files in all).

    Raises:
        ConfigError: for a check or limit that is not known.
        DatasetError: for a folder that is no data set.
    """
    if not isinstance(limits, Limits):
        limits = Limits().changed(limits or {})
    return _result(check(opened(dataset), only=only, limits=limits, progress=progress))


def decide(
    dataset: Dataset | str | os.PathLike[str],
    *,
    accept: Sequence[str] = (),
    unaccept: Sequence[str] = (),
    exclude: Sequence[str] = (),
    include: Sequence[str] = (),
    why: str = "",
    who: str | None = None,
    only: Iterable[str] = (),
    limits: Limits | Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> tuple[CheckResult, int]:
    """Mark decisions, then check: the result, and how many marks were added.

    Args:
        accept, unaccept: ``CHECK:PATTERN``, e.g. ``gaps:P26/*``; without a pattern, the data set as a whole.
        exclude, include: patterns of recordings, e.g. ``P19/*``.
        why: the reason; accepting and excluding need one. ``who``: by default the login name.

    Raises:
        ConfigError: without a reason, or for a check that is not known.
        DatasetError: for a pattern that names nothing.
    """
    if (accept or exclude) and not why.strip():
        raise ConfigError('Accepting and excluding need a reason: say it with --why "…".')
    dataset = opened(dataset)
    name = deciding.signed(who) if accept or unaccept or exclude or include else ""
    # Everything is looked up before anything is marked: a wrong pattern leaves no half of a decision behind.
    marks = deciding.exclusions(dataset, exclude, include, who=name, why=why)
    marks += deciding.withdrawals(dataset, unaccept, who=name, why=why)
    for said in accept:
        deciding.parted(said)
    if accept:
        marks += deciding.acceptances(check_dataset(dataset, limits=limits), accept, who=name, why=why)
    if marks:
        append_marks(dataset.path, marks)
        dataset = opened(dataset.path)
    return check_dataset(dataset, only=only, limits=limits, progress=progress), len(marks)


def _result(checked: Checked) -> CheckResult:
    return CheckResult(**{f.name: getattr(checked, f.name) for f in fields(Checked)})
