"""Every check finds the fault that is planted for it, there and nowhere else, and keeps silent on clean recordings."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.cli.check import overview
from plushsense.core.errors import ConfigError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import (
    Frames,
    format_header,
    format_rows,
    read_recording,
    read_stream,
    recording_filename,
)
from plushsense.core.row_times import kept_rows
from plushsense.dataset.importing.guessing import guess_pattern
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.quality.checking import CHECKS, Check, CheckReport, check
from plushsense.dataset.quality.findings import CheckLimits, Issue
from plushsense.dataset.quality.measurements import Examination, backward_steps, rows_at_one_time
from plushsense.dataset.store import Dataset
from plushsense.recording.simulate import SimulationSpec, simulate
from plushsense.studio.app.words import Words
from plushsense.windows.cut import recordings_in_time

pytestmark = pytest.mark.apart("real-recordings")

PLUSH = load_layout("plush-15")
LABELS = ("Back stroke 1", "Head stroke 1", "Tail tap 1", "Hold strong")
TOUCHED = (8, 3, 7, 9)
PEOPLE = ("P1", "P2", "P3", "P4")
TIMES = 4
START = 1_700_000_000_000


def session(person: int) -> tuple[Frames, list[tuple[str, int, int]]]:
    """A session without a fault: rest, gesture, rest, …; and where each recording of which gesture lies."""
    rng = np.random.default_rng(person)
    marks, at = [], 0
    for _ in range(TIMES):
        for label in LABELS:
            rows = int(rng.integers(280, 320))
            marks.append((label, at + 300, at + 300 + rows))
            at += 300 + rows
    rows = at + 300
    level = np.array([500, 300, 100, 120, 140, 80, 90, 60, 110, 130, 200, -300, 16000])
    values = np.tile(level, (rows, 1)) + rng.normal(0, 4, (rows, 13))
    for label, first, last in marks:
        t = np.linspace(-0.25, 1.25, last - first)
        touch = np.where((t > 0) & (t < 1), np.sin(np.pi * np.clip(t, 0, 1)) ** 2, 0.0)
        touch = touch * (1 + 0.4 * np.sin(2 * np.pi * (8 * t + rng.random())))
        strength = rng.uniform(0.8, 1.2)
        values[first:last, TOUCHED[LABELS.index(label)]] += 900 * strength * touch
        values[first:last, 0] += 500 * strength * touch
        for c in (10, 11, 12):
            values[first:last, c] += 800 * strength * touch * np.sin(2 * np.pi * (6 * t + rng.random()))
    clock = 5000 + np.arange(rows) * 10
    return Frames(np.rint(values).astype(np.int64), clock, START + person * 10**8 + clock), marks


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    src = tmp_path_factory.mktemp("quality")
    for person, name in enumerate(PEOPLE):
        (src / "src" / name).mkdir(parents=True)
        frames, marks = session(person)
        (src / "src" / name / "fulldatastream.csv").write_text(format_rows(frames, PLUSH), newline="\n")
        for label, first, last in marks:
            part = frames.slice(first, last)
            assert part.host_ms is not None
            path = src / "src" / name / recording_filename(label, int(part.host_ms[-1]), len(part))
            path.write_text(format_header(PLUSH) + format_rows(part, PLUSH), newline="\n")
    gestures = GestureSet("four", tuple(Gesture(label, "positive") for label in LABELS))
    done = import_recordings(src / "src", src / "DS", layout=PLUSH, gestures=gestures)
    assert done.recordings == len(PEOPLE) * len(LABELS) * TIMES
    assert done.messages == (), "a clean session is imported without a warning"
    return src / "DS"


@pytest.fixture
def copy(clean: Path, tmp_path: Path) -> Path:
    shutil.copytree(clean, tmp_path / "DS")
    return tmp_path / "DS"


@pytest.fixture(scope="module")
def on_clean(clean: Path) -> CheckReport:
    return check(open_dataset(clean))


@pytest.mark.parametrize("name", list(CHECKS))
def test_a_clean_recording_is_left_alone(name: str, on_clean: CheckReport) -> None:
    assert name in on_clean.checks
    assert [f.message for f in on_clean.findings_of(name)] == []


def test_only_what_was_asked_for_is_looked_at(clean: Path) -> None:
    result = check(open_dataset(clean), only=["gaps", "duration"], limits=CheckLimits(duration=0.001))
    assert result.checks == ("gaps", "duration")
    assert {f.check for f in result.findings} == {"duration"}
    with pytest.raises(ConfigError, match="no check 'gap'.*Did you mean 'gaps'"):
        check(open_dataset(clean), only=["gap"])


# Planting -------------------------------------------------------------------------------------------------------


def recording(folder: Path, number: int = 5, label: str = "Head stroke 1", person: str = "P2") -> Path:
    """One recording's file; the same each time."""
    return sorted((folder / "recordings" / person).glob(f"{label}_*.csv"))[number % TIMES]


