"""Quality checks that compare the recordings, streams and people of a data set with each other."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import BINARY, COUNT
from plushsense.core.sentences import Message
from plushsense.dataset.quality.copies import CopiedStretch, find_copied_stretches
from plushsense.dataset.quality.findings import PARTLY_THERE, Issue
from plushsense.dataset.quality.measurements import (
    LEVEL_KINDS,
    NEVER_STOPPED_FACTOR,
    START_HOPS,
    DatasetSummary,
    RecordingSummary,
    gesture_of,
    zeroing_limit,
)
from plushsense.dataset.store import UNKNOWN_SUBJECT, RecordingInfo, StreamInfo

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
_SHORTEST_S = 0.3
_RAIL = 0.99
_ALIKE = 3
_OFTEN = 0.04
_OVERLAP = 0.1
_TOGETHER = 0.5
_WALL_CLOCK_MS = 1e11
_MADE_BY = 0.9
_AGREE = 0.6
# The rest before the gestures tells them if it names this share of them right, and so much more than guessing.
_TELLING, _BEYOND_GUESSING = 0.5, 0.25
_RESTS = 20


def usual_seconds(durations: Sequence[float]) -> float:
    """Return the mean of durations in seconds (the measure of the paper), without recordings that were never stopped.

    One such recording of three minutes among gestures of two seconds would make half of the others look too short.
    """
    seconds = np.array(durations)
    return float(seconds[seconds <= NEVER_STOPPED_FACTOR * np.median(seconds)].mean())


def never_stopped(o: RecordingSummary, group: list[RecordingSummary]) -> bool:
    """Return whether ``o`` lasts longer than `NEVER_STOPPED_FACTOR` times the median of its gesture, ``group``."""
    return o.seconds > NEVER_STOPPED_FACTOR * float(np.median([g.seconds for g in group]))


def _by_subject(group: Iterable[RecordingSummary], values: Iterable[float]) -> dict[str, list[float]]:
    """Group ``values``, one for each recording of ``group``, by person."""
    grouped: dict[str, list[float]] = {}
    for o, value in zip(group, values, strict=True):
        grouped.setdefault(o.info.subject, []).append(value)
    return grouped


def _is_cut_by_the_file(o: RecordingSummary, w: DatasetSummary) -> bool:
    """Return whether a recording is a run of equal labels at an end of its file, so that it may be incomplete."""
    info = o.info
    if not isinstance(info, RecordingInfo) or w.dataset.layout.csv.columns[-1] != "label":
        return False
    rows = next((s.info.rows for s in w.streams if s.info.id == info.stream), None)
    return info.first_row == 0 or info.first_row + info.rows == rows


# By whether the person usually takes as long, and whether it is longer than the mean.
_DURATIONS = {
    (False, False): (
        "lasts {seconds:.2f} s, {percent:.0f} % less than the mean of its gesture ({mean:.2f} s); this person's "
        "median is {median:.2f} s"
    ),
    (False, True): (
        "lasts {seconds:.2f} s, {percent:.0f} % more than the mean of its gesture ({mean:.2f} s); this person's "
        "median is {median:.2f} s"
    ),
    (True, False): (
        "lasts {seconds:.2f} s, {percent:.0f} % less than the mean of its gesture ({mean:.2f} s), as this person's "
        "others do (their median {median:.2f} s)"
    ),
    (True, True): (
        "lasts {seconds:.2f} s, {percent:.0f} % more than the mean of its gesture ({mean:.2f} s), as this person's "
        "others do (their median {median:.2f} s)"
    ),
}


def duration(w: DatasetSummary) -> Iterator[Issue]:
    share = w.limits.duration
    for group in w.groups.values():
        group = [o for o in group if not _is_cut_by_the_file(o, w)]
        if len(group) < _ENOUGH:
            continue
        mean = usual_seconds([o.seconds for o in group])
        own = _by_subject(group, [o.seconds for o in group])
        for o in group:
            off = o.seconds / mean - 1 if mean else 0.0
            if abs(off) <= share or never_stopped(o, group):
                continue
            # It is no fault of the recording if this person always takes longer (or less long) than others.
            median = float(np.median(own[o.info.subject]))
            habit = bool(median) and len(own[o.info.subject]) >= 3 and abs(o.seconds / median - 1) <= share
            sentence = Message(
                _DURATIONS[habit, off > 0], seconds=o.seconds, percent=abs(off) * 100, mean=mean, median=median
            )
            yield Issue(
                sentence,
                about=o.info.id,
                severity="info" if habit else None,
            )


def flat(w: DatasetSummary) -> Iterator[Issue]:
    """Find channels that never change in a recording or stream; those constant in most recordings, once for all.

    A binary or counting channel is reported only if it is constant in every recording and stream, and a coarse one not
    where it hardly moves in the other recordings of the gesture either.
    """
    names = w.dataset.layout.names
    discrete = np.array([ch.is_discrete for ch in w.dataset.layout.channels])
    long = [o for o in w.recordings if o.rows >= _FLAT_ROWS]
    if not long:
        return
    constant = np.array([o.runs >= o.rows for o in long])
    always = np.where(discrete, constant.all(axis=0), constant.mean(axis=0) > 0.5)
    for c in np.flatnonzero(always):
        n, of = int(constant[:, c].sum()), len(long)
        yield Issue(
            Message("channel {channel} does not change in {n} of {of} recordings", channel=names[c], n=n, of=of),
            channels=(int(c),),
            severity="warning",
        )
    for o in (*long, *(s for s in w.streams if s.rows >= _FLAT_ROWS)):
        known = always | discrete | w.still(o) | (w.zeroed & (o.zeros == o.rows))
        dead = np.flatnonzero((o.runs >= o.rows) & ~known)
        if len(dead):
            stream = isinstance(o.info, StreamInfo)
            subject = f"{_channels(names, dead)} {'has' if len(dead) == 1 else 'have'}"
            template = "{subject} one value throughout the session" if stream else "{subject} one value throughout"
            yield Issue(
                Message(template, subject=subject, channels=_names(names, dead)),
                () if stream else ((o.first_row, o.first_row + o.rows),),
                tuple(dead.tolist()),
                o.info.id,
            )


def _names(names: tuple[str, ...], at: np.ndarray) -> list[str]:
    return [names[c] for c in at[:4]] + (["…"] if len(at) > 4 else [])


def _channels(names: tuple[str, ...], at: np.ndarray) -> str:
    listed = ", ".join(_names(names, at))
    return f"channel {listed}" if len(at) == 1 else f"{len(at)} channels ({listed})"


def zeroed(w: DatasetSummary) -> Iterator[Issue]:
    """Report axes of an accelerometer in which the authors' recorder has replaced low values by 0."""
    affected = np.flatnonzero(w.zeroed)
    if len(affected):
        zeros = np.array([o.zeros for o in w.recordings])[:, affected]
        limit, names = zeroing_limit(w.dataset.layout), w.dataset.layout.names
        percent = round(100 * float(zeros.sum(axis=0).max()) / sum(o.rows for o in w.recordings), 1)
        n = int(zeros.any(axis=1).sum())
        message = Message(
            "{subject} {more} exactly 0 in up to {percent:.1f} % of the rows ({n} of {of} recordings) and never "
            "less than {limit}: the authors' recorder writes 0 for every value under {limit}, so that magnitude and "
            "direction are wrong there",
            subject=_channels(names, affected),
            more="reads" if len(affected) == 1 else "read",
            percent=percent,
            n=n,
            of=len(zeros),
            limit=limit,
            channels=_names(names, affected),
        )
        yield Issue(message, channels=tuple(affected.tolist()))


