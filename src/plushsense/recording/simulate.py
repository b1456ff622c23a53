"""Simulate recording sessions with the virtual toy, in the file format of the authors' recorder.

Each person's folder contains ``<label>_<epoch ms>_<rows>.csv`` for each recording, and ``fulldatastream.csv`` for the
whole session, which ends with some handling that is no gesture; recordings of the toy at rest are in the folder
``none``. The files of a scenario are such folders, too. Results on these recordings do not apply to a real toy.
"""

from __future__ import annotations

import json
import os
from array import array
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.files import new_folder
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import DEVICE_MS, Layout, load_layout
from plushsense.core.recorder_csv import (
    SIMULATION_MARK,
    STREAM_NAME,
    Frames,
    format_header,
    format_rows,
    recording_filename,
)
from plushsense.core.simulation import mark_times
from plushsense.devices.base import Counters
from plushsense.devices.virtual.motions import AT_REST
from plushsense.devices.virtual.session import GESTURES, Episode, VirtualSession
from plushsense.devices.virtual.stream import PerformedGesture, ToySpec, channel_columns, received
from plushsense.devices.virtual.world import WORLD, draw_person

START_MS = 1_760_000_000_000
"""Time of the first session in ms since 1970; fixed, so that the same seed writes the same files."""

HANDLED = 6
"""Number of times a person handles the toy after the recordings; this is no gesture, and only in the stream."""

MISSING = dict(zip(GESTURES, (3, 2, 2, 0, 1, 1, 2, 1, 2, 0, 3, 3, 2, 1, 1, 1, 0), strict=True))
"""Recordings that the authors' archive lacks of each gesture, of 3 by each of 25 people, by the counts they printed."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class SimulationResult:
    """Size of a simulated data set; ``lost`` counts frames."""

    folder: str
    people: int
    recordings: int
    rows: int
    stream_rows: int
    lost: int
    seed: int


@dataclass(frozen=True)
class _Take:
    """Simulated session: all received frames, label and rows of each recording, and the number of lost frames."""

    frames: Frames
    cuts: list[tuple[str, int, int]]
    lost: int


def repetitions_made(label: str, people: int, repetitions: int, seed: int) -> list[int]:
    """Return how often each person makes a gesture: ``repetitions``, less the recordings that are missing.

    Missing is the same share as in the authors' archive, rounded down, so that no recording of a small data set is;
    which ones are depends on the seed.
    """
    takes = people * repetitions
    rng = np.random.default_rng([seed, GESTURES.index(label), 0x1301])
    missing = rng.choice(takes, MISSING[label] * takes // 75, replace=False)
    return [repetitions - int(n) for n in np.bincount(missing % people, minlength=people)]


def _session(who: int | None, seed: int, parts: Sequence[tuple[str, int]], layout: Layout) -> _Take:
    """Simulate a session, with lost frames and the host's time; ``who`` is None for the toy at rest.

    ``parts`` are labels and the number of recordings of each.
    """
    person = None if who is None else draw_person(who, seed, WORLD)
    session = VirtualSession(person, seed, 0, WORLD)
    episodes = [session.idle(2.0)]
    episodes += [session.perform(label, times) for label, times in parts if times]
    episodes.append(session.idle(2.0))
    number = 0 if who is None else who + 1
    order = 40 if who is None else who
    rng = np.random.default_rng([seed, number, 0xF11E])
    frames, row_of, lost = _receive(episodes, START_MS + order * 86_400_000, True, layout, rng)
    if who is not None:
        # Use another random generator, so that the recordings do not depend on the handling.
        handling = [e for _ in range(HANDLED) for e in (session.handle(), session.idle(2.0))]
        after = int(frames.host_ms[-1]) if frames.host_ms is not None else 0
        own_rng = np.random.default_rng([seed, number, 0xA4D])
        more, _, more_lost = _receive(handling, after, False, layout, own_rng)
        frames, lost = _joined(frames, more), lost + more_lost
    marks = [m for e in episodes for m in e.marks]
    cuts = [(m.label, int(row_of[m.record_start]), int(row_of[m.record_stop])) for m in marks]
    return _Take(frames, cuts, lost)


def _receive(
    episodes: Sequence[Episode], host_ms: int, first: bool, layout: Layout, rng: np.random.Generator
) -> tuple[Frames, NDArray[np.int64], int]:
    """Return the received frames, for each sent row (and the end) the index among them, and the number of lost frames.

    Their times are marked as simulated (`mark_times`).
    The frames begin at ``host_ms``; if they are the ``first`` of a session, at a random time of that day.
    """
    values = np.concatenate([e.values for e in episodes])[:, channel_columns(layout)]
    device_ms = np.concatenate([e.device_ms for e in episodes])
    # The recorder writes the last integer of a line unchanged, which is a delay for firmware without a clock.
    written = device_ms if DEVICE_MS in layout.wire else np.concatenate([e.delay_ms for e in episodes])
    arrives = rng.random(len(values)) >= WORLD.lost + WORLD.garbled
    begin = host_ms + (int(rng.integers(0, 20_000_000)) if first else 10)
    # The host's clock drifts a little, and frames arrive 0 to 6 ms late.
    passed = (device_ms - device_ms[0]) * (1.0 + 4e-5 * rng.standard_normal())
    host = mark_times(begin + np.rint(passed).astype(np.int64), values)
    row_of = np.concatenate(([0], np.cumsum(arrives)))
    return Frames(values[arrives], written[arrives], host[arrives]), row_of, int(np.sum(~arrives))


def _joined(one: Frames, other: Frames) -> Frames:
    assert one.host_ms is not None and other.host_ms is not None
    return Frames(
        np.concatenate([one.values, other.values]),
        np.concatenate([one.device_ms, other.device_ms]),
        np.concatenate([one.host_ms, other.host_ms]),
    )


def _write(folder: Path, take: _Take, layout: Layout) -> int:
    """Write the stream and the recordings of one session; return the number of rows of the recordings."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = 0
    host = take.frames.host_ms
    for label, start, stop in take.cuts:
        part = take.frames.slice(start, stop)
        saved_ms = (int(host[stop - 1]) if host is not None else 0) + 25
        text = format_header(layout) + format_rows(part, layout)
        (folder / recording_filename(label, saved_ms, len(part))).write_text(text, encoding="utf-8", newline="\n")
        rows += len(part)
    with (folder / STREAM_NAME).open("w", encoding="utf-8", newline="\n") as file:
        for start in range(0, len(take.frames), 20_000):
            file.write(format_rows(take.frames.slice(start, start + 20_000), layout))
    return rows