def rewrite(path: Path, text: str) -> None:
    """Give a raw file another content, as if it had been imported so: without the stamp, which would refuse it."""
    path.write_text(text, newline="\n")
    (path.parents[2] / "index.json").unlink(missing_ok=True)


def change(path: Path, how: Callable[[Frames], Frames]) -> str:
    """Rewrite a recording or stream with ``how`` applied: what finds it is the id."""
    kind = path.parents[1].name
    read = (read_stream if kind == "streams" else read_recording)(path, PLUSH).frames
    head = "" if kind == "streams" else format_header(PLUSH)
    rewrite(path, head + format_rows(how(read), PLUSH))
    return path.relative_to(path.parents[1]).with_suffix("").as_posix()


def with_values(at: slice | np.ndarray, channel: int | slice, value: object) -> Callable[[Frames], Frames]:
    def how(frames: Frames) -> Frames:
        values = frames.values.copy()
        values[at, channel] = value
        return replace(frames, values=values)

    return how


def renamed(path: Path, rows: int) -> Path:
    """The same file under a name that says its true number of rows."""
    return path.rename(path.with_name(path.name.rsplit("_", 1)[0] + f"_{rows}.csv"))


def later(frames: Frames, row: int, device: int, host: int | None = None) -> Frames:
    """Everything from ``row`` on comes later by so many ms."""
    shift = (np.arange(len(frames)) >= row).astype(np.int64)
    assert frames.host_ms is not None
    return replace(
        frames,
        device_ms=frames.device_ms + shift * device,
        host_ms=frames.host_ms + shift * (device if host is None else host),
    )


def join(*parts: Frames) -> Frames:
    """Recordings one after another, 10 ms apart."""
    values = np.concatenate([p.values for p in parts])
    clock = parts[0].device_ms[0] + np.arange(len(values)) * 10
    assert parts[0].host_ms is not None
    return Frames(values, clock, clock - clock[0] + parts[0].host_ms[0])


Plant = Callable[[Path], str]
"""Plants a fault in a copy of the data set, and returns the id of what the check must find."""


def in_recording(how: Callable[[Frames], Frames], *, name: bool = False) -> Plant:
    """Change a recording; with ``name``, its name states the number of rows that it has then."""

    def plant(folder: Path) -> str:
        path = recording(folder)
        change(path, how)
        if name:
            path = renamed(path, len(read_recording(path, PLUSH).frames))
        return path.relative_to(folder / "recordings").with_suffix("").as_posix()

    return plant


def in_stream(how: Callable[[Frames], Frames], person: str = "P2") -> Plant:
    return lambda folder: change(folder / "streams" / person / "fulldatastream.csv", how)


def at_times(clock: Callable[[np.ndarray], np.ndarray]) -> Plant:
    return in_recording(lambda f: replace(f, device_ms=clock(f.device_ms)))


def rows_of(frames: Frames, rows: Sequence[int] | np.ndarray) -> Frames:
    assert frames.host_ms is not None
    return Frames(frames.values[rows], frames.device_ms[rows], frames.host_ms[rows])


def overtaken(frames: Frames) -> Frames:
    order = np.arange(len(frames))
    order[100:108] = [107, *range(100, 107)]
    return replace(rows_of(frames, order), host_ms=frames.host_ms)


def add_to_channel(frames: Frames, channel: int, more: np.ndarray) -> Frames:
    return with_values(slice(None), channel, frames.values[:, channel] + more.astype(np.int64))(frames)


def zeroed(folder: Path) -> str:
    """Turn the toy, so that one axis reaches below -2000, and write 0 for such values as the authors' recorder does."""

    def how(frames: Frames) -> Frames:
        values = frames.values.copy()
        values[:, 11] -= 1600
        return replace(frames, values=np.where(values < -2000, 0, values))

    for path in [*(folder / "recordings").rglob("*.csv"), *(folder / "streams").rglob("*.csv")]:
        change(path, how)
    return ""