def stuck(w: DatasetSummary) -> Iterator[Issue]:
    """Find channels that keep one value far longer than usual, but not throughout; if all do, the toy hung."""
    if not w.recordings:
        return
    names = w.dataset.layout.names
    longest = np.percentile([o.runs * o.period_ms for o in w.recordings], 90, axis=0)
    limit = np.maximum(w.limits.stuck_s * 1000, 10 * w.usual_run_ms)
    # At rest between gestures, one value for a while is usual for a coarse sensor.
    limit = np.where(w.coarse, np.maximum(limit, 2 * longest), limit)
    discrete = np.array([ch.is_discrete for ch in w.dataset.layout.channels])
    for o, least in [(o, limit) for o in w.recordings] + [(o, 4 * limit) for o in w.streams]:
        run_ms = o.runs * o.period_ms
        # The check `zeroed` reports an axis that stays at 0 because low values were replaced.
        known = discrete | w.still(o) | (w.zeroed & (o.zeros >= o.runs))
        affected = np.flatnonzero((run_ms > least) & (o.runs < o.rows) & ~known)
        if not len(affected):
            continue
        c = int(affected[np.argmax(run_ms[affected])])
        first = int(o.run_at[c]) + o.first_row
        seconds, usual = float(run_ms[c]) / 1000, float(w.usual_run_ms[c]) / 1000
        yield Issue(
            Message(
                "{subject} one value for up to {seconds:.1f} s (from row {row}); usual is {usual:.2f} s",
                subject=f"{_channels(names, affected)} {'holds' if len(affected) == 1 else 'hold'}",
                seconds=seconds,
                row=first + 1,
                usual=usual,
                channels=_names(names, affected),
            ),
            ((first, first + int(o.runs[c])),),
            tuple(affected.tolist()),
            o.info.id,
            "error" if o.runs[c] > 0.5 * o.rows else None,
        )


