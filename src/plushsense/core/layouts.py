"""Sensor layouts: the channels of a toy and their order on the wire, in files and in the input of a network."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ArrayError, LayoutError, nearest
from plushsense.core.sentences import Message
from plushsense.core.toml import builtin_names, load_table, read_named

DEVICE_MS = "device_ms"
DELAY_MS = "delay_ms"
HOST_MS = "host_ms"
MAGNITUDE_FRACTION_BITS = 4
GRAVITY_FRACTION_BITS = 4
GRAVITY_STATE_BITS = 10  # fraction bits of the running mean itself
MOST_GRAVITY = 1 << (29 - GRAVITY_STATE_BITS)  # size of a component whose running mean and its changes fit 32 bits
GRAVITY_S = 0.64  # time constant of the running mean; chosen on 14 people (docs/measurements/people.md)
CALIBRATION_BLOCK_S = 0.32
MOST_CALIBRATED_SENSORS = 64
# Size of a reading in steps, so that the sums of a self-calibration fit 64 bits: of accelerometers, of other channels.
MOST_CALIBRATED, MOST_CALIBRATED_OTHER = 1 << 19, 1 << 20
ACCELERATION = "acceleration"
BINARY, COUNT = "binary", "count"
DERIVED_KINDS = ("magnitude", "gravity")
MOST_GAP_MS, MOST_GAP_SAMPLES, MOST_GAP_VALUES = 60_000, 60_000, 2_000_000
MOST_CHANNELS = 4096  # as many as a network may read; also of the entries of every other list
_SIZES = (1e-30, 1e30)  # of a step, and of a scale, which may be negative
_INT32 = (-2147483648.0, 2147483647.0)
# Labels of a stream that say no more than the place of a channel: "3", "ch3", "Channel 3", or nothing.
_NUMBERED = re.compile(r"(?:ch(?:an(?:nel)?)?)?[\W\d_]*", re.IGNORECASE)


def magnitude_limit(n: int) -> int:
    """Return the largest size, 2²⁷ / √n, of ``n`` components whose magnitude with fraction bits stays below 2³¹."""
    return math.isqrt((2 ** (62 - 2 * MAGNITUDE_FRACTION_BITS) - 1) // n)


@dataclass(frozen=True)
class Channel:
    """A quantity that the toy measures and sends as a raw value.

    Attributes:
        name: name of the channel, which the other keys of the layout use.
        unit: unit of the physical value ``(raw - offset) * scale``, such as ``N``; ``count`` for plain numbers.
        kind: what is measured, such as ``capacitive``, ``force`` or ``proximity``. Three of the names have an effect:
            ``acceleration`` (its axes show where down is), and ``binary`` (touched or not) and ``count`` (a number of
            touched cells), which may keep one value for long.
        offset: raw value that stands for zero.
        scale: physical units for each unit of the raw value.
        valid_min: smallest valid raw value; below it, the reading counts as sensor garbage, and the last valid one is
            used in its place (default: every number that fits 32 bits after the division by ``step``).
        valid_max: largest valid raw value (default: as for ``valid_min``).
        step: smallest difference of raw values that counts; all computations use the whole number ``raw / step``, so
            that readings with two decimals need 0.01 (above 0).
    """

    name: str
    unit: str
    kind: str
    offset: float = 0.0
    scale: float = 1.0
    valid_min: float = _INT32[0]
    valid_max: float = _INT32[1]
    step: float = 1.0

    def __post_init__(self) -> None:
        for key, size in (("step", self.step), ("scale", abs(self.scale))):
            if not _SIZES[0] <= size <= _SIZES[1]:
                raise LayoutError(
                    f"Channel '{self.name}': {key} is {getattr(self, key):g}; accepted are sizes from {_SIZES[0]:g} to "
                    f"{_SIZES[1]:g}."
                )
        if abs(self.offset) > 2.0**32 * self.step:
            raise LayoutError(
                f"Channel '{self.name}': the offset {self.offset:g} is more than 2³² steps of {self.step:g}: take a "
                "larger step."
            )
        # By default, every number of steps is valid that fits 32 bits, also as a distance from the offset.
        zero = round(self.offset / self.step)
        if self.valid_min == _INT32[0]:
            object.__setattr__(self, "valid_min", (_INT32[0] + abs(zero)) * self.step)
        if self.valid_max == _INT32[1]:
            object.__setattr__(self, "valid_max", (_INT32[1] - abs(zero)) * self.step)
        low, high = self.valid_min / self.step, self.valid_max / self.step
        edge = _INT32[0] - 0.5 + max(zero, 0), _INT32[1] + 0.5 + min(zero, 0)
        if not edge[0] <= low <= high <= edge[1]:
            raise LayoutError(
                f"Channel '{self.name}': valid_min {self.valid_min:g} to valid_max {self.valid_max:g} in steps of "
                f"{self.step:g} must rise and fit 32-bit integers, also after the offset {self.offset:g} is "
                "subtracted: narrow the range or take a larger step."
            )

    @property
    def is_discrete(self) -> bool:
        """Whether one value for long is usual, as for a cell that nothing touches."""
        return self.kind in (BINARY, COUNT)

    def in_units(self, steps: float) -> tuple[float, str]:
        """Return a value of ``steps`` integer steps as the files have it, and the unit to write behind it, "" if none.

        Raw values that are not in the unit of the channel have none.
        """
        plain = self.scale == 1.0 and self.unit not in ("", "count", "counts")
        return float(f"{steps * self.step:.6g}"), f" {self.unit}" if plain else ""


# What an import measures of the channels of a data set, and puts into its layout.
MEASURED = ("offset", "unit", "valid_min", "valid_max")


@dataclass(frozen=True)
class Derived:
    """A channel computed from others, an integer with 4 fraction bits (`plushsense.windows.features.RunningMean`).

    Attributes:
        name: name of the computed channel, for ``inputs``.
        kind: ``magnitude`` is the length √(x² + y² + …) of the channels ``of``; ``gravity`` is the running mean of one
            axis of an accelerometer, which shows where down is (one of `DERIVED_KINDS`).
        of: names of the channels that it is computed from: several for a magnitude, one for gravity.
    """

    name: str
    kind: str
    of: tuple[str, ...]


@dataclass(frozen=True)
class CsvFormat:
    """CSV format of the authors' recorder for a layout.

    Attributes:
        columns: what each column of a file holds, in order: a channel, ``device_ms`` (the toy's clock), ``delay_ms``,
            ``host_ms`` (the computer's clock) or ``label`` (default: ``host_ms``, ``device_ms`` and all channels).
        header: text of each column in the first line of a file (default: as ``columns``).
        separator: text between two columns (default: a comma and a space).
    """

    columns: tuple[str, ...]
    header: tuple[str, ...]
    separator: str


class StreamColumns(NamedTuple):
    """Indices of a layout's channels in a sample of a stream, and of the device clock (None if the stream has none).

    ``notes`` are sentences for the user on what was assumed: that the number of channels is enough where they have no
    labels, and that another clock is better than one of float32.
    """

    channels: tuple[int, ...]
    clock: int | None = None
    notes: tuple[Message, ...] = ()

    @property
    def by_number(self) -> bool:
        """Whether only the number of channels fits, since they have no labels."""
        return any("channels" in note.values for note in self.notes)


@dataclass(frozen=True)
class Layout:
    """The channels of a toy, their order on the wire and in files, and the inputs of a network.

    Attributes:
        name: name of the layout, which data sets and models store.
        title: what the layout is, for people (default: the name).
        rate_hz: samples for each second that a network reads; recordings are resampled to it (1 to 10000).
        channels: what the toy measures, in the order of the computations.
        wire: order of the numbers in a frame: names of all channels, and ``device_ms`` (the toy's clock) or
            ``delay_ms`` (time since the frame before), or both.
        derived: channels that are computed from others (default: none).
        inputs: names of the channels, measured or computed, that a network reads (default: all measured channels).
        csv: the form of the recording's files (default: as its own keys say).
        gap_ms: longest time between two frames that is bridged by interpolation. After a longer gap the network starts
            anew (1 to 60000, and at most 60000 samples).
        vectors: the axes of each three-axis sensor as a list of three channels of one kind. With an acceleration among
            them, the default network does not depend on how the toy is held.
        self_calibration: channels whose zero and scale are found from the readings themselves, while they come; their
            offsets in ``channels`` then do not matter. Of accelerometers, all three axes of vectors: zero and 1 g. Of
            other channels, such as capacitive ones or gyroscopes: rest, and how far touch or movement leads away from
            it; the three axes of a vector have one scale and are named together (default: none).
    """

    name: str
    title: str
    rate_hz: float
    channels: tuple[Channel, ...]
    wire: tuple[str, ...]
    derived: tuple[Derived, ...]
    inputs: tuple[str, ...]
    csv: CsvFormat
    gap_ms: int = 100
    vectors: tuple[tuple[str, ...], ...] = ()
    self_calibration: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for problem in self._problems():
            raise LayoutError(f"Layout '{self.name}': {problem}")

    def _problems(self) -> Iterator[str]:
        yield from self._problems_of_size()
        names = [c.name for c in self.channels] + [d.name for d in self.derived]
        if len(set(names)) != len(names):
            yield f"channel names must differ: {', '.join(names)}."
        header, columns = self.csv.header, self.csv.columns
        if len(header) != len(columns):
            yield f"csv.header has {len(header)} texts for {len(columns)} columns: give one for each."
        for where, used, extra in (
            ("wire", self.wire, (DEVICE_MS, DELAY_MS)),
            ("inputs", self.inputs, tuple(d.name for d in self.derived)),
            ("csv.columns", columns, (DEVICE_MS, DELAY_MS, HOST_MS, "label")),
        ):
            known = (*self.names, *extra)
            unknown = set(used) - set(known)
            for name in used:
                if name in unknown:
                    yield f"{where} names '{name}'; known are {', '.join(known)}.{nearest(name, known)}"
        unsent = set(self.names) - set(self.wire)
        if missing := [name for name in self.names if name in unsent]:
            yield f"wire lacks the channels {', '.join(missing)}: add them."
        if DEVICE_MS not in self.wire and DELAY_MS not in self.wire:
            yield f"wire has no clock: add {DEVICE_MS} or {DELAY_MS}."
        if not self.inputs:
            yield "a network needs inputs: fill in inputs."
        for derived in self.derived:
            yield from self._problems_of(derived)
        kinds = {c.name: c.kind for c in self.channels}
        for vector in self.vectors:
            if len(vector) != 3:
                yield f"a vector has three axes, not {len(vector)}."
            if len({kinds[self.names[self.index(name)]] for name in vector}) > 1:
                yield f"the axes {', '.join(vector)} of a vector are of different kinds: give them one."
        yield from self._problems_of_calibration(kinds)

    def _problems_of_size(self) -> Iterator[str]:
        for what in ("channels", "wire", "derived", "inputs", "vectors"):
            if len(getattr(self, what)) > MOST_CHANNELS:
                yield f"{what} has {len(getattr(self, what))} entries: accepted are up to {MOST_CHANNELS}."
        if not 1.0 <= self.rate_hz <= 10_000.0:
            yield f"rate_hz is {self.rate_hz}; accepted are 1 to 10000."
        elif not 1 <= self.gap_ms <= MOST_GAP_MS or self.gap_ms * self.rate_hz > 1000 * MOST_GAP_SAMPLES:
            yield (
                f"gap_ms is {self.gap_ms}: accepted are 1 to {MOST_GAP_MS}, and at most {MOST_GAP_SAMPLES} samples, as "
                "all samples of a gap are computed at once."
            )
        elif self.gap_ms * self.rate_hz * self.n_channels > 1000 * MOST_GAP_VALUES:
            yield f"gaps of {self.gap_ms} ms have more than {MOST_GAP_VALUES} values in {self.n_channels} channels."

    def _problems_of(self, derived: Derived) -> Iterator[str]:
        if derived.kind not in DERIVED_KINDS or not derived.of or (derived.kind == "gravity" and len(derived.of) > 1):
            yield (
                f"derived channel '{derived.name}' is the {derived.kind} of {', '.join(derived.of) or 'nothing'}: "
                "accepted are the magnitude of one or more channels, and the gravity of one."
            )
        limit = MOST_GRAVITY if derived.kind == "gravity" else magnitude_limit(len(derived.of))
        for name in derived.of:
            at = self.index(name)
            low, high = (edge[at] - self.zero_int[at] for edge in (self.valid_min_int, self.valid_max_int))
            if max(-low, high) > limit:
                yield (
                    f"channel '{name}' feeds '{derived.name}' but is valid from {self.valid_min_int[at]} to "
                    f"{self.valid_max_int[at]} steps: give it valid_min and valid_max within {limit} steps of its "
                    f"offset, so that the {derived.kind} fits 32 bits."
                )

    def _problems_of_calibration(self, kinds: Mapping[str, str]) -> Iterator[str]:
        named, sensors = self.self_calibration, self.calibrated_sensors
        axes = [self.names[at] for sensor in sensors for at in sensor]
        if twice := [name for name in dict.fromkeys(named) if named.count(name) > 1 or axes.count(name) > 1]:
            yield f"self_calibration has {', '.join(twice)} twice, by name or as axes of two vectors: accepted is once."
        if len(sensors) > MOST_CALIBRATED_SENSORS:
            yield f"self_calibration names {len(sensors)} sensors: accepted are up to {MOST_CALIBRATED_SENSORS}."
        for name in named:
            at = self.index(name)
            most = MOST_CALIBRATED if kinds[name] == ACCELERATION else MOST_CALIBRATED_OTHER
            of = next((vector for vector in self.vectors if name in vector), ())
            if not set(of) <= set(named) or (kinds[name] == ACCELERATION and not of):
                known = "; ".join(map(", ".join, self.vectors)) or "none"
                yield f"self_calibration names {name}: accepted are all three axes of a vector, here {known}."
            if kinds[name] in (BINARY, COUNT):
                yield f"self_calibration names {name}: a channel of the kind '{kinds[name]}' has no scale to find."
            if max(abs(int(self.valid_min_int[at])), abs(int(self.valid_max_int[at]))) > most:
                yield (
                    f"channel '{name}' is in self_calibration but is valid from {self.valid_min_int[at]} to "
                    f"{self.valid_max_int[at]} steps: give it valid_min and valid_max within ±{most}."
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names in order."""
        return tuple(c.name for c in self.channels)

    @property
    def is_labelled(self) -> bool:
        """Whether every row of a file has a label, so that recordings are sections of streams."""
        return "label" in self.csv.columns

    @property
    def n_channels(self) -> int:
        """Number of measured channels, C."""
        return len(self.channels)

    @property
    def n_inputs(self) -> int:
        """Number of input channels of a network, F."""
        return len(self.inputs)

    @property
    def period_us(self) -> int:
        """Sampling period in whole microseconds."""
        return round(1_000_000 / self.rate_hz)

    @property
    def valid_min_int(self) -> NDArray[np.int64]:
        """Smallest valid value of each channel in integer steps, (C,)."""
        return np.array([max(_INT32[0], np.ceil(c.valid_min / c.step)) for c in self.channels], dtype=np.int64)

    @property
    def valid_max_int(self) -> NDArray[np.int64]:
        """Largest valid value of each channel in integer steps, (C,)."""
        return np.array([min(_INT32[1], np.floor(c.valid_max / c.step)) for c in self.channels], dtype=np.int64)

    @property
    def zero_int(self) -> NDArray[np.int64]:
        """Offset of each channel in integer steps, (C,): the reading that stands for zero."""
        return np.array([round(c.offset / c.step) for c in self.channels], dtype=np.int64)

    @property
    def gravity_shift(self) -> int:
        """Binary logarithm of the time constant of the running mean, in samples."""
        return max(0, round(math.log2(GRAVITY_S * self.rate_hz)))

    @property
    def calibrated_sensors(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the channels of each sensor that calibrates itself: the axes of vectors, then single channels."""
        named = set(self.self_calibration)
        vectors = [vector for vector in self.vectors if set(vector) <= named]
        alone = named - {axis for vector in vectors for axis in vector}
        return tuple(tuple(map(self.index, sensor)) for sensor in (*vectors, *((n,) for n in self.names if n in alone)))

    @property
    def calibration_shift(self) -> int:
        """Binary logarithm of the samples in a block of a self-calibration, 2 to 8."""
        return min(max(2, round(math.log2(CALIBRATION_BLOCK_S * self.rate_hz))), 8)

    @property
    def input_kinds(self) -> tuple[str, ...]:
        """Kind of each input: that of its channel or of the first source of a magnitude, or ``gravity``."""
        kinds = {c.name: c.kind for c in self.channels}
        kinds |= {d.name: d.kind if d.kind == "gravity" else kinds[d.of[0]] for d in self.derived}
        return tuple(kinds[name] for name in self.inputs)

    @property
    def input_vectors(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the inputs that are the axes of each vector; the last vector is gravity if it is an input."""
        gravity = tuple(at for at, kind in enumerate(self.input_kinds) if kind == "gravity")
        axes = [tuple(map(self.inputs.index, vector)) for vector in self.vectors if set(vector) <= set(self.inputs)]
        return (*axes, gravity) if gravity else tuple(axes)

    @property
    def has_gravity(self) -> bool:
        """Whether one of the vectors is an acceleration, so that a network may have a vector layer."""
        kinds = {c.name: c.kind for c in self.channels}
        return any(kinds[axis] == ACCELERATION for vector in self.vectors for axis in vector)

    @property
    def accelerometers(self) -> tuple[tuple[str, ...], ...]:
        """The axes of each accelerometer: of vectors or magnitudes, or the only three channels of the kind."""
        groups = self.vectors or tuple(d.of for d in self.derived if d.kind == "magnitude")
        axes = tuple(c.name for c in self.channels if c.kind == ACCELERATION)
        found = tuple(group for group in groups if set(group) <= set(axes))
        return found or ((axes,) if len(axes) == 3 else ())

    def for_vectors(self) -> Layout:
        """Return the layout with the inputs of a network that begins with a vector layer (see `models.arch`).

        These are the inputs that are not axes of vectors, then the axes of all vectors, then the gravity along each
        axis of the first acceleration.

        Raises:
            LayoutError: for a layout without an acceleration among its vectors.
        """
        if not self.has_gravity:
            raise LayoutError(
                f"Layout '{self.name}' names no accelerometer, which a vector layer needs: list its three axes in "
                f"vectors, with the kind '{ACCELERATION}', or take a network without a vector layer."
            )
        axes = [axis for vector in self.vectors for axis in vector]
        kinds = {c.name: c.kind for c in self.channels}
        first = next(vector for vector in self.vectors if kinds[vector[0]] == ACCELERATION)
        gravity = tuple(Derived(f"{axis}_gravity", "gravity", (axis,)) for axis in first)
        others = [name for name in self.inputs if name not in (*axes, *(d.name for d in gravity))]
        derived = tuple(d for d in self.derived if d.kind != "gravity") + gravity
        return replace(self, derived=derived, inputs=(*others, *axes, *(d.name for d in gravity)))

    def reads_as(self, other: Layout) -> bool:
        """Return whether the channels are those of ``other``, but for what an import measures (`MEASURED`)."""
        return self.names == other.names and not self.unlike(other)

    def unlike(self, other: Layout) -> list[str]:
        """Return which channels of the same names differ from those of ``other`` in more than an import measures.

        Units must be the same unless the layouts have the same name.
        """
        measured = dict.fromkeys(key for key in MEASURED if key != "unit" or self.name == other.name)
        pairs = zip(self.channels, other.channels, strict=True)
        return [a.name for a, b in pairs if asdict(a) | measured != asdict(b) | measured]

    def index(self, name: str) -> int:
        """Return the index of a channel; for an unknown name raise LayoutError with the nearest known one."""
        if name not in self.names:
            raise LayoutError(
                f"Layout '{self.name}' has no channel '{name}'; it has {', '.join(self.names)}."
                f"{nearest(name, self.names)}"
            )
        return self.names.index(name)

    def in_steps(self, values: Sequence[float]) -> tuple[int, ...]:
        """Return one sample of all channels (C,), as files and lines have it, in the integer steps of a frame.

        Raises:
            ArrayError: for another number of values, or one that is not finite.
        """
        if len(values) != self.n_channels:
            raise ArrayError(
                f"A sample has {len(values)} values, but layout '{self.name}' has {self.n_channels} channels: give one "
                f"for each of {', '.join(self.names)}."
            )
        for channel, value in zip(self.channels, values, strict=True):
            if not math.isfinite(value):
                raise ArrayError(f"'{channel.name}' is {value} in a sample: accepted are finite numbers.")
        return tuple(round(float(v) / c.step) for c, v in zip(self.channels, values, strict=True))

    def match_columns(self, labels: Sequence[str], width: int, exact: bool = True) -> StreamColumns | str:
        """Match the ``width`` columns of a stream by label, or by position; return why if the stream does not fit.

        Labels are names of channels or header texts of the CSV format, in any order and without regard to case and
        surrounding spaces; the stream may have further columns. Labels that are other names mean another sensor, and
        do not fit. If there are none, or plain numbers, the stream must have exactly the channels of the layout, or the
        fields of its wire format.

        Args:
            exact: whether the values are more exact than float32, which is exact for 4.7 hours of milliseconds only:
                the device clock of such a stream is not used.
        """
        texts = dict(zip((h.casefold() for h in self.csv.header), self.csv.columns, strict=True))
        texts |= {n.casefold(): n for n in (*self.names, DEVICE_MS)}
        keys = [texts.get(label.strip().casefold(), "") for label in labels]
        notes = []
        if any(key or not _NUMBERED.fullmatch(label.strip()) for key, label in zip(keys, labels, strict=True)):
            listed = f"{', '.join(labels[:6])}{', …' if len(labels) > 6 else ''}"
            if not set(keys) & set(self.names):
                mine = f"{', '.join(self.names[:6])}{', …' if self.n_channels > 6 else ''}"
                return f"its {width} channels are {listed}, and those of layout '{self.name}' {mine}"
            if len(labels) != width:
                return f"its header names {len(labels)} channels ({listed}), and its samples have {width} values"
            if wrong := [n for n in self.names if keys.count(n) != 1]:
                return f"its labels do not name {', '.join(wrong)} exactly once"
        elif width in (self.n_channels, len(self.wire)):
            keys = list(self.names if width == self.n_channels else self.wire)
            listed = ", ".join(keys)
            notes.append(
                Message(
                    "its channels have no names: its {n} values are taken for {channels}, in this order",
                    n=width,
                    channels=listed,
                )
            )
        else:
            return (
                f"it has {width} channels, and layout '{self.name}' needs {self.n_channels}, or the {len(self.wire)} "
                "of its wire format"
            )
        clock = keys.index(DEVICE_MS) if DEVICE_MS in keys else None
        if clock is not None and not exact:
            clock = None
            notes.append(
                Message(
                    "its {column} is float32, which is exact for 4.7 hours only: the time stamps are the clock",
                    column=DEVICE_MS,
                )
            )
        return StreamColumns(tuple(keys.index(n) for n in self.names), clock, tuple(notes))

    def samples(self, seconds: float) -> int:
        """Return the number of samples in ``seconds``, at least one."""
        return max(1, round(seconds * self.rate_hz))

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON; without ``self_calibration`` if it is empty, as before there was one."""
        table = asdict(self)
        if not self.self_calibration:
            del table["self_calibration"]
        return table

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str = "layout") -> Layout:
        """Create a layout from plain values, as in a TOML file or a bundle; ``where`` names it in messages.

        Raises:
            LayoutError: for an unknown or missing key, or a value of the wrong type or out of range.
        """
        if not isinstance(table, dict):
            raise LayoutError(f"The {where} is {table!r}: accepted is a table.")
        given = table.get("channels")
        # Wrong types are skipped here, since `load_table` reports them.
        names = [c.get("name") for c in given if isinstance(c, dict)] if isinstance(given, list | tuple) else []
        csv = table.get("csv", {})
        if isinstance(csv, dict):
            columns = csv.get("columns", [HOST_MS, DEVICE_MS, *names])
            csv = {"columns": columns, "header": columns, "separator": ", "} | csv
        defaults = {"title": table.get("name"), "derived": [], "inputs": names}
        return load_table({**defaults, **table, "csv": csv}, cls, where, LayoutError)


def layout_names() -> tuple[str, ...]:
    """Return the names of the built-in layouts."""
    return builtin_names("layouts")


def load_layout(name_or_path: str | Path) -> Layout:
    """Load a built-in layout by its name, or any other by the path of its TOML file.

    Raises:
        LayoutError: for an unknown name or an unusable file.
    """
    table, source = read_named(name_or_path, "layouts", "layout", LayoutError)
    return Layout.from_dict(table, f"layout '{source}'")