@dataclass(frozen=True)
class SimulationSpec:
    """Size of a simulated data set, by default that of the authors' archive.

    This has 25 people × 17 gestures × 3, of which 25 recordings are missing, and 51 at rest: 1301.

    Attributes:
        people, repetitions: the number of people, and of recordings of each gesture by each of them. From 25 recordings
            of a gesture on, a few are missing (`repetitions_made`).
        seed: the same seed writes the same files.
        at_rest: number of recordings without a person; by default the share of the paper, gestures × repetitions for 25
            people, but at least 3.
        gestures: a subset of the 17, in class order.
        layout: the layout of the files: plush-15, plush-14 or accel-3.

    Raises:
        ConfigError: for a number out of range or an unknown gesture.
    """

    people: int = 25
    seed: int = 1
    repetitions: int = 3
    at_rest: int | None = None
    gestures: tuple[str, ...] = GESTURES
    layout: Layout | str = "plush-15"

    def __post_init__(self) -> None:
        unknown = [label for label in self.gestures if label not in GESTURES]
        if unknown:
            raise ConfigError(f"The virtual people know no gesture '{unknown[0]}'; they know {', '.join(GESTURES)}.")
        for name, low, high in (("people", 1, 9999), ("repetitions", 1, 1000), ("seed", 0, 2**31)):
            if not low <= (value := getattr(self, name)) <= high:
                raise ConfigError(f"{name} is {value}; a whole number from {low} to {high} is accepted.")


def simulate(
    out: str | os.PathLike[str], spec: SimulationSpec | None = None, progress: Progress | None = None
) -> SimulationResult:
    """Write a simulated data set.

    Args:
        out: a new or empty folder; the folders of people are ``P01`` …, that of the toy at rest ``none``.
        spec: its size.
        progress: called with (sessions done, number of sessions, folder just written).

    Raises:
        DatasetError: if the folder is not empty.
    """
    spec = spec or SimulationSpec()
    people, seed, repetitions, labels = spec.people, spec.seed, spec.repetitions, spec.gestures
    resting = max(3, round(len(labels) * repetitions * people / 25)) if spec.at_rest is None else spec.at_rest
    layout = spec.layout if isinstance(spec.layout, Layout) else load_layout(spec.layout)
    width = max(2, len(str(people)))
    made = {label: repetitions_made(label, people, repetitions, seed) for label in labels}
    sessions: dict[str, tuple[int | None, list[tuple[str, int]]]] = {
        f"P{who + 1:0{width}d}": (who + 1, [(label, made[label][who]) for label in labels]) for who in range(people)
    }
    if resting > 0:
        sessions[NOBODY] = None, [(AT_REST, resting)]
    recordings = rows = stream_rows = lost = 0
    # Write the folder completely or not at all: an incomplete one would look like a small data set.
    with new_folder(Path(out), DatasetError) as work:
        mark = f"Recordings of the virtual toy, seed {seed}. Nobody touched anything.\n"
        (work / SIMULATION_MARK).write_text(mark, "utf-8")
        for done, (name, (who, parts)) in enumerate(sessions.items(), 1):
            take = _session(who, seed, parts, layout)
            rows += _write(work / name, take, layout)
            recordings += len(take.cuts)
            stream_rows += len(take.frames)
            lost += take.lost
            if progress is not None:
                progress(done, len(sessions), name)
    return SimulationResult(str(Path(out)), people, recordings, rows, stream_rows, lost, seed)