def saturated(w: DatasetSummary) -> Iterator[Issue]:
    """Find channels that change but stay at their highest or lowest value, probably the limit of the sensor's range.

    A binary channel has no range, and the limit of one that counts is its ``valid_max``.
    """
    if not w.recordings:
        return
    names = w.dataset.layout.names
    usual = np.median([o.spread for o in w.recordings], axis=0)
    # An extreme that several recordings reach is the sensor's limit; any other must be held for longer to be reported.
    tops = np.abs([o.top for o in w.recordings])
    rail = tops.max(axis=0)
    shared = (tops >= _RAIL * rail).sum(axis=0) >= _ALIKE
    most = np.maximum(w.limits.saturated_s * 1000, 4 * w.usual_top_ms)
    channels = w.dataset.layout.channels
    ranged = np.array([ch.kind != BINARY for ch in channels])
    counting = np.array([ch.kind == COUNT for ch in channels])
    least = np.where(counting, w.dataset.layout.valid_max_int, w.dataset.layout.valid_min_int)
    for o in w.recordings:
        at_rail = shared & (np.abs(o.top) >= _RAIL * rail)
        run_ms = o.top_runs * o.period_ms
        # On a plateau, a coarse sensor stays at one value without being at its limit.
        long = np.where(at_rail, run_ms >= most / 2, (run_ms >= most) & ~w.coarse) & (o.top_runs >= 3)
        often = at_rail & (o.top_rows >= 10) & (o.top_rows >= _OFTEN * o.rows)
        moving = (o.spread > 0.5 * usual) & (o.spread > 0) & (o.runs < o.rows)
        affected = np.flatnonzero((long | often) & moving & ranged & (o.top >= least) & ~(w.zeroed & (o.top == 0)))
        if not len(affected):
            continue
        c = int(affected[np.argmax(run_ms[affected])])
        first = int(o.top_at[c]) + o.first_row
        value, unit = channels[c].in_units(int(o.top[c]))
        yield Issue(
            Message(
                "{subject} at the highest or lowest value, {channel} for {ms} ms at {value:g}{unit} (from row {row}), "
                "{rows} rows in all",
                subject=f"{_channels(names, affected)} {'stays' if len(affected) == 1 else 'stay'}",
                channel=names[c],
                ms=round(float(run_ms[c])),
                value=value,
                unit=unit,
                row=first + 1,
                rows=int(o.top_rows[c]),
                channels=_names(names, affected),
            ),
            ((first, first + int(o.top_runs[c])),),
            tuple(affected.tolist()),
            o.info.id,
        )


def drift(w: DatasetSummary) -> Iterator[Issue]:
    """Find channels whose baseline differs between the first and the last quarter of a session."""
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
        affected = np.array([c for c in level if abs(share[c]) > w.limits.drift], dtype=np.int64)
        if len(affected):
            c = int(affected[np.argmax(np.abs(share[affected]))])
            percent = round(float(abs(share[c])) * 100)
            by, unit = layout.channels[c].in_units(round(float(change[c])))
            channels = _names(layout.names, affected)
            yield Issue(
                Message(
                    "the baseline of {subject} drifts over {key}, {channel} by {by:+g}{unit}: {percent} % of its "
                    "signal when touched",
                    subject=_channels(layout.names, affected),
                    key=key,
                    channel=layout.names[c],
                    by=by,
                    unit=unit,
                    percent=percent,
                    channels=channels,
                ),
                channels=tuple(affected.tolist()),
                about=about,
            )


