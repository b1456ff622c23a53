"""Checks that compare recordings with each other: what is usual decides."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from plushsense.dataset.quality.examined import NEVER_STOPPED_FACTOR
from plushsense.dataset.quality.finding import Said
from plushsense.dataset.quality.outline import LEVEL_KINDS, Outline, Whole
from plushsense.dataset.store import RecordingInfo

_ENOUGH = 4
_FLAT_ROWS = 20
_QUIET = 0.15
_BURST = 0.4
_SOMETHING = 0.05
_AS_MUCH = 0.2
_SEVERAL_USUAL = 0.2
_SESSION_S = 60.0
_PLAIN = 0.25
_GENTLE = 0.5
_TOLD_S = 0.3
_RAIL = 0.99
_ALIKE = 3
_OFTEN = 0.04


def usual_seconds(group: list[Outline]) -> float:
    """The mean duration, as the paper has it, over the recordings that were stopped: one of three minutes among
    gestures of two seconds would pull the mean until half of the good ones lie outside.
    """
    seconds = np.array([o.seconds for o in group])
    return float(seconds[seconds <= NEVER_STOPPED_FACTOR * np.median(seconds)].mean())


def never_stopped(o: Outline, group: list[Outline]) -> bool:
    """Whether a recording ran on for more than 10 times its gesture's median."""
    return o.seconds > NEVER_STOPPED_FACTOR * float(np.median([g.seconds for g in group]))


def _is_cut_by_the_file(o: Outline, whole: Whole) -> bool:
    """Whether a stretch of equal labels touches an end of its file, where its duration is not the person's."""
    info = o.info
    if not isinstance(info, RecordingInfo) or whole.dataset.layout.csv.columns[-1] != "label":
        return False
    rows = next((s.info.rows for s in whole.streams if s.info.id == info.stream), None)
    return info.first_row == 0 or info.first_row + info.rows == rows


def duration(w: Whole) -> Iterator[Said]:
    share = w.limits.duration
    for group in w.groups.values():
        group = [o for o in group if not _is_cut_by_the_file(o, w)]
        if len(group) < _ENOUGH:
            continue
        mean = usual_seconds(group)
        own: dict[str, list[float]] = {}
        for o in group:
            own.setdefault(o.info.subject, []).append(o.seconds)
        for o in group:
            off = o.seconds / mean - 1 if mean else 0.0
            if abs(off) <= share or never_stopped(o, group):
                continue
            # Somebody who always takes longer has a tempo, not a fault.
            mine = float(np.median(own[o.info.subject]))
            habit = len(own[o.info.subject]) >= 3 and abs(o.seconds / mine - 1) <= share if mine else False
            yield Said(
                f"lasts {o.seconds:.2f} s, {abs(off) * 100:.0f} % {'more' if off > 0 else 'less'} than the mean of its "
                f"gesture ({mean:.2f} s)"
                + (
                    f", as this person's others do (their median {mine:.2f} s)"
                    if habit
                    else f"; this person's median is {mine:.2f} s"
                ),
                about=o.info.id,
                severity="info" if habit else None,
            )


def flat(w: Whole) -> Iterator[Said]:
    """A channel with one value throughout, where it usually has more."""
    names = w.dataset.layout.names
    long = [o for o in w.recordings if o.rows >= _FLAT_ROWS]
    if not long:
        return
    constant = np.array([o.runs >= o.rows for o in long])
    always = constant.mean(axis=0) > 0.5
    for c in np.flatnonzero(always):
        yield Said(
            f"channel {names[c]} does not change in {int(constant[:, c].sum())} of {len(long)} recordings",
            channels=(int(c),),
            severity="warning",
        )
    for o, row in zip(long, constant, strict=True):
        dead = np.flatnonzero(row & ~always)
        if len(dead):
            yield Said(
                f"{_channels(names, dead)} {'has' if len(dead) == 1 else 'have'} one value throughout",
                ((o.first_row, o.first_row + o.rows),),
                tuple(dead.tolist()),
                o.info.id,
            )
    for o in w.streams:
        dead = np.flatnonzero((o.runs >= o.rows) & ~always)
        if o.rows >= _FLAT_ROWS and len(dead):
            yield Said(
                f"{_channels(names, dead)} {'has' if len(dead) == 1 else 'have'} one value throughout the session",
                channels=tuple(dead.tolist()),
                about=o.info.id,
            )


