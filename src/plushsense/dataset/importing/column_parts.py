"""Guess which columns of tables are time, person, label, take and channels, and what the channels are."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plushsense.core.gestures import alike_labels, plain_label
from plushsense.core.layouts import MOST_CALIBRATED, MOST_CALIBRATED_OTHER
from plushsense.core.sentences import Message, join_names
from plushsense.dataset.importing.columns import (
    CODE_NAMES,
    MOST_CODES,
    SampledColumn,
    TableForm,
    is_number,
    named_column,
    stated_rate,
)
from plushsense.dataset.importing.counters import CLOCK, COUNTER, Floats, no_reading
from plushsense.dataset.importing.path_parts import COLUMN, MOST_LABELS, PathParts
from plushsense.dataset.importing.pattern import INTERVAL, LABELS, ROLES, UNITS
from plushsense.dataset.importing.table_files import unit_of_time
from plushsense.dataset.quality.measurements import rows_at_one_time

USUAL_HZ = 50.0
LABEL_NAMES = ("label", "gesture", "activity", *LABELS)
_FEW = 5
_MOST_STEPS = 1e7
_IDLE_LABELS = frozenset(("0", "null", "null class", "none", "idle", "nothing", "background", "no gesture", "noise"))
_PERSON_NAMES = ("subject", "participant", "person", "user", "child", "who")
# acc_x, x_acc, accX, aX, Accelerometer_x, and x, y, z alone; not accuracy.
_ACCELERATION = re.compile(r"(?<![a-z])(acc(?!u)|accel|a_?[xyz](?![a-z]))|acc(el)?_?[xyz]?$|^[xyz](_\d+)?$")
_RATE = "angular rate"
_ANGULAR = re.compile(
    r"(?<![a-z])(gyro(scope)?|gyr|angular|rotation_?rate)(?![a-z])|(?<![a-z])(gyro?|g)_?[xyz](?![a-z])"
)
_MANY_COLUMNS = 20
_AXES = ({"x", "y", "z"}, {"0", "1", "2"})
_NO_CHANNEL = re.compile(r"index|row|frame|sample|no|nr|id|count_?er|unnamed.*|#", re.IGNORECASE)
_TAKE = re.compile(r"(^|_)(id|sample|take|trial|rep|repetition|recording|segment|window|block|session)", re.IGNORECASE)
# Objects around channels in JSON that say nothing about them.
_AROUND = re.compile(r"^((recordings|payload|data|sensors|values|samples)\.(?!\d+$))+")


@dataclass(frozen=True)
class GuessSpec:
    """Settings of a guess: what the caller states about the files, which is then not guessed.

    Attributes:
        parts: for ``subject``, ``session``, ``label``, ``recording`` and ``time``, the key of its `Candidate`; "" if it
            is nowhere (default: all are guessed).
        channels: keys of the columns that are channels (default: guessed).
        time_unit: unit of times, see `ImportPattern` (default: guessed).
        rate_hz: rows a second of files without a clock (default: guessed).
        separator: one character between columns (default: guessed).
        decimal: sign before the decimals (default: guessed).
        idle: labels that mean that nothing happens.
        name: name of the layout (default: that of the source).
        recorded: whether files that are named as those of the GestureRecorder are guessed, too, as from other sensors.
    """

    parts: Mapping[str, str] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    time_unit: str = ""
    rate_hz: float = 0.0
    separator: str = ""
    decimal: str = ""
    idle: tuple[str, ...] = ()
    name: str = ""
    recorded: bool = False


@dataclass
class PatternDraft:
    """The keys, columns, channels and doubts of the pattern being guessed, filled in step by step."""

    keys: dict[str, Any] = field(default_factory=dict)
    taken: set[str] = field(default_factory=set)
    """Parts that have a column."""
    columns: dict[str, str] = field(default_factory=dict)
    roles: dict[str, str] = field(default_factory=dict)
    """What columns are taken for, by their key."""
    channels: list[dict[str, Any]] = field(default_factory=list)
    vectors: list[list[str]] = field(default_factory=list)
    labels: Counter[str] = field(default_factory=Counter)
    rate_hz: float = 0.0
    time_unit: str = ""
    times: list[Floats] = field(default_factory=list)
    """The time of each row of each file or recording; empty without a clock."""
    codes: dict[str, SampledColumn] = field(default_factory=dict)
    """Columns of whole numbers that change rarely."""
    is_json: bool = False
    width: int = 1
    separator: str = ""
    form: TableForm | None = None
    given: GuessSpec = field(default_factory=GuessSpec)
    doubts: list[Message] = field(default_factory=list)

    def doubt(self, template: str, about: str, **values: object) -> None:
        """Add what a person should check."""
        self.doubts.append(Message(template, about=about, **values))


def ends_in(key: str, end: str) -> bool:
    """Return whether the path of a value in JSON ends in ``end``."""
    return key == end or key.endswith(f".{end}")


def guess_columns(columns: list[SampledColumn], guess: PatternDraft) -> None:
    """Decide which columns are time, person, label and channels."""
    given = guess.given
    fixed = {part: c for part, key in given.parts.items() for c in columns if key == f"{COLUMN}:{c.key}"}
    chosen = [c for c in columns if f"{COLUMN}:{c.key}" in given.channels and c.is_numeric and not c.of_recording]
    left = [c for c in columns if c not in fixed.values() and c not in chosen]

    def take(role: str, column: SampledColumn | None) -> SampledColumn | None:
        column = fixed.get(role) if role in given.parts else column
        if column is not None:
            left[:] = [c for c in left if c is not column]
            guess.taken.add(role)
            guess.roles[column.key] = role
            if column.name.casefold() not in ROLES[role] or column.key != column.name:
                guess.columns[role] = column.key
        return column

    def unstated(role: str, *names: str) -> SampledColumn | None:
        return None if role in given.parts else named_column([*texts, *left], (*ROLES[role], *names))

    time = fixed.get("time") if "time" in given.parts else _find_clock(left, guess)
    interval = next((c for c in left if c.of_recording and c.is_numeric and ends_in(c.key, INTERVAL)), None)
    if time is None and interval is not None and "time" not in given.parts and min(interval.values) > 0:
        take(INTERVAL, interval)
        guess.rate_hz = float(f"{1000.0 / float(np.median(interval.values)):.3g}")
    else:
        guess.rate_hz = given.rate_hz or guess.rate_hz
        if time is None and not guess.rate_hz and (stated := stated_rate(columns)) is not None:
            guess.rate_hz = guess.keys["row_rate_hz"] = stated[1]
            guess.doubt(
                "the files have no clock: the rate is that of '{column}', {rate:g}",
                "time",
                column=stated[0],
                rate=stated[1],
            )
        _clock(take("time", time), guess)
    guess.times = time.moments if time is not None else []
    texts = [c for c in left if not c.is_numeric and c.words and not c.is_date]
    take("subject", unstated("subject", *_PERSON_NAMES) if len(columns) > 1 else None)
    for role in ("session", "recording"):
        take(role, next((c for c in left if c.name.casefold() in ROLES[role]), None))
    texts = [c for c in texts if c in left]
    label = take("label", None if "label" in given.parts else _label(texts, left, guess))
    if label is not None and "label" in fixed:
        guess.labels = label.words or Counter(map(str, label.codes))
    _channels(chosen or _may_be_channels(left, guess), guess)


def _channels(columns: Sequence[SampledColumn], guess: PatternDraft) -> None:
    """Take columns for channels."""
    missing: Counter[str] = Counter()
    for column in columns:
        missing += column.words
        guess.roles[column.key] = "channel"
        guess.channels.append(_measured(column, guess))
    if missing:
        guess.keys["missing"] = sorted(missing)
        listed = ", ".join(sorted(missing))
        guess.doubt("the words {listed} are taken for missing values", "channels", listed=listed)
    _vectors(guess)
    _doubt_wide(guess)


def _doubt_wide(guess: PatternDraft) -> None:
    """Add a doubt about numbered columns in a table without a clock, which may be the samples of one recording."""
    series: dict[str, list[tuple[int, str]]] = {}
    for channel in guess.channels:
        if numbered := re.fullmatch(r"(.*?)_?(\d+)", channel["name"]):
            series.setdefault(numbered[1], []).append((int(numbered[2]), channel["name"]))
    for columns in series.values():
        columns.sort()
        if not guess.times and len(columns) >= _MANY_COLUMNS and columns[-1][0] - columns[0][0] < len(columns):
            guess.doubt(
                "the {n} columns from '{first}' to '{last}' are taken for channels: if they are the samples of one "
                "channel, so that each row is a whole recording, write a table with a row for each sample",
                "channels",
                n=len(columns),
                first=columns[0][1],
                last=columns[-1][1],
            )


def _may_be_channels(left: list[SampledColumn], guess: PatternDraft) -> list[SampledColumn]:
    """Return the columns that may be readings."""
    _unused(left, guess)
    found = []
    for column in [c for c in left if c.is_numeric and not c.of_recording]:
        kind = no_reading(_with_times(column, guess.times))
        numbered = _NO_CHANNEL.fullmatch(column.name.strip())
        if not numbered and column.codes and (not kind or _TAKE.search(column.name)):
            guess.codes[column.key] = column
        elif numbered or kind or (column.rises and re.search("time|stamp", column.name.casefold())):
            guess.doubt(
                "the column '{column}' is taken for {kind}, not for a channel",
                "channels",
                column=column.key,
                kind=Message(COUNTER if numbered else kind or CLOCK),
            )
        else:
            found.append(column)
    return found


def _find_clock(left: list[SampledColumn], guess: PatternDraft) -> SampledColumn | None:
    """Return the column of times; None without one."""
    dates = next((c for c in left if c.is_date and not c.of_recording), None)
    numeric = [c for c in left if c.is_numeric and not c.of_recording]
    time = (
        dates or named_column(numeric, (*ROLES["time"], "time", "stamp")) or next(filter(_may_be_clock, numeric), None)
    )
    return _readable_clock(time, left, guess)


def _unused(left: list[SampledColumn], guess: PatternDraft) -> None:
    """Add a doubt about columns that hold texts in place of numbers: a sensor that was off, or a description."""
    texts = [c for c in left if not c.is_numeric and c.words and not c.of_recording]
    if texts:
        listed = ", ".join(f"'{c.key}' ('{next(iter(c.words))[:30]}')" for c in texts[:_FEW])
        more = ", …" if len(texts) > _FEW else ""
        guess.doubt("columns with texts are no channels: {listed}", "channels", listed=listed + more)


def _readable_clock(time: SampledColumn | None, left: list[SampledColumn], guess: PatternDraft) -> SampledColumn | None:
    """Return the clock, or a column of few dates without one; None with a doubt if it stands still or is unreadable."""
    words = [c for c in left if not c.is_numeric and c.words and not c.of_recording]
    unread = named_column(words, (*ROLES["time"], "time", "stamp"))
    if time is None and unread is not None and unread.holds_dates:
        time = unread
    if time is not None and (still := rows_at_one_time(time.times)):
        left.remove(time)
        guess.doubt(
            "the clock in '{column}' stands still ({n} rows in turn have the same time), as where a spreadsheet "
            "or float32 cut digits off: export its times again, or let row_rate_hz stand instead of it",
            "time",
            column=time.key,
            n=still,
        )
        return None
    if time is None and unread is not None and re.search(r"\d", next(iter(unread.words))):
        left.remove(unread)
        guess.doubt(
            "the times in '{column}', such as '{text}', cannot be read: write them as 2026-03-01 12:01:02.5, as "
            "12:01:02.5, or as numbers",
            "time",
            column=unread.key,
            text=next(iter(unread.words))[:30],
        )
    return time


def _with_times(column: SampledColumn, times: list[Floats]) -> list[tuple[Floats, Floats]]:
    """Return the numbers of a column in each file or recording, and their times, or the numbers of the rows."""
    fits = [len(a) for a in column.numbers] == [len(b) for b in times]
    return list(zip(column.numbers, times if fits else [np.arange(float(len(a))) for a in column.numbers], strict=True))


def _may_be_clock(column: SampledColumn) -> bool:
    """Return whether a column rises, and does not only count the rows."""
    return column.rises and no_reading(_with_times(column, [])) != COUNTER


def _label(texts: list[SampledColumn], left: list[SampledColumn], guess: PatternDraft) -> SampledColumn | None:
    """Return the column of labels: by its name, or else the first one of few texts, a ``name`` before others."""
    label = named_column(texts, (*ROLES["label"], *LABEL_NAMES))
    numbers = next((c for c in left if c.name.strip().casefold() in CODE_NAMES and c.codes), None)
    if label is None and numbers is not None:
        guess.labels = Counter(map(str, numbers.codes))
        guess.doubt(
            "the labels in '{column}' are numbers: give them their names in [aliases]", "label", column=numbers.key
        )
        return numbers
    if label is None:
        # A device describes itself in texts, and what differs in every file is an identifier.
        few = [
            c
            for c in texts
            if 1 < len(c.words) <= MOST_LABELS and INTERVAL not in guess.columns
            if len(c.words) < len(c.parts) or any(len(set(cells)) > 1 for cells in c.parts)
        ]
        mixed = [c for c in few if c.alternates]
        for column in mixed:
            listed = join_names(repr(word) for word in list(column.words)[:2])
            guess.doubt(
                "the column '{column}' changes from row to row ({listed}), so that it is not taken for the label: "
                "if it names sensors, their rows are mixed; write a table with a column for each sensor",
                "label",
                column=column.key,
                listed=listed,
            )
        few = [c for c in few if c not in mixed]
        label = next(iter([*(c for c in few if ends_in(c.key.casefold(), "name")), *few]), None)
        if label is not None:
            listed = ", ".join(repr(word) for word in list(label.words)[:2])
            guess.doubt(
                "the column '{column}' is taken for the label: {listed}", "label", column=label.key, listed=listed
            )
    if label is not None:
        guess.labels = label.words
    return label


def guess_codes(parts: PathParts, guess: PatternDraft) -> None:
    """Take whole numbers that change rarely for the label or the take, if there is no other; list the others."""
    labelled = bool(guess.labels) or "intervals" in guess.keys or "label" in guess.given.parts
    without_takes = "recording" not in guess.taken | parts.found | set(guess.given.parts)
    takes = [c for c in guess.codes.values() if c.counts and (labelled or _TAKE.search(c.name))]
    may_be = [c for c in guess.codes.values() if c not in takes and len(c.codes) <= MOST_CODES]
    for column in sorted(guess.codes.values(), key=lambda c: not named_column([c], CODE_NAMES)):
        values = {"column": column.key, "codes": ", ".join(map(str, column.codes[:6]))}
        if column in may_be and not labelled:
            labelled = True
            guess.columns["label"] = column.key
            guess.roles[column.key] = "label"
            guess.labels = Counter(map(str, column.codes))
            guess.doubt(
                "the column '{column}' has whole numbers that change rarely ({codes}), so that it is taken for the "
                "label: give them names in [aliases]",
                "label",
                **values,
            )
        elif column in takes and without_takes:
            without_takes = False
            guess.taken.add("recording")
            guess.columns["recording"] = column.key
            guess.roles[column.key] = "recording"
            guess.doubt(
                "the column '{column}' has whole numbers that change rarely ({codes}), so that it is taken for the "
                "take: a recording ends where it changes",
                "recording",
                **values,
            )
        else:
            guess.doubt(
                "the column '{column}' has whole numbers that change rarely ({codes}), so that it is no channel: if it "
                "is a sensor, add it to channels, and if it is the label, to columns",
                "channels",
                **values,
            )
    if not labelled:
        guess.doubt("the label of a recording was not found: put {{label}} into paths, or give its column", "label")


def _clock(time: SampledColumn | None, guess: PatternDraft) -> None:
    """Find the unit of the times, and the rate."""
    if time is None and "row_rate_hz" in guess.keys:
        return
    if time is None:
        if guess.rate_hz and not guess.given.rate_hz:
            guess.doubt(
                "the files have no clock; micro:bit CreateAI has {rate:g} rows a second with this key (40: ID, 50: "
                "id): if recordings of 1.8 s have about 92 rows, correct row_rate_hz and rate_hz to 50",
                "time",
                rate=guess.rate_hz,
            )
        elif not guess.rate_hz:
            guess.doubt(
                "the files have no clock: give the true rate as row_rate_hz and rate_hz, now {rate:g}",
                "time",
                rate=USUAL_HZ,
            )
        guess.keys["row_rate_hz"] = guess.rate_hz = guess.rate_hz or USUAL_HZ
        return
    numbers = time.times
    if time.words and time.holds_dates:
        guess.keys["time_unit"] = guess.time_unit = "iso"
        factor = 1000.0
    else:
        unit, stated = unit_of_time(time.name, numbers, USUAL_HZ)
        unit = guess.time_unit = guess.given.time_unit if guess.given.time_unit in UNITS else unit
        factor = UNITS[unit]
        if not stated or guess.given.time_unit:
            guess.keys["time_unit"] = unit
        if not stated and not guess.given.time_unit:
            guess.doubt("the times in '{column}' are taken for {unit}", "time", column=time.key, unit=unit)
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    period = float(np.median(steps)) * factor if len(steps) else 1000.0 / USUAL_HZ
    guess.rate_hz = float(f"{min(max(1000.0 / period, 1.0), 10_000.0):.3g}")


def _channel(name: str, kind: str, **more: Any) -> dict[str, Any]:
    return {"name": name, "unit": "", "kind": kind, **more}


def _measured(column: SampledColumn, guess: PatternDraft) -> dict[str, Any]:
    """Return the channel of a column of numbers: its kind, and a step that keeps its decimals."""
    key = _AROUND.sub("", column.key) if guess.is_json else column.key
    # A channel has no number for a name, since it would look like a reading at the head of a table.
    key = f"c{key.lstrip('#')}" if not column.name or column.name.isdecimal() else key
    name = re.sub(r"\W+", "_", key.casefold()).strip("_") or f"channel{len(guess.channels) + 1}"
    if name != column.name.casefold() or column.key != column.name:
        guess.columns[name] = column.key
    values = column.values
    texts = [cell.strip().replace(",", ".") for cell in column.cells]
    digits = min(6, max((len(t.partition(".")[2]) for t in texts if is_number(t) and "e" not in t.lower()), default=0))
    kind = _RATE if _ANGULAR.search(name) else "acceleration" if _ACCELERATION.search(name) else "sensor"
    if set(values.tolist()) <= {0.0, 1.0} and not digits and kind == "sensor":
        return _channel(name, "binary", valid_min=0, valid_max=1)
    largest = float(np.abs(values).max())
    # A magnitude needs a range; twice the largest value is a guess at that of the sensor.
    limit = float(2 ** int(np.ceil(np.log2(max(2 * largest, 1.0)))))
    # Whole numbers of steps have to fit 32 bits; those of a vector a self-calibration, and their squares 64 bits.
    highest, most = (largest, _MOST_STEPS) if kind == "sensor" else (limit, MOST_CALIBRATED)
    while digits and highest * 10**digits > most:
        digits -= 1
    more: dict[str, Any] = {"step": float(f"1e-{digits}")} if digits else {}
    if kind == "sensor":
        # The widest range with which the channel may calibrate itself.
        limit = MOST_CALIBRATED_OTHER * more.get("step", 1.0)
    if 2 * largest <= limit:
        more |= {"valid_min": -limit, "valid_max": limit}
    return _channel(name, kind, **more)


def _vectors(guess: PatternDraft) -> None:
    """Find triples of accelerations or rates whose names differ only in x, y and z, or that are a list in JSON."""
    by_stem: dict[str, dict[str, str]] = {}
    for channel in guess.channels:
        text = channel["name"].replace("_", " ")
        axis = re.search(r"(?:(?<![a-z])[ag]?|acc|accel|gyro?)([xyz])(?![a-z])|([xyz])$", text)
        if channel["kind"] == "sensor":
            continue
        if axis is not None and (at := axis.lastindex):
            stem = channel["name"][: axis.start(at)] + "?" + channel["name"][axis.end(at) :]
            by_stem.setdefault(stem, {})[axis[at]] = channel["name"]
        elif guess.is_json and (item := re.fullmatch(r"(.+_)(\d+)", channel["name"])):
            by_stem.setdefault(item[1], {})[item[2]] = channel["name"]
    guess.vectors = [[axes[a] for a in sorted(axes)] for axes in by_stem.values() if set(axes) in _AXES]
    for channel in guess.channels:
        if channel["kind"] == _RATE and not any(channel["name"] in vector for vector in guess.vectors):
            # A single letter may stand for something else.
            channel["kind"] = "sensor"
            del channel["valid_min"], channel["valid_max"]
    _ranges(guess)


def _ranges(guess: PatternDraft) -> None:
    """Give the axes of one vector the same range, the largest of theirs, and the same step."""
    axes = {c["name"]: c for c in guess.channels if c["kind"] in ("acceleration", _RATE)}
    alone = [[name] for name in axes if not any(name in vector for vector in guess.vectors)]
    for names in [*guess.vectors, *alone]:
        limit = max(axes[name]["valid_max"] for name in names)
        step = min(axes[name].get("step", 1.0) for name in names)
        for name in names:
            axes[name] |= {"step": step} if step < 1.0 else {}
            axes[name] |= {"valid_min": -limit, "valid_max": limit}
        listed = ", ".join(f"'{name}'" for name in names)
        guess.doubt(
            "the range of {listed} is guessed (±{limit:g}): give that of the sensor",
            "channels",
            listed=listed,
            limit=limit,
        )


def doubt_idle(guess: PatternDraft) -> None:
    """Add a doubt about labels that may stand for idle time."""
    found = [label for label in guess.labels if plain_label(label) in _IDLE_LABELS]
    if "label" in guess.taken and found and not guess.given.idle:
        guess.doubt(
            "rows with the label {listed} are taken for a gesture: if nothing happens in them, add  idle = {toml}",
            "idle",
            listed=", ".join(map(repr, found)),
            toml=json.dumps(found, ensure_ascii=False),
        )


def guess_aliases(guess: PatternDraft) -> None:
    """Find spellings of one label that differ in more than case, spaces and underlines."""
    aliases = {}
    for alike in alike_labels(guess.labels):
        plain = {plain_label(label) for label in alike}
        spellings = sorted(label for label in guess.labels if plain_label(label) in plain)
        # The spelling with separate words reads best.
        best = max(spellings, key=lambda s: (len(s), guess.labels[s]))
        aliases[best] = [s for s in spellings if s != best]
        listed = join_names(repr(s) for s in spellings)
        guess.doubt("{listed} are taken for one label", "label", listed=listed)
    if aliases:
        guess.keys["aliases"] = aliases