def _baselines(w: DatasetSummary) -> Iterator[tuple[str, np.ndarray, str, float]]:
    """Yield for each session its name, its baselines (K, C) over time, the id for findings, and its seconds."""
    streamed = set()
    for o in w.streams:
        if o.lows is not None:
            streamed.add((o.info.subject, o.info.session))
            yield "the session", o.lows, o.info.id, o.seconds
    sessions: dict[tuple[str, str], list[RecordingSummary]] = {}
    for o in w.recordings:
        sessions.setdefault((o.info.subject, o.info.session), []).append(o)
    for (subject, session), group in sessions.items():
        if (subject, session) not in streamed:
            timed = sorted((o.info.epoch_ms, i) for i, o in enumerate(group) if isinstance(o.info, RecordingInfo))
            lows = np.array([group[i].low for _, i in timed])
            yield f"session {session}", lows, subject, (timed[-1][0] - timed[0][0]) / 1000


def no_onset(w: DatasetSummary) -> Iterator[Issue]:
    """Find recordings with hardly any activity, of gestures that usually have clear activity."""
    for group in w.groups.values():
        if len(group) < _ENOUGH:
            continue
        peaks = np.array([np.percentile(w.activity(o), 95) for o in group])
        usual = float(np.median(peaks))
        # A gesture that is often made without moving has no onset.
        if usual < 2 * _SOMETHING or np.percentile(peaks, 20) < _PLAIN * usual:
            continue
        own = _by_subject(group, peaks.tolist())
        for o, peak in zip(group, peaks, strict=True):
            # It is no fault of the recording if this person is always gentle, provided the activity is above rest.
            mine = own[o.info.subject]
            if len(mine) >= 3 and peak > max(0.5 * float(np.median(mine)), _GENTLE * w.limits.onset * usual):
                continue
            if (
                peak < w.limits.onset * usual
                and not _is_cut_by_the_file(o, w)
                and o.seconds >= _SHORTEST_S
                and not never_stopped(o, group)
            ):
                percent = round(100 * float(peak) / usual)
                yield Issue(
                    Message(
                        "no onset is visible: the strongest moment has {percent} % of what is usual for this gesture",
                        percent=percent,
                    ),
                    about=o.info.id,
                )