def _channels(names: tuple[str, ...], at: np.ndarray) -> str:
    shown = ", ".join(names[c] for c in at[:4]) + (", …" if len(at) > 4 else "")
    return f"channel {shown}" if len(at) == 1 else f"{len(at)} channels ({shown})"


def stuck(w: Whole) -> Iterator[Said]:
    """A channel that holds one value far longer than it usually does, and goes on; all at once: the toy hung."""
    if not w.recordings:
        return
    names = w.dataset.layout.names
    limit = np.maximum(w.limits.stuck_s * 1000, 10 * w.usual_run_ms)
    for o, least in [(o, limit) for o in w.recordings] + [(o, 4 * limit) for o in w.streams]:
        held = o.runs * o.period_ms
        found = np.flatnonzero((held > least) & (o.runs < o.rows))
        if not len(found):
            continue
        c = int(found[np.argmax(held[found])])
        first = int(o.run_at[c]) + o.first_row
        yield Said(
            f"{_channels(names, found)} {'holds' if len(found) == 1 else 'hold'} one value for up to "
            f"{held[c] / 1000:.1f} s (from row {first + 1}); usual is {w.usual_run_ms[c] / 1000:.2f} s",
            ((first, first + int(o.runs[c])),),
            tuple(found.tolist()),
            o.info.id,
            "error" if o.runs[c] > 0.5 * o.rows else None,
        )


def saturated(w: Whole) -> Iterator[Said]:
    """A moving channel that stays at its highest or lowest value: the sensor's end is reached."""
    if not w.recordings:
        return
    names = w.dataset.layout.names
    usual = np.median([o.spread for o in w.recordings], axis=0)
    # The sensor's end is where several recordings stop alike; at any other height a flat top must be plainer.
    tops = np.abs([o.top for o in w.recordings])
    rail = tops.max(axis=0)
    shared = (tops >= _RAIL * rail).sum(axis=0) >= _ALIKE
    most = np.maximum(w.limits.saturated_s * 1000, 4 * w.usual_top_ms)
    for o in w.recordings:
        at_rail = shared & (np.abs(o.top) >= _RAIL * rail)
        held = o.top_runs * o.period_ms
        long = np.where(at_rail, held >= most / 2, held >= most) & (o.top_runs >= 3)
        often = at_rail & (o.top_rows >= 10) & (o.top_rows >= _OFTEN * o.rows)
        moving = (o.spread > 0.5 * usual) & (o.spread > 0) & (o.runs < o.rows)
        found = np.flatnonzero((long | often) & moving)
        if not len(found):
            continue
        c = int(found[np.argmax(held[found])])
        first = int(o.top_at[c]) + o.first_row
        yield Said(
            f"{_channels(names, found)} {'stays' if len(found) == 1 else 'stay'} at the highest or lowest value, "
            f"{names[c]} for {held[c]:.0f} ms at {o.top[c]:g} (from row {first + 1}), {o.top_rows[c]} rows in all",
            ((first, first + int(o.top_runs[c])),),
            tuple(found.tolist()),
            o.info.id,
        )


def drift(w: Whole) -> Iterator[Said]:
    """The baseline of channels that have one, from the first quarter of a session to the last."""
    layout = w.dataset.layout
    level = [c for c, ch in enumerate(layout.channels) if ch.kind in LEVEL_KINDS]
    if not level or not w.recordings:
        return
    touched = np.percentile([o.spread for o in w.recordings], 90, axis=0)
    for key, lows, about, seconds in _baselines(w):
        if len(lows) < 8 or seconds < _SESSION_S:
            continue
        quarter = len(lows) // 4
        change = np.median(lows[-quarter:], axis=0) - np.median(lows[:quarter], axis=0)
        share = np.divide(change, touched, out=np.zeros_like(change), where=touched > 0)
        found = np.array([c for c in level if abs(share[c]) > w.limits.drift], dtype=np.int64)
        if len(found):
            c = int(found[np.argmax(np.abs(share[found]))])
            yield Said(
                f"the baseline of {_channels(layout.names, found)} drifts over {key}, {layout.names[c]} by "
                f"{change[c]:+.0f}: {abs(share[c]) * 100:.0f} % of its signal when touched",
                channels=tuple(found.tolist()),
                about=about,
            )