RECORDED = "recordings"
TRUTH = "truth.jsonl"
"""Names of the people's folders and of the true gestures in the folder of a scenario."""


@dataclass(frozen=True)
class PlayResult:
    """What `play_to_folder` has written: the true gestures, and what a reader of the toy counts."""

    folder: str
    people: tuple[int, ...]
    gestures: int
    seconds: float
    counters: Counters

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return asdict(self)


def play_to_folder(spec: ToySpec, out: str | os.PathLike[str], layout: Layout | str = "plush-15") -> PlayResult:
    """Play the scenario of a virtual toy into a folder, as its lines are read without waiting.

    ``fulldatastream.csv`` is the whole stream (``replay://OUT``), ``truth.jsonl`` has the true gestures, and
    ``recordings/`` a folder for each person, to import: the rows received while this person had the toy as a session's
    stream, and a recording of each true gesture, from its first to its last sample.

    Args:
        spec: a toy with a scenario.
        out: a new or empty folder.

    Raises:
        ConfigError: for a toy without a scenario, or a layout that the virtual toy does not support.
        DatasetError: if the folder is not empty.
    """
    if spec.scenario is None:
        raise ConfigError("A toy that is played into a folder needs an end: give it a scenario.")
    resolved = layout if isinstance(layout, Layout) else load_layout(layout)
    with new_folder(Path(out), DatasetError) as work:
        log = _PlayLog()
        for line, frames, counters in received(spec, resolved):
            log.counters, log.passed_ms = counters, line.passed_ms
            if line.begins is not None:
                log.truth.append(line.begins)
            for frame in frames:
                log.rows.extend((line.person, START_MS + line.passed_ms, frame.device_ms, *frame.values))
        stream, people = log.received(resolved)
        mark = f"Scenario '{spec.scenario.name}' of the virtual toy, seed {spec.seed}. Nobody touched anything.\n"
        (work / SIMULATION_MARK).write_text(mark, "utf-8")
        truth = "".join(json.dumps(made.to_dict(), ensure_ascii=False) + "\n" for made in log.truth)
        (work / TRUTH).write_text(truth, encoding="utf-8", newline="\n")
        _write(work, _Take(stream, [], 0), resolved)
        everybody = np.unique(people).tolist()
        for who in everybody:
            mine = people == who
            take = _Take(_rows_of(stream, mine), log.cuts(who, stream, mine), 0)
            _write(work / RECORDED / f"P{who:02d}", take, resolved)
    return PlayResult(str(out), tuple(everybody), len(log.truth), log.passed_ms / 1000.0, log.counters)


class _PlayLog:
    """What a reader receives from a toy that plays a scenario.

    ``rows`` has, one after another, person, time of arrival, the toy's clock and the values of each frame. It is an
    array because an afternoon has more than a million frames.
    """

    def __init__(self) -> None:
        self.rows = array("q")
        self.truth: list[PerformedGesture] = []
        self.counters = Counters()
        self.passed_ms = 0

    def received(self, layout: Layout) -> tuple[Frames, NDArray[np.int64]]:
        """Return the frames, and the number of the person (T,) who had the toy at each."""
        table = np.frombuffer(self.rows, dtype=np.int64).reshape(-1, 3 + layout.n_channels)
        return Frames(table[:, 3:], table[:, 2], mark_times(table[:, 1], table[:, 3:])), table[:, 0]

    def cuts(self, who: int, stream: Frames, mine: NDArray[np.bool_]) -> list[tuple[str, int, int]]:
        """Return label and rows, of this person's stream, of each gesture of which anything was received."""
        assert stream.host_ms is not None
        passed = stream.host_ms[mine] - START_MS
        spans = [
            (made.label, *np.searchsorted(passed, np.array([made.start_s, made.end_s + 1e-4]) * 1000.0).tolist())
            for made in self.truth
            if made.person == who
        ]
        return [(label, start, stop) for label, start, stop in spans if stop > start]


def _rows_of(frames: Frames, chosen: NDArray[np.bool_]) -> Frames:
    assert frames.host_ms is not None
    return Frames(frames.values[chosen], frames.device_ms[chosen], frames.host_ms[chosen])