def bursts(activity: np.ndarray, quiet_blocks: int) -> list[tuple[int, int]]:
    """Return the stretches (first, last + 1) of active blocks that at least ``quiet_blocks`` still blocks separate.

    Stretches much weaker than the strongest are left out, since the toy was only put down or a key pressed.
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


def several_gestures(w: DatasetSummary) -> Iterator[Issue]:
    """Find recordings with several stretches of activity, of gestures that usually have one."""
    for group in w.groups.values():
        if len(group) < _ENOUGH:
            continue
        parts_of = []
        for o in group:
            block_s = o.hop * o.period_ms / 1000
            parts_of.append(bursts(w.activity(o), max(1, round(w.limits.quiet_s / block_s))))
        # If many recordings have several parts, the gesture itself has.
        if np.mean([len(parts) > 1 for parts in parts_of]) > _SEVERAL_USUAL:
            continue
        for o, parts in zip(group, parts_of, strict=True):
            if len(parts) > 1:
                rows = tuple((a * o.hop + o.first_row, b * o.hop + o.first_row) for a, b in parts)
                still = max((b[0] - a[1]) * o.period_ms / 1000 for a, b in itertools.pairwise(rows))
                n, row = len(parts), rows[1][0] + 1
                yield Issue(
                    Message(
                        "{n} separate gestures in one recording, with up to {seconds:.1f} s of stillness between "
                        "(second from row {row})",
                        n=n,
                        seconds=still,
                        row=row,
                    ),
                    rows,
                    about=o.info.id,
                )


def duplicate(w: DatasetSummary) -> Iterator[Issue]:
    """Find recordings with equal values, or stretches of them, and equal streams; the first is the original.

    Clocks, people and gestures may differ. Of several stretches of a recording, the longest is reported.
    """
    # Constant recordings can be equal without being copies.
    varying = (o for o in w.recordings if not (o.runs >= o.rows).all())
    originals: dict[bytes | str, str] = {}
    for o in (*sorted(varying, key=lambda o: o.info.id), *w.streams):
        original = originals.setdefault(o.content or o.info.sha256, o.info.id)
        if original != o.info.id:
            message = Message("the same content as {original}", original=original)
            yield Issue(message, about=o.info.id)
    by_id = {o.info.id: o for o in w.recordings}
    longest: dict[str, CopiedStretch] = {}
    hashed = [o.hashed for o in w.recordings if o.hashed is not None]
    for stretch in find_copied_stretches(hashed, w.dataset.layout.rate_hz):
        known = longest.get(stretch.second.id)
        if by_id[stretch.first.id].content == by_id[stretch.second.id].content:
            continue
        if known is None or known.rows < stretch.rows:
            longest[stretch.second.id] = stretch
    for about, stretch in longest.items():
        first, row = stretch.first.start + stretch.first_row, stretch.second.start + stretch.second_row
        n, of, other = stretch.rows, by_id[about].rows, stretch.first.id
        yield Issue(
            Message(
                "{n} of its {of} rows (from row {row}) are also in {other} (from row {from_row})",
                n=n,
                of=of,
                row=row + 1,
                other=other,
                from_row=first + 1,
            ),
            ((row, row + n),),
            about=about,
        )


def overlap(w: DatasetSummary) -> Iterator[Issue]:
    """Find recordings that share rows of their stream with an earlier recording."""
    placed = [
        (o.info.stream, o.info.stream_row + o.info.start, o.info.stream_row + o.info.stop, o)
        for o in w.recordings
        if isinstance(o.info, RecordingInfo) and o.info.stream_row >= 0 and not o.info.file.startswith("streams/")
    ]
    placed.sort(key=lambda p: p[:2])
    open_at: tuple[str, int, int, RecordingSummary] | None = None
    for now in placed:
        if open_at is not None and open_at[0] == now[0]:
            shared = min(open_at[2], now[2]) - now[1]
            if shared > _OVERLAP * (now[2] - now[1]):
                of, other = now[2] - now[1], open_at[3].info.id
                yield Issue(
                    Message("{n} of its {of} rows are in {other} too", n=shared, of=of, other=other),
                    ((0, shared),),
                    about=now[3].info.id,
                )
        if open_at is None or open_at[0] != now[0] or now[2] > open_at[2]:
            open_at = now
    yield from _at_one_time(w)


def _at_one_time(w: DatasetSummary) -> Iterator[Issue]:
    """Find recordings during which, by the wall clock, the same person also made one in another session."""
    people: dict[str, list[tuple[float, float, tuple[str, str], str]]] = {}
    for o in w.recordings:
        if isinstance(o.info, RecordingInfo) and o.info.epoch_ms > _WALL_CLOCK_MS and o.info.subject != UNKNOWN_SUBJECT:
            place = o.info.session, o.info.stream
            end_ms = o.info.epoch_ms + 1000 * o.info.whole_seconds
            people.setdefault(o.info.subject, []).append((o.info.epoch_ms, end_ms, place, o.info.id))
    for own in people.values():
        latest: dict[tuple[str, str], tuple[float, str]] = {}
        for start, end, place, identity in sorted(own):
            for other_place, (other_end, other) in latest.items():
                shared = min(end, other_end) - start
                if other_place != place and shared > _TOGETHER * (end - start):
                    template = "made at the same time as {other}, by the clock ({seconds:.1f} s): two devices?"
                    yield Issue(Message(template, other=other, seconds=shared / 1000), about=identity)
                    break
            latest[place] = max(latest.get(place, (0.0, "")), (end, identity))


def _people(w: DatasetSummary) -> dict[str, Counter[str]]:
    """Count the recordings of each person by gesture, except free-choice gestures and those that nobody makes."""
    counts: dict[str, Counter[str]] = {}
    for o in w.recordings:
        gesture = w.dataset.gestures.find(gesture_of(o))
        counted = gesture is None or not (gesture.free_choice or gesture.nobody)
        if o.info.subject not in (NOBODY, UNKNOWN_SUBJECT) and counted:
            counts.setdefault(o.info.subject, Counter())[gesture_of(o)] += 1
    return counts


def missing(w: DatasetSummary) -> Iterator[Issue]:
    """Find people with fewer recordings of a gesture than usual, if most people made the same number."""
    people = _people(w)
    cells = Counter(n for counts in people.values() for n in counts.values())
    if not cells:
        return
    short: dict[str, list[Message]] = {}
    for gesture in sorted({g for counts in people.values() for g in counts}):
        made = Counter(counts[gesture] for counts in people.values() if counts[gesture])
        if made.total() < _MADE_BY * len(people):
            continue
        agreed = made if made.total() >= 3 else cells
        usual, times = max(agreed.items(), key=lambda item: (item[1], item[0]))
        if times < _AGREE * agreed.total():
            continue
        for subject, counts in people.items():
            if counts[gesture] < usual:
                n = counts[gesture]
                lack = Message("{n} of {usual} '{gesture}'", n=n, usual=usual, gesture=gesture)
                short.setdefault(subject, []).append(lack)
    for subject in sorted(short):
        listed = short[subject]
        more = f" and {len(listed) - 6} more gestures" if len(listed) > 6 else ""
        missed = [*listed[:6], *(["…"] if more else [])]
        yield Issue(
            Message(
                "{person} has {few}{more}",
                person=subject,
                few=", ".join(listed[:6]),
                more=more,
                listed=missed,
            ),
            about=subject,
        )


_BALANCE = {
    "gestures": "{n} of {of} gestures have far fewer or more recordings than the median ({usual}): {listed}",
    "people": "{n} of {of} people have far fewer or more recordings than the median ({usual}): {listed}",
}


def _balance(counts: dict[str, int], noun: str, factor: float) -> Iterator[Issue]:
    """Report the names whose count is more than ``factor`` times above or below the median."""
    usual = float(np.median(list(counts.values()))) if counts else 0.0
    odd = [
        Message("{gesture} {n}", gesture=name, n=n) if noun == "gestures" else Message("{person} {n}", person=name, n=n)
        for name, n in counts.items()
        if usual and (n * factor < usual or n > factor * usual)
    ]
    if odd:
        listed = [*odd[:8], *(["…"] if len(odd) > 8 else [])]
        values = {"n": len(odd), "of": len(counts), "usual": round(usual), "listed": listed}
        yield Issue(Message(_BALANCE[noun], **values))


def class_balance(w: DatasetSummary) -> Iterator[Issue]:
    counts = Counter(gesture_of(o) for o in w.recordings)
    for gesture in w.dataset.gestures.gestures:
        if gesture.nobody or gesture.free_choice:
            counts.pop(gesture.label, None)
        elif not w.dataset.gestures.inferred:
            counts.setdefault(gesture.label, 0)
    yield from _balance(counts, "gestures", w.limits.balance)


def one_session(w: DatasetSummary) -> Iterator[Issue]:
    """Find gestures whose recordings are all of one session that has no other gesture.

    Whatever else is special in that session, such as a baseline, then stands for the gesture.
    """
    sessions: dict[str, set[tuple[str, str]]] = {}
    for o in w.recordings:
        sessions.setdefault(gesture_of(o), set()).add((o.info.subject, o.info.session))
    apart = {g.label for g in w.dataset.gestures.gestures if g.nobody or g.free_choice}
    for gesture, own in sorted(sessions.items()):
        if gesture in apart:
            continue
        others = set().union(*(s for g, s in sessions.items() if g != gesture))
        if len(own) == 1 and others and not own & others:
            ((subject, session),) = own
            template = "every recording of '{gesture}' is of one session ({session}), which has no other gesture"
            yield Issue(Message(template, gesture=gesture, session=f"{subject}/{session}".strip("/")))


_Placed = dict[str, list[tuple[int, int]]]


def _placed(w: DatasetSummary) -> _Placed:
    """Return the rows of each stream in which there is a recording."""
    placed: _Placed = {}
    for o in w.recordings:
        if isinstance(o.info, RecordingInfo) and o.info.stream_row >= 0:
            rows = o.info.stream_row + o.info.start, o.info.stream_row + o.info.stop
            placed.setdefault(o.info.stream, []).append(rows)
    return placed


def _before(w: DatasetSummary, o: RecordingSummary, placed: _Placed) -> NDArray[np.float64] | None:
    """Return the mean of the 0.3 s before a recording in its stream, (C,); None where these are in another one."""
    info, rows = o.info, START_HOPS * o.hop
    if not isinstance(info, RecordingInfo) or info.stream_row < 0 or info.stream_row + info.start < rows:
        return None
    first = info.stream_row + info.start - rows
    if any(begin < first + rows and end > first for begin, end in placed[info.stream]):
        return None
    values = w.dataset.read_stream(info.stream).values[first : first + rows]
    clipped = np.clip(values, w.dataset.layout.valid_min_int, w.dataset.layout.valid_max_int)
    return np.asarray(clipped.mean(axis=0))


def rest_tells(w: DatasetSummary) -> Iterator[Issue]:
    """Report whether the rest before the touch already tells the gesture: a control that should only guess.

    Each recording that begins at rest gets the gesture of the one with the most similar mean of its first 0.3 s, among
    those of other people, or of all if only one person has such recordings. A recording that is at rest throughout
    counts for the gesture of its session, if that has only one. In a session of one gesture, other recordings count
    with the 0.3 s before them in the stream.
    """
    peaks = [float(np.percentile(a, 95)) if len(a := w.activity(o)) else 0.0 for o in w.recordings]
    made: dict[tuple[str, str], set[str]] = {}
    recorded: dict[tuple[str, str], set[str]] = {}
    for o, peak in zip(w.recordings, peaks, strict=True):
        place = o.info.subject, o.info.session
        recorded.setdefault(place, set()).add(gesture_of(o))
        if peak >= _SOMETHING:
            made.setdefault(place, set()).add(gesture_of(o))
    placed = _placed(w)
    rests: list[tuple[RecordingSummary, str, NDArray[np.float64]]] = []
    for o, peak in zip(w.recordings, peaks, strict=True):
        place = o.info.subject, o.info.session
        alone = made.get(place, set())
        if peak >= _SOMETHING and w.activity(o)[:START_HOPS].max() < _QUIET * peak:
            rests.append((o, gesture_of(o), o.start))
        elif peak < _SOMETHING and len(alone) == 1:
            rests.append((o, next(iter(alone)), o.start))
        elif len(recorded[place]) == 1 and (before := _before(w, o, placed)) is not None:
            rests.append((o, gesture_of(o), before))
    gesture, subject = np.array([label for _, label, _ in rests]), np.array([o.info.subject for o, _, _ in rests])
    if len(rests) < _RESTS or len(set(gesture.tolist())) < 2:
        return
    start = np.array([mean for _, _, mean in rests])
    start /= np.maximum(start.std(axis=0), 1e-9)
    apart = subject[:, None] != subject if len(set(subject.tolist())) > 1 else ~np.eye(len(rests), dtype=bool)
    right = [
        gesture[others][np.square(start[others] - x).sum(axis=1).argmin()] == own
        for x, own, others in zip(start, gesture, apart, strict=True)
        if others.any()
    ]
    share, guess = float(np.mean(right)), max(Counter(gesture.tolist()).values()) / len(rests)
    if share >= _TELLING and share >= guess + _BEYOND_GUESSING:
        yield Issue(
            Message(
                "the rest before the touch, its first 0.3 s alone, tells {percent:.0f} % of {n} gestures (guessing "
                "{guess:.0f} %), so scores show how sessions differ rather than touches",
                percent=100 * share,
                n=len(right),
                guess=100 * guess,
            )
        )


def subject_balance(w: DatasetSummary) -> Iterator[Issue]:
    yield from _balance({subject: c.total() for subject, c in _people(w).items()}, "people", w.limits.balance)


def not_in_stream(w: DatasetSummary) -> Iterator[Issue]:
    streamed = {(s.info.subject, s.info.session) for s in w.streams}
    for o in w.recordings:
        if not isinstance(o.info, RecordingInfo):
            continue
        # Recordings of the untouched toy have the subject nobody but are in the folder of the session's person.
        folder = o.info.id.split("/", 1)[0]
        if o.info.stream_row < 0 and (folder, o.info.session) in streamed:
            yield Issue(Message("not found in the session's stream"), about=o.info.id)
        for flag in o.info.flags:
            if flag.startswith(PARTLY_THERE):
                rows = int(flag.removeprefix(PARTLY_THERE).split()[0])
                yield Issue(Message("{flag}", flag=flag, rows=rows), about=o.info.id)


def unknown_label(w: DatasetSummary) -> Iterator[Issue]:
    if not w.dataset.gestures.has_affect:
        return
    counts = Counter(gesture_of(o) for o in w.recordings)
    for label, n in sorted(counts.items()):
        gesture = w.dataset.gestures.find(label)
        if gesture is None or gesture.affect == "none":
            name, counted = w.dataset.gestures.name, f"{n} recording{'s' if n > 1 else ''}"
            yield Issue(
                Message(
                    "the label '{label}' ({counted}) is not in the gesture set '{set}': no affect",
                    label=label,
                    counted=counted,
                    set=name,
                    n=n,
                )
            )