def drifting_without_stream(folder: Path) -> str:
    (folder / "streams" / "P3" / "fulldatastream.csv").unlink()
    for path in (folder / "recordings" / "P3").glob("*.csv"):
        epoch = int(path.name.split("_")[1])
        passed = (epoch - START - 2 * 10**8) / 100
        change(path, lambda f, by=passed: with_values(slice(None), 3, f.values[:, 3] + int(by * 3))(f))
    return "P3"


def malformed(folder: Path) -> str:
    path = recording(folder)
    lines = path.read_text().splitlines(keepends=True)
    lines[30] = lines[30][:7] + "\n"
    rewrite(path, "".join(lines))
    return path.relative_to(folder / "recordings").with_suffix("").as_posix()


def duplicate(folder: Path) -> str:
    path = recording(folder, label="Tail tap 1")
    target = path.with_name(path.name.replace("Tail tap 1", "zz"))
    target = path.parents[1] / "P4" / recording(folder, 2, "Tail tap 1", "P4").name
    frames = read_recording(path, PLUSH).frames
    moved = replace(frames, device_ms=frames.device_ms + 999, host_ms=frames.device_ms + START)
    target.write_text(format_header(PLUSH) + format_rows(moved, PLUSH), newline="\n")
    target = renamed(target, len(moved))
    return target.relative_to(folder / "recordings").with_suffix("").as_posix()


def copied_inside(folder: Path) -> str:
    taken = read_recording(recording(folder, label="Tail tap 1"), PLUSH).frames.values[100:]
    return change(recording(folder, 2, "Tail tap 1", "P4"), with_values(slice(30, 30 + len(taken)), slice(None), taken))


def overlapping(folder: Path) -> str:
    path = recording(folder)
    stream = read_stream(folder / "streams" / "P2" / "fulldatastream.csv", PLUSH).frames
    frames = read_recording(path, PLUSH).frames
    first = int(np.flatnonzero(stream.device_ms == frames.device_ms[0])[0])
    both = stream.slice(first + 100, first + 400)
    assert both.host_ms is not None
    new = path.with_name(recording_filename("Head stroke 1", int(both.host_ms[-1]), len(both)))
    new.write_text(format_header(PLUSH) + format_rows(both, PLUSH), newline="\n")
    return new.relative_to(folder / "recordings").with_suffix("").as_posix()


def of_two_devices(folder: Path) -> str:
    """Add what another device recorded of the same touch, in a session of its own."""
    path = recording(folder)
    frames = read_recording(path, PLUSH).frames
    other = Frames(frames.values[::-1].copy(), frames.device_ms - frames.device_ms[0], frames.host_ms)
    assert other.host_ms is not None
    target = path.parent / "watch" / recording_filename("Head stroke 1", int(other.host_ms[-1]), len(other))
    target.parent.mkdir()
    target.write_text(format_header(PLUSH) + format_rows(other, PLUSH), newline="\n")
    return target.relative_to(folder / "recordings").with_suffix("").as_posix()


def missing(folder: Path) -> str:
    recording(folder).unlink()
    (folder / "index.json").unlink(missing_ok=True)
    return "P2"


def two_in_one(folder: Path) -> str:
    other = read_recording(recording(folder, 6), PLUSH).frames
    return in_recording(lambda f: join(f, f.slice(0, 60), other), name=True)(folder)


def of_the_stream(first: int, last: int) -> Plant:
    """Replace a recording by some rows of its stream."""

    def plant(folder: Path) -> str:
        stream = read_stream(folder / "streams" / "P2" / "fulldatastream.csv", PLUSH).frames
        return in_recording(lambda _: stream.slice(first, last), name=True)(folder)

    return plant


def other_rows(folder: Path) -> str:
    path = renamed(recording(folder), 999)
    return path.relative_to(folder / "recordings").with_suffix("").as_posix()


def cut(folder: Path) -> str:
    path = folder / "streams" / "P2" / "fulldatastream.csv"
    rewrite(path, path.read_text() + "100; 3")
    return "P2/fulldatastream"


def with_a_level_for_each_gesture(folder: Path) -> str:
    """Add a level to channel 5 by which the gestures differ before they begin, as sessions of one gesture each do."""
    for path in (folder / "recordings").rglob("*.csv"):
        level = 40 * LABELS.index(path.name.split("_")[0])
        change(path, lambda f, by=level: add_to_channel(f, 5, np.full(len(f), by)))
    return ""


