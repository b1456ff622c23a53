"""Trimming a data set from Python: what is suggested, and decisions about it, all or none."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from plushsense.apps.preparation import opened
from plushsense.core.errors import ConfigError
from plushsense.dataset import trim
from plushsense.dataset.quality.deciding import signed
from plushsense.dataset.store import Dataset

Kept = tuple[str, float | None, float | None]


@dataclass(frozen=True)
class Trimmed:
    """The recordings looked at as they stand now, and the ids of those that were decided."""

    dataset: Dataset
    trims: tuple[trim.Trim, ...]
    accepted: trim.Accepted
    adjusted: tuple[str, ...]
    undone: tuple[str, ...]

    @property
    def changed(self) -> frozenset[str]:
        """The ids of the recordings that got a mark."""
        return frozenset((*self.accepted.marked, *self.adjusted, *self.undone))

    @property
    def states(self) -> dict[str, int]:
        """How many of the recordings are in each of `plushsense.dataset.trim.STATES`."""
        return dict(Counter(t.state for t in self.trims))


def decide_trims(
    dataset: Dataset | str | os.PathLike[str],
    *,
    only: str = "*",
    accept: Sequence[str] = (),
    above: float | None = None,
    keep: Sequence[Kept] = (),
    undo: Sequence[str] = (),
    offset: bool = False,
    who: str | None = None,
    why: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> Trimmed:
    """Look for onsets, and mark decisions where there are any; without one nothing is marked.

    Args:
        only: an id or a pattern of the recordings to look at; by default all that no mark excludes.
        accept: ids or patterns of those whose suggestion is taken. ``above``: the least confidence, 0 to 1; without
            ``accept``, of all that are looked at.
        keep: (id, from, to) in seconds, None for the edge, as set by hand.
        undo: ids or patterns whose mark is taken back.
        offset: whether a suggested end is taken too.
        who: by default the login name.

    Raises:
        ConfigError: for a confidence that is none, or a ``keep`` of several recordings.
        DatasetError: for names that are not there, and times outside a recording. Then nothing is marked.
    """
    if above is not None and not 0.0 <= above <= 1.0:
        raise ConfigError(f"Accepting above {above:g}: a confidence from 0 to 1 is accepted.")
    dataset = opened(dataset)
    shown = dataset.used if only == "*" else trim.choose(dataset, only)
    found = {t.recording.id: t for t in trim.trims(dataset, shown, progress)}
    undone = {r.id: r for pattern in undo for r in trim.choose(dataset, pattern)}
    by_name = {r.id: r for pattern in accept for r in trim.choose(dataset, pattern)}
    to_keep = []
    for identity, start_s, stop_s in keep:
        (info, *others) = trim.choose(dataset, identity)
        if others:
            raise ConfigError(f"One recording is set at a time, and '{identity}' names {1 + len(others)}: give an id.")
        to_keep.append((info, start_s, stop_s))
    more = [r for r in [*by_name.values(), *(i for i, _, _ in to_keep)] if r.id not in found]
    every = found | {t.recording.id: t for t in trim.trims(dataset, more)}
    for info, start_s, stop_s in to_keep:
        trim.kept_rows(every[info.id], start_s, stop_s)
    accepting = bool(by_name) or above is not None
    name = signed(who) if accepting or undone or to_keep else ""
    # Everything was found and understood; from here on marks are made.
    taken_back = trim.undo(dataset, list(undone.values()), name, why)
    adjusted = tuple(
        info.id
        for info, start_s, stop_s in to_keep
        if trim.set_trim(dataset, every[info.id], start_s, stop_s, name, why)
    )
    accepted = trim.Accepted()
    if accepting:
        again = trim.renewed(dataset, [every[identity] for identity in (by_name or found)])
        accepted = trim.accept(dataset, again, name, why, above=above or 0.0, offset=offset)
    return Trimmed(dataset, tuple(trim.renewed(dataset, found.values())), accepted, adjusted, taken_back)