def _baselines(w: Whole) -> Iterator[tuple[str, np.ndarray, str, float]]:
    """For each session the baselines in order of time, (K, C): of its stream, else of its recordings."""
    streamed = set()
    for o in w.streams:
        if o.lows is not None:
            streamed.add((o.info.subject, o.info.session))
            yield "the session", o.lows, o.info.id, o.seconds
    sessions: dict[tuple[str, str], list[Outline]] = {}
    for o in w.recordings:
        sessions.setdefault((o.info.subject, o.info.session), []).append(o)
    for (subject, session), outlines in sessions.items():
        if (subject, session) not in streamed:
            outlines.sort(key=lambda o: o.info.epoch_ms if isinstance(o.info, RecordingInfo) else 0)
            passed = [o.info.epoch_ms for o in (outlines[0], outlines[-1]) if isinstance(o.info, RecordingInfo)]
            yield f"session {session}", np.array([o.low for o in outlines]), subject, (passed[1] - passed[0]) / 1000


def no_onset(w: Whole) -> Iterator[Said]:
    """A recording in which hardly anything happens, where its gesture is usually plain to see."""
    for group in w.groups.values():
        if len(group) < _ENOUGH:
            continue
        peaks = np.array([np.percentile(w.activity(o), 95) for o in group])
        usual = float(np.median(peaks))
        # A gesture that many make without moving has no onset to miss.
        if usual < 2 * _SOMETHING or np.percentile(peaks, 20) < _PLAIN * usual:
            continue
        own: dict[str, list[float]] = {}
        for o, peak in zip(group, peaks, strict=True):
            own.setdefault(o.info.subject, []).append(float(peak))
        for o, peak in zip(group, peaks, strict=True):
            # Somebody who always does it gently has a way, not a fault; at rest, nobody is that strong.
            mine = own[o.info.subject]
            if len(mine) >= 3 and peak > max(0.5 * float(np.median(mine)), _GENTLE * w.limits.onset * usual):
                continue
            if (
                peak < w.limits.onset * usual
                and not _is_cut_by_the_file(o, w)
                and o.seconds >= _TOLD_S
                and not never_stopped(o, group)
            ):
                yield Said(
                    f"no onset is visible: the strongest moment has {100 * peak / usual:.0f} % of what is usual for "
                    "this gesture",
                    about=o.info.id,
                )


def bursts(activity: np.ndarray, quiet_blocks: int) -> list[tuple[int, int]]:
    """Stretches of blocks in which something happens, parted by stillness of at least ``quiet_blocks``.

    What is much less than the largest of them is no gesture: the toy is put down, a key is pressed.
    """
    top = float(np.percentile(activity, 95)) if len(activity) else 0.0
    on = np.flatnonzero(activity > _QUIET * top)
    if top < _SOMETHING or not len(on):
        return []
    parts = np.split(on, np.flatnonzero(np.diff(on) > quiet_blocks) + 1)
    most = max(float(activity[p].sum()) for p in parts)
    return [
        (int(p[0]), int(p[-1]) + 1)
        for p in parts
        if activity[p].max() > _BURST * top and float(activity[p].sum()) > _AS_MUCH * most
    ]


def several_gestures(w: Whole) -> Iterator[Said]:
    """More than one stretch of activity, where the gesture usually has one."""
    for group in w.groups.values():
        if len(group) < _ENOUGH:
            continue
        found = []
        for o in group:
            block_s = o.hop * o.period_ms / 1000
            found.append(bursts(w.activity(o), max(1, round(w.limits.quiet_s / block_s))))
        counts = np.array([len(f) for f in found])
        # Where many have several parts, that is the gesture.
        if np.mean(counts > 1) > _SEVERAL_USUAL:
            continue
        for o, parts in zip(group, found, strict=True):
            if len(parts) > 1:
                rows = tuple((a * o.hop + o.first_row, b * o.hop + o.first_row) for a, b in parts)
                still = max((b[0] - a[1]) * o.period_ms / 1000 for a, b in itertools.pairwise(rows))
                yield Said(
                    f"{len(parts)} separate gestures in one recording, with up to {still:.1f} s of stillness between "
                    f"(second from row {rows[1][0] + 1})",
                    rows,
                    about=o.info.id,
                )