def in_one_session(folder: Path) -> str:
    """Keep one gesture of one person only, in a session of its own."""
    (folder / "recordings" / "P2" / "s9").mkdir()
    for path in sorted((folder / "recordings").rglob("Tail tap 1_*.csv")):
        if path.parent.name == "P2":
            path.rename(path.parent / "s9" / path.name)
        else:
            path.unlink()
    (folder / "index.json").unlink(missing_ok=True)
    return ""


EVERY = slice(None)
HIGHEST = [9999, 9999, 9999, 400, *[20000] * 9]
standing = at_times(lambda t: t // 10**6 * 10**6)
reset = in_recording(lambda f: later(f, 120, -6000, 10))
never_stopped = of_the_stream(300, 3900)
PLANTS: list[tuple[str, str, Plant]] = [
    ("stuck", "a channel", in_recording(lambda f: with_values(slice(100, 200), 3, f.values[100, 3])(f))),
    ("stuck", "all channels", in_recording(lambda f: with_values(slice(40, 260), EVERY, f.values[40])(f))),
    ("flat", "recording", in_recording(with_values(EVERY, 5, 77))),
    ("flat", "stream", in_stream(with_values(EVERY, 5, 77), "P3")),
    ("zeroed", "axis", zeroed),
    ("saturated", "channel", in_recording(lambda f: replace(f, values=np.minimum(f.values, HIGHEST)))),
    ("drift", "stream", in_stream(lambda f: add_to_channel(f, 3, np.linspace(0, 1500, len(f))), "P3")),
    ("drift", "recordings", drifting_without_stream),
    ("garbage", "low", in_recording(with_values(slice(50, 60), 7, -9000))),
    ("blank-rows", "rows", in_recording(with_values(slice(50, 60), EVERY, 0))),
    ("spikes", "rows", in_recording(with_values(np.arange(40, 280, 40), 11, 9000))),
    ("garbage", "failed reading", in_recording(with_values(120, 11, 8388607))),
    ("malformed", "line", malformed),
    ("rest-tells", "levels", with_a_level_for_each_gesture),
    ("one-session", "gesture", in_one_session),
    ("duplicate", "recording", duplicate),
    ("duplicate", "rows", copied_inside),
    ("overlap", "rows", overlapping),
    ("overlap", "devices", of_two_devices),
    ("missing", "recording", missing),
    ("several-gestures", "two", two_in_one),
    ("no-onset", "rest", of_the_stream(5, 295)),
    ("never-stopped", "minutes", never_stopped),
    ("too-short", "one row", in_recording(lambda f: f.slice(0, 1), name=True)),
    ("duration", "long", in_recording(lambda f: join(f, *[f.slice(0, 50)] * 4), name=True)),
    ("duration", "short", in_recording(lambda f: f.slice(80, 200), name=True)),
    ("rows", "name", other_rows),
    ("cut-line", "stream", cut),
    ("resumed", "minutes", in_stream(lambda f: later(f, 5000, 30, 300_000))),
    ("resumed", "next day", in_stream(lambda f: later(f, 5000, -40_000, 80_000_000))),
    ("clock-still", "all rows", standing),
    ("clock-still", "some rows", at_times(lambda t: t // 1000 * 1000)),
    ("clock-reset", "back", reset),
    ("clock-reset", "ahead", in_stream(lambda f: later(f, 5000, 900_000, 0))),
    ("clock-value", "unread", at_times(lambda t: np.where(np.arange(len(t)) == 100, 0, t))),
    ("out-of-order", "rows", in_recording(overtaken)),
    ("gaps", "gap", in_recording(lambda f: later(f, 120, 60))),
    (
        "lost-frames",
        "rows",
        in_recording(lambda f: rows_of(f, np.delete(np.arange(len(f)), np.arange(10, 250, 12))), name=True),
    ),
    ("rate", "slow", at_times(lambda t: t[0] + (t - t[0]) * 3)),
    ("jitter", "steps", at_times(lambda t: t + np.random.default_rng(1).integers(-4, 5, len(t)))),
    ("not-in-stream", "host", in_recording(lambda f: replace(f, host_ms=f.device_ms + START + 5 * 10**9))),
]


@pytest.mark.parametrize(("name", "plant"), [(n, p) for n, _, p in PLANTS], ids=[f"{n}: {w}" for n, w, _ in PLANTS])
def test_a_planted_fault_is_found_where_it_is(name: str, plant: Plant, copy: Path) -> None:
    about = plant(copy)
    (copy / "index.json").unlink(missing_ok=True)
    result = check(open_dataset(copy))
    found = result.findings_of(name)
    assert {f.about for f in found} == {about}, [f"{f.check} {f.about}: {f.message}" for f in result.findings]
    assert all(f.action and f.message and f.severity for f in found)
    assert all(0 <= a < b for f in found for a, b in f.rows)
    for f in result.findings:
        english, latvian = (Words(language).sentence(f.message) for language in ("en", "lv"))
        assert f.message.template and english != f.message and latvian not in (english, f.message)
        # Numbers have a decimal comma; ids of files may have points.
        assert not re.search(r"(?<![\w./])\d+\.\d", latvian), latvian


@pytest.mark.parametrize("host", [True, False])
def test_one_impossible_clock_value_is_one_finding(host: bool) -> None:
    times = 40_000 + 10 * np.arange(300)
    clock = times.copy()
    clock[[100, 200]] = 0, 90_000
    frames = Frames(np.random.default_rng(1).integers(0, 900, (300, 13)), clock, times + START if host else None)
    found = {
        name: [issue.message for issue in check.run(Examination(frames, PLUSH))]
        for name, check in CHECKS.items()
        if name.startswith("clock-") or name in ("out-of-order", "gaps", "lost-frames", "jitter", "rate")
    }
    message = "2 rows with an impossible clock value between possible ones (first row 101)"
    assert {name: messages for name, messages in found.items() if messages} == {"clock-value": [message]}


@pytest.mark.parametrize("wrong", [{100: 0, 101: 0}, {100: 0, 101: 90_000}])
def test_two_impossible_clock_values_in_turn_are_resets(wrong: dict[int, int]) -> None:
    clock = 40_000 + 10 * np.arange(300)
    clock[[*wrong]] = [*wrong.values()]
    examined = Examination(Frames(np.zeros((300, 13), dtype=np.int64), clock), PLUSH)
    assert examined.stray.tolist() == [] and [int(at) for at in examined.back[0]]


def test_buffers_whose_stamps_overlap_are_no_resets() -> None:
    """Of each, the windows leave out the first rows, several in turn, and read on."""
    clock = np.concatenate([40_000 + 80 * n + 10 * np.arange(10) - 40 * (n % 2) for n in range(40)])
    examined = Examination(Frames(np.zeros((400, 13), dtype=np.int64), clock), PLUSH)
    kept = kept_rows(clock, PLUSH.gap_ms)
    assert len(examined.back[0]) == 0 and np.diff(examined.stray).min() == 1
    assert np.array_equal(examined.times[kept], clock[kept]), "only the others are moved"
    late = 40_000 + 10 * np.arange(300)
    late[100:104] = late[[103, 100, 101, 102]]
    assert np.array_equal(Examination(Frames(np.zeros((300, 13), dtype=np.int64), late), PLUSH).times, late)


def test_rows_that_came_late_are_no_reset_of_the_clock(copy: Path) -> None:
    about = in_recording(overtaken)(copy)
    result = check(open_dataset(copy))
    assert result.findings_of("clock-reset") == []
    (found,) = result.findings_of("out-of-order")
    assert (found.about, found.message) == (
        about,
        "1 row out of order by the device clock (first row 102, by at most 70 ms)",
    )
    assert result.findings_of("gaps", "lost-frames") == [], "the place of a late row is no gap"


@pytest.mark.parametrize(
    ("times", "resets", "late"),
    [
        (np.arange(9) * 10, [], []),
        (np.array([0, 10, 30, 20, 40, 50]), [], [2]),
        (np.array([0, 10, 40, 30, 20, 50, 60]), [], [2, 3]),
        # A clock that is set back by five rows passes the same times twice.
        (np.concatenate([np.arange(20) * 10, 150 + np.arange(20) * 10]), [19], []),
        (np.concatenate([np.arange(50) * 10, np.arange(50) * 10]), [49], []),
        # After a reset, rows are late against the new time only.
        (np.array([5000, 5010, 5020, 0, 10, 30, 20, 40, 50]), [2], [5]),
    ],
)
def test_late_rows_are_told_from_resets(times: np.ndarray, resets: list[int], late: list[int]) -> None:
    assert [found.tolist() for found in backward_steps(times)] == [resets, late]


@pytest.mark.parametrize(
    ("times", "rows"),
    [
        (np.full(100, 1.5e12), 100),
        (np.full(4, 0.0), 0),
        (np.float32(1_700_000_000 + 0.01 * np.arange(300)), 300),
        (np.repeat(np.arange(6), 50), 50),
        (np.repeat(np.arange(10), 10), 0),
        (np.arange(100), 0),
        (np.array([]), 0),
    ],
)
def test_a_clock_that_stands_still_is_told_from_packets(times: np.ndarray, rows: int) -> None:
    assert rows_at_one_time(times) == rows


def test_a_clock_that_stands_still_is_not_called_too_short(copy: Path) -> None:
    standing(copy)
    assert {f.severity for f in check(open_dataset(copy), only=["clock-still"]).findings} == {"error"}
    assert check(open_dataset(copy), only=["too-short"]).findings == ()


def test_a_garbled_stamp_of_the_computer_is_no_pause(copy: Path) -> None:
    def garbled(frames: Frames) -> Frames:
        assert frames.host_ms is not None
        host = frames.host_ms.copy()
        host[[700, 900]] = 10**18, 7
        return replace(frames, host_ms=host)

    change(copy / "streams" / "P2" / "fulldatastream.csv", garbled)
    assert check(open_dataset(copy), only=["resumed"]).findings == ()


def with_ten_bits(folder: Path, *, minutes_of_rest: int) -> Path:
    """Import people of an accelerometer whose noise is below one step: waves, a tilt that is held, and rest.

    The first ``minutes_of_rest`` people have a minute of rest as well.
    """
    levels = np.array([512, 512, 620])
    source = folder / "source"
    source.mkdir()
    for person in range(4):
        rng = np.random.default_rng(person)
        labels = [("", 150), ("wave", 200), ("", 150), ("tilt", 200), ("", 150), ("rest", 200)] * 4
        labels += [("", 150), ("rest", 6000)] if person < minutes_of_rest else []
        lines = ["time_ms,label,x,y,z"]
        for label, rows in labels:
            values = levels + rng.normal(0, 0.2, (rows, 3))
            up = np.clip(np.sin(np.linspace(-0.4, np.pi + 0.4, rows)) * 2, 0, 1)[:, None]
            if label == "wave":
                values += 60 * up * np.sin(np.arange(rows) / 5)[:, None] * rng.uniform(0.5, 1, 3)
            elif label == "tilt":
                values += up * rng.integers(-200, 200, 3)
            start = 10 * (len(lines) - 1)
            lines += [f"{start + 10 * k},{label},{x},{y},{z}" for k, (x, y, z) in enumerate(values.round().astype(int))]
        (source / f"S{person}.csv").write_text("\n".join(lines) + "\n")
    pattern = (
        'paths = ["{subject}.csv"]\n[layout]\nname = "ten"\nrate_hz = 100.0\nvectors = [["x", "y", "z"]]\nchannels = ['
    )
    axes = ", ".join(
        f'{{ name = "{n}", kind = "acceleration", unit = "", valid_min = -2048, valid_max = 2048 }}' for n in "xyz"
    )
    (folder / "ten.toml").write_text(f"{pattern}{axes}]\n")
    return import_recordings(source, folder / "TEN", pattern=folder / "ten.toml").dataset.path


def test_a_coarse_sensor_at_rest_or_on_a_plateau_is_not_broken(tmp_path: Path) -> None:
    folder = with_ten_bits(tmp_path, minutes_of_rest=0)
    assert [f"{f.check} {f.about}: {f.message}" for f in check(open_dataset(folder)).findings] == []
    path = next((folder / "recordings" / "S1").rglob("wave_*.csv"))
    layout = open_dataset(folder).layout
    frames = read_recording(path, layout).frames
    values = frames.values.copy()
    values[:, 1] = 512
    rewrite(path, format_header(layout) + format_rows(replace(frames, values=values), layout))
    for index in folder.glob("index.json"):
        index.unlink()
    assert [f.check for f in check(open_dataset(folder), only=["flat"]).findings] == ["flat"]


def test_a_minute_of_rest_of_everybody_was_not_forgotten(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    one = open_dataset(with_ten_bits(tmp_path / "one", minutes_of_rest=1))
    assert [f.subject for f in check(one, only=["never-stopped", "duration"]).findings] == ["S0"]
    every = open_dataset(with_ten_bits(tmp_path, minutes_of_rest=3))
    assert check(every, only=["never-stopped", "duration"]).findings == ()
    assert len(recordings_in_time(list(every.recordings))) == len(every.recordings)


def test_every_check_has_a_planted_fault() -> None:
    counted = {"label", "class-balance", "subject-balance"}
    assert {name for name, *_ in PLANTS} | counted == set(CHECKS)


def test_balance_and_labels_are_counted_over_the_data_set(copy: Path) -> None:
    for path in [*(copy / "recordings" / "P4").glob("*.csv")][2:]:
        path.unlink()
    for n, path in enumerate(sorted((copy / "recordings" / "P3").glob("Hold*.csv"))):
        path.rename(path.with_name(path.name.replace("Hold strong", "Waving")))
        assert n < TIMES
    for path in [*(copy / "recordings").glob("P[12]/Hold*.csv")][:6]:
        path.unlink()
    (copy / "index.json").unlink(missing_ok=True)
    said = {f.check: f for f in check(open_dataset(copy)).findings}
    assert "P4 2" in said["subject-balance"].message
    assert "Hold strong" in said["class-balance"].message
    assert "'Waving' (4 recordings)" in said["label"].message
    assert said["label"].about == ""


def test_what_asks_for_a_decision_is_an_error(copy: Path) -> None:
    reset(copy)
    result = check(open_dataset(copy))
    assert not result.ok
    (asked,) = result.undecided
    assert (asked.check, asked.severity) == ("clock-reset", "error")
    append_marks(copy, [Mark(asked.recording, "exclude", "x", "a fall")])
    after = check(open_dataset(copy))
    assert after.ok
    assert (after.recordings, after.excluded) == (result.recordings - 1, 1)
    assert not [f for f in after.findings if f.recording == asked.recording], "what is excluded is not looked at"


def test_a_trimmed_recording_is_judged_by_what_remains(copy: Path) -> None:
    about = never_stopped(copy)
    (copy / "index.json").unlink(missing_ok=True)
    append_marks(copy, [Mark(about, "trim", "x", start=0, stop=300)])
    result = check(open_dataset(copy))
    assert result.findings_of("never-stopped", "rows", "several-gestures") == []


def test_the_mean_is_over_recordings_that_were_stopped(copy: Path) -> None:
    """One of 10 times the length would pull a plain mean until half of the others lie outside ±40 %."""
    never_stopped(copy)
    (copy / "index.json").unlink(missing_ok=True)
    assert check(open_dataset(copy)).findings_of("duration") == []


def test_what_is_true_of_nearly_all_is_said_once(copy: Path) -> None:
    for path in (copy / "recordings").rglob("*.csv"):
        change(path, lambda f: replace(f, device_ms=f.device_ms[0] + (f.device_ms - f.device_ms[0]) * 2))
    (rate,) = check(open_dataset(copy)).findings_of("rate")
    assert rate.about == ""
    assert "so in 64 of 64 recordings" in rate.message


def test_accepted_findings_stay_but_do_not_count(copy: Path) -> None:
    about = reset(copy)
    append_marks(copy, [Mark(about, "accept", "x", "known", check="clock-reset")])
    result = check(open_dataset(copy))
    (found,) = result.findings_of("clock-reset")
    assert found.accepted
    assert result.ok
    assert result.counts()["accepted"] == {"clock-reset": 1}
    assert result.counts()["by_check"].get("clock-reset") is None


def test_a_gesture_of_free_choice_is_compared_within_a_person(copy: Path) -> None:
    head = (copy / "dataset.toml").read_text()
    at = head.index('label = "Hold strong"')
    free = head[at:].replace("free_choice = false", "free_choice = true", 1)
    (copy / "dataset.toml").write_text(head[:at] + free)
    for path in (copy / "recordings" / "P1").glob("Hold*.csv"):
        change(path, lambda f: join(f, f, f))
        renamed(path, len(read_recording(path, PLUSH).frames))
    (copy / "index.json").unlink(missing_ok=True)
    assert check(open_dataset(copy)).findings_of("duration", "missing") == []


def test_bursts_are_no_gaps(copy: Path) -> None:
    """Frames that a phone stamps several at once: a wait of 60 ms that the next ones make up for is none."""

    def how(frames: Frames) -> Frames:
        late = frames.device_ms // 70 * 70
        return replace(frames, device_ms=late)

    about = change(recording(copy), how)
    result = check(open_dataset(copy))
    assert result.findings_of("gaps", "lost-frames", "rate") == []
    assert [f.about for f in result.findings_of("jitter")] == [about]
    change(recording(copy), lambda f: later(f, 150, 400))
    assert [f.about for f in check(open_dataset(copy)).findings_of("gaps")] == [about]


def test_simulated_sessions_raise_no_alarm(tmp_path: Path) -> None:
    simulate(tmp_path / "src", SimulationSpec(people=3, repetitions=3, at_rest=4))
    dataset: Dataset = import_recordings(tmp_path / "src", tmp_path / "DS", layout="plush-15").dataset
    result = check(dataset)
    assert result.ok
    # The virtual people's tempo varies, and their toy sends a garbled value now and then.
    assert {f.check for f in result.findings if f.severity == "warning"} <= {"duration"}
    assert len(result.findings_of("duration")) <= 8
    assert {f.check for f in result.findings if f.severity == "info"} <= {"duration", "garbage"}


def test_the_real_recordings_known_faults_are_found(real_data: Path, imported_study: Any) -> None:
    result = check(imported_study.dataset)
    assert [f.recording for f in result.findings_of("never-stopped")] == ["P22/Forehand Tennis_1589429213972_18907"]
    assert {f.recording for f in result.findings_of("clock-reset") if f.recording} == {
        "P27/Jumping Jack_1589674214418_191"
    }
    assert len({f.recording for f in result.findings_of("gaps") if f.recording}) == 16
    assert {f.subject for f in result.findings_of("rate")} == {"P09", "P10", "P16", "P19"}
    assert len({f.recording for f in result.findings_of("rate") if f.recording}) == 4 * 55
    ends = {p.parent.name for p in (real_data / "makeability-gestures").glob("*/fulldatastream.csv") if _is_cut(p)}
    assert {f.subject for f in result.findings_of("cut-line")} == ends
    assert {f.subject for f in result.findings_of("resumed")} == {"P04", "P05", "P06", "P12", "P25", "P27"}
    assert {(f.check, f.recording) for f in result.undecided} == {
        ("never-stopped", "P22/Forehand Tennis_1589429213972_18907"),
        ("clock-reset", "P27/Jumping Jack_1589674214418_191"),
    }


def _is_cut(path: Path) -> bool:
    return not path.read_bytes().endswith(b"\n")


def test_the_page_lists_every_check_of_the_registry() -> None:
    page = (Path(__file__).parents[3] / "docs" / "checks.md").read_text(encoding="utf-8")
    table = page.partition("| check | applies to |")[2].partition("\n\n")[0]
    listed = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert [name for cell in listed for name in re.findall(r"`([a-z-]+)`", cell)] == list(CHECKS)
    assert {re.findall(r"`([a-z-]+)`", cell)[0] for cell in listed if "*import*" in cell} == {
        name for name, check in CHECKS.items() if check.at_import
    }


def test_a_check_is_one_function_and_one_line(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def long(examined: Examination) -> Iterator[Issue]:
        if len(examined.frames) > 10:
            yield Issue("holds more than 10 rows")

    monkeypatch.setitem(CHECKS, "long", Check(long, ("recording",), "error", "exclude it", at_import=True))
    (copy / "index.json").unlink(missing_ok=True)
    dataset = open_dataset(copy)
    result = check(dataset, only=["long"])
    assert all("holds more than 10 rows" in r.flags for r in dataset.recordings)
    assert result.counts()["by_check"] == {"long": 1}, "a finding about nearly every recording is reported once"
    assert "long" in "\n".join(overview(result))


def test_rest_with_a_label_of_its_own_tells_the_gesture_of_a_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for person in range(3):
        for kind, name in enumerate(("press", "wipe", "tap")):
            touch = np.repeat([0.0, 1.0] * 4, 60)[:, None] * rng.normal(30, 8, (480, 3))
            touch *= np.tile(1 + np.sin(np.linspace(0, 12, 60)), 8)[:, None]
            values = 400 + 60 * kind + rng.normal(0, 2, (480, 3)) + touch
            rows = ["time_ms,a,b,c,label"]
            rows += [
                f"{10 * i},{v[0]:.0f},{v[1]:.0f},{v[2]:.0f},{name if i // 60 % 2 else 'rest'}"
                for i, v in enumerate(values)
            ]
            (tmp_path / f"SRC/P{person}").mkdir(parents=True, exist_ok=True)
            (tmp_path / f"SRC/P{person}/{name}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    pattern = guess_pattern(tmp_path / "SRC").pattern
    # With an idle label, rest is only in the stream.
    for name, idle in (("DS", ()), ("IDLE", ("rest",))):
        done = import_recordings(tmp_path / "SRC", tmp_path / name, pattern=replace(pattern, idle=idle))
        found = check(done.dataset, only=["rest-tells"]).findings
        assert [float(str(f.message).split("tells ")[1].split()[0]) > 80 for f in found] == [True], name
