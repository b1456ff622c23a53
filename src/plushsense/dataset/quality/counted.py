"""Checks that count: duplicates, missing repetitions, balance, recordings that are not in their stream."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from plushsense.core.gestures import NOBODY
from plushsense.dataset.quality.finding import PARTLY_THERE, Said
from plushsense.dataset.quality.outline import Outline, Whole, gesture_of
from plushsense.dataset.store import UNKNOWN_SUBJECT, RecordingInfo

_OVERLAP = 0.1
_MADE_BY = 0.9
_AGREE = 0.6


def duplicate(w: Whole) -> Iterator[Said]:
    """The same values under two names, whatever the clocks say; the first by name is the original."""
    first: dict[bytes, str] = {}
    for o in sorted(w.recordings, key=lambda o: o.info.id):
        if (o.runs >= o.rows).all():
            continue  # Where nothing changes, alike is no sign of a copy.
        original = first.setdefault(o.content, o.info.id)
        if original != o.info.id:
            yield Said(f"the same content as {original}", about=o.info.id)
    seen: dict[str, str] = {}
    for o in w.streams:
        original = seen.setdefault(o.info.sha256, o.info.id)
        if original != o.info.id:
            yield Said(f"the same content as {original}", about=o.info.id)


def overlap(w: Whole) -> Iterator[Said]:
    """Two recordings that hold the same stretch of their stream."""
    placed = [
        (o.info.stream, o.info.stream_row + o.info.start, o.info.stream_row + o.info.stop, o)
        for o in w.recordings
        if isinstance(o.info, RecordingInfo) and o.info.stream_row >= 0 and not o.info.file.startswith("streams/")
    ]
    placed.sort(key=lambda p: p[:2])
    open_at: tuple[str, int, int, Outline] | None = None
    for now in placed:
        if open_at is not None and open_at[0] == now[0]:
            shared = min(open_at[2], now[2]) - now[1]
            if shared > _OVERLAP * (now[2] - now[1]):
                yield Said(
                    f"{shared} of its {now[2] - now[1]} rows are in {open_at[3].info.id} too",
                    ((0, shared),),
                    about=now[3].info.id,
                )
        if open_at is None or open_at[0] != now[0] or now[2] > open_at[2]:
            open_at = now


def _people(w: Whole) -> dict[str, Counter[str]]:
    """Recordings of each person by gesture; gestures of free choice, and those that nobody makes, do not count."""
    counts: dict[str, Counter[str]] = {}
    for o in w.recordings:
        gesture = w.dataset.gestures.find(gesture_of(o))
        counted = gesture is None or not (gesture.free_choice or gesture.nobody)
        if o.info.subject not in (NOBODY, UNKNOWN_SUBJECT) and counted:
            counts.setdefault(o.info.subject, Counter())[gesture_of(o)] += 1
    return counts


def missing(w: Whole) -> Iterator[Said]:
    """Fewer recordings of a gesture than the others made, where most made the same number."""
    people = _people(w)
    cells = Counter(n for counts in people.values() for n in counts.values())
    if not cells:
        return
    short: dict[str, list[str]] = {}
    for gesture in sorted({g for counts in people.values() for g in counts}):
        made = Counter(counts[gesture] for counts in people.values() if counts[gesture])
        if made.total() < _MADE_BY * len(people):
            continue
        agreed = made if made.total() >= 3 else cells
        usual, n = max(agreed.items(), key=lambda item: (item[1], item[0]))
        if n < _AGREE * agreed.total():
            continue
        for subject, counts in people.items():
            if counts[gesture] < usual:
                short.setdefault(subject, []).append(f"{counts[gesture]} of {usual} '{gesture}'")
    for subject in sorted(short):
        listed = short[subject]
        more = f" and {len(listed) - 6} more gestures" if len(listed) > 6 else ""
        yield Said(f"{subject} has {', '.join(listed[:6])}{more}", about=subject)


def _odd(counts: dict[str, int], factor: float) -> tuple[float, list[str]]:
    usual = float(np.median(list(counts.values()))) if counts else 0.0
    odd = [f"{name} {n}" for name, n in counts.items() if usual and (n * factor < usual or n > factor * usual)]
    return usual, odd


def class_balance(w: Whole) -> Iterator[Said]:
    counts = Counter(gesture_of(o) for o in w.recordings)
    for gesture in w.dataset.gestures.gestures:
        if gesture.nobody or gesture.free_choice:
            counts.pop(gesture.label, None)
        elif not w.dataset.gestures.inferred:
            counts.setdefault(gesture.label, 0)
    usual, odd = _odd(counts, w.limits.balance)
    if odd:
        yield Said(
            f"{len(odd)} of {len(counts)} gestures have far fewer or more recordings than the median ({usual:.0f}): "
            + ", ".join(odd[:8])
            + (", …" if len(odd) > 8 else "")
        )


def subject_balance(w: Whole) -> Iterator[Said]:
    counts = {subject: c.total() for subject, c in _people(w).items()}
    usual, odd = _odd(counts, w.limits.balance)
    if odd:
        yield Said(
            f"{len(odd)} of {len(counts)} people have far fewer or more recordings than the median ({usual:.0f}): "
            + ", ".join(odd[:8])
            + (", …" if len(odd) > 8 else "")
        )


def not_in_stream(w: Whole) -> Iterator[Said]:
    streamed = {(s.info.subject, s.info.session) for s in w.streams}
    for o in w.recordings:
        if not isinstance(o.info, RecordingInfo):
            continue
        # Nobody's recordings lie in the folder of the person whose session they belong to.
        folder = o.info.id.split("/", 1)[0]
        if o.info.stream_row < 0 and (folder, o.info.session) in streamed:
            yield Said("not found in the session's stream", about=o.info.id)
        for flag in o.info.flags:
            if flag.startswith(PARTLY_THERE):
                yield Said(flag, about=o.info.id)


def unknown_label(w: Whole) -> Iterator[Said]:
    if not w.dataset.gestures.tells_affect:
        return
    counts = Counter(gesture_of(o) for o in w.recordings)
    for label, n in sorted(counts.items()):
        gesture = w.dataset.gestures.find(label)
        if gesture is None or gesture.affect == "none":
            yield Said(
                f"the label '{label}' ({n} recording{'s' if n > 1 else ''}) is not in the gesture set "
                f"'{w.dataset.gestures.name}': no affect"
            )
