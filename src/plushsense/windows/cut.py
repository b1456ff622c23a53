"""Cut recordings into windows of equal length, made of even samples.

A recording that is at least one window long gives full windows every ``step_s`` from its start ("inside"). A shorter
one gives a single window, whose remaining samples depend on the ``context``:

- ``stream``: they are the samples before the recording in the session's stream. If there is no stream, the window is
  cut and marked as with ``rest``; if the stream has too few samples there, as with ``loop``.
- ``rest``: its first reading stands before it, as if the toy had been still.
- ``loop``: the recording is repeated from its start, as in the paper (never zero-padded).
- ``rows``: as with ``loop``, but the rows of the recording are taken as even samples, whatever their times, as the
  authors' scripts do. No recording is left out for its length.

The context ``anywhere`` is for training continuous recognition (``windows/anywhere``).

A recording that is many times longer than usual for its gesture was not stopped in time; it is left out and listed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError, nearest
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.sentences import Message, plural
from plushsense.dataset.quality.measurements import NEVER_STOPPED_FACTOR, usual_rows
from plushsense.dataset.store import RECORDINGS, UNKNOWN_SUBJECT, Dataset, Progress, RecordingInfo
from plushsense.windows.clock import Segment, whole_recording
from plushsense.windows.features import InputUnits, network_inputs
from plushsense.windows.sessions import SessionReader

REST, ROWS = "rest", "rows"
CONTEXTS = ("stream", REST, "loop", ROWS)
ANYWHERE = "anywhere"
TRAIN_CONTEXTS = (*CONTEXTS, ANYWHERE)


@dataclass(frozen=True)
class WindowSpec:
    """Settings for cutting windows; durations in seconds.

    Attributes:
        window_s: length of the windows (above 0 to 60).
        step_s: time from the start of a window to that of the next one in the same recording (above 0 to 60).
        context: where the samples come from that a recording shorter than a window lacks. ``stream``: from the
            session before the recording, or as ``rest`` without a stream; ``rest``: its first reading, as if the toy
            had been still; ``loop``: the recording is repeated; ``rows``: the same, and its rows are taken as even
            samples whatever their times, as by the authors' scripts; ``anywhere``: for live use, windows are cut all
            along the sessions, also while nothing happens (one of `TRAIN_CONTEXTS`; default: by the preset).
        span_s: Not in a file: it follows from the network. It lengthens windows for networks that need more samples.
        longest_factor: recordings longer than this many times the median of their gesture are left out; 0: none is
            (0 or from 1).
    """

    window_s: float = 2.5
    step_s: float = 0.5
    context: str = "stream"
    span_s: float = 0.0
    longest_factor: float = NEVER_STOPPED_FACTOR

    def __post_init__(self) -> None:
        if self.context not in TRAIN_CONTEXTS:
            raise ConfigError(
                f"Unknown context '{self.context}': accepted are {', '.join(TRAIN_CONTEXTS)}."
                f"{nearest(self.context, TRAIN_CONTEXTS)}"
            )
        if self.longest_factor != 0.0 and self.longest_factor < 1.0:
            raise ConfigError(f"longest_factor is {self.longest_factor}: accepted are 0 (off) and 1 or more.")
        if not (0.0 < self.window_s <= 60.0 and 0.0 < self.step_s <= 60.0):
            raise ConfigError(
                f"A window of {self.window_s} s every {self.step_s} s is out of range: above 0, at most 60 s."
            )


def whole_gestures(windowing: Mapping[str, Any]) -> WindowSpec:
    """Return the window settings in a bundle's ``windowing``, for whole recordings: "anywhere" becomes "stream"."""
    values = {field.name: windowing[field.name] for field in fields(WindowSpec) if field.name in windowing}
    if values.get("context") not in CONTEXTS:
        values["context"] = "stream"
    return WindowSpec(**values)


@dataclass(frozen=True)
class WindowSet:
    """N windows with their classes, recordings and people.

    ``x`` (N, F, T): inputs of the network, unscaled, in the ``units`` of the layout; ``integers`` (N, F, T): as the toy
    computes them, in steps; ``y`` (N,): class index; ``recording`` (N,): index into ``recording_ids``;
    ``subject`` (N,): code of the person, "none" if nobody; ``context`` (N,): "inside" (wholly in its recording),
    "stream" (begins before it in the stream), "rest", "loop", "rows" or "anywhere"; ``stream`` (N,): id of the stream
    of the recording, or ""; ``window_rows`` and ``recording_rows`` (N, 2): rows of that stream which the window and its
    recording cover, −1 if unknown (always for "rest", "loop" and "rows"). ``vectors``: triples of inputs that are the
    axes of one vector; ``left_out``: recordings that gave no window, and gestures of free choice, with the reason.
    ``self_calibration``: "causal" if sensors calibrate themselves (`plushsense.windows.sessions`), else "".
    """

    integers: NDArray[np.int32]
    units: InputUnits
    y: NDArray[np.int64]
    labels: tuple[str, ...]
    affects: tuple[str, ...]
    families: tuple[str, ...]
    recording: NDArray[np.int64]
    recording_ids: tuple[str, ...]
    subject: NDArray[np.str_]
    context: NDArray[np.str_]
    stream: NDArray[np.str_]
    window_rows: NDArray[np.int64]
    recording_rows: NDArray[np.int64]
    rate_hz: float
    inputs: tuple[str, ...]
    vectors: tuple[tuple[int, ...], ...] = ()
    left_out: tuple[Message, ...] = ()
    self_calibration: str = ""

    def __len__(self) -> int:
        return len(self.y)

    @property
    def x(self) -> NDArray[np.floating[Any]]:
        """Return `InputUnits.values`, a new array at each call."""
        return self.units.values(self.integers)

    def take(self, index: NDArray[np.int64]) -> WindowSet:
        """Return the windows at ``index``; ``recording`` still refers to all ``recording_ids``."""
        per_window = ("integers", "y", "recording", "subject", "context", "stream", "window_rows", "recording_rows")
        return replace(self, **{name: getattr(self, name)[index] for name in per_window})

    def only(self, inputs: Sequence[str]) -> WindowSet:
        """Return the windows with some of the inputs."""
        at = [self.inputs.index(name) for name in inputs]
        vectors = tuple(tuple(at.index(axis) for axis in axes) for axes in self.vectors if set(axes) <= set(at))
        return replace(
            self, integers=self.integers[:, at], units=self.units.only(at), inputs=tuple(inputs), vectors=vectors
        )

    def __repr__(self) -> str:
        n, f, t = self.integers.shape
        kinds = ", ".join(f"{int((self.context == c).sum())} {c}" for c in np.unique(self.context))
        return (
            f"WindowSet({plural(n, 'window')} of {plural(f, 'channel')} × {t} samples at {self.rate_hz:g} Hz, "
            f"{plural(len(np.unique(self.recording)), 'recording')}, {len(self.labels)} classes; {kinds or 'empty'})"
        )


@dataclass
class WindowCut:
    """One window (T, F) of integers, before `assemble` makes a set of windows.

    ``begin`` is the sample of the recording's segment at which it begins (`from_recording`).
    """

    x: NDArray[np.int64]
    context: str
    window_rows: tuple[int, int]
    begin: int = 0


def from_recording(
    segments: list[Segment], dataset: Dataset, window: int, step: int, rest: bool = False
) -> list[WindowCut]:
    """Cut full windows from every segment; if none is long enough, loop the longest, or with ``rest`` begin at rest."""
    cuts = []
    for segment in segments:
        if len(segment) >= window:
            x = network_inputs(segment.data, dataset.layout)
            begins = range(0, len(x) - window + 1, step)
            cuts += [WindowCut(x[s : s + window], "inside", (-1, -1), s) for s in begins]
    if not cuts and segments and rest:
        data = max(segments, key=len).data
        whole = np.concatenate([np.repeat(data[:1], window - len(data), axis=0), data])
        cuts.append(WindowCut(network_inputs(whole, dataset.layout), REST, (-1, -1)))
    elif not cuts and segments:
        x = network_inputs(max(segments, key=len).data, dataset.layout)
        repeated = np.tile(x, (-(-window // len(x)), 1))[:window]
        cuts.append(WindowCut(repeated, "loop", (-1, -1)))
    return cuts


# A segment with the inputs (T, F) of a network.
_Read = tuple[Segment, NDArray[np.int64]]


def _from_stream(segments: list[_Read], first: int, last: int, window: int, reach: int, step: int) -> list[WindowCut]:
    """Cut windows of ``reach`` samples that end in rows ``first`` to ``last`` of a stream.

    A window that would begin before its segment is not cut; then no later one of that segment is. If a gap or a clock
    reset divides the recording, parts before the last one give windows only if they are at least ``window`` long.
    """
    cuts: list[WindowCut] = []
    for segment, x in segments:
        if segment.first_row >= last or first >= segment.last_row:
            continue
        begin = int(np.searchsorted(segment.row_of, first, side="left"))
        end = int(np.searchsorted(segment.row_of, last, side="left"))
        ends = [begin + s + window for s in range(0, end - begin - window + 1, step)]
        if not ends and segment.last_row >= last and end > begin:
            ends = [end]
        if not ends or ends[0] < reach:
            continue
        for e in ends:
            rows = (int(segment.row_of[e - reach]), int(segment.row_of[e - 1]) + 1)
            cuts.append(WindowCut(x[e - reach : e], "inside" if e - reach >= begin else "stream", rows))
    return cuts


class RecordingCutter:
    """Cuts recordings into windows as a `WindowSpec` says; recordings of one stream should follow each other.

    Attributes:
        reach: samples of a window with what its network needs before it.
        left_out: recordings that gave no window, with the reason.
    """

    def __init__(self, dataset: Dataset, spec: WindowSpec) -> None:
        layout = dataset.layout
        self._dataset, self._spec = dataset, spec
        self._window, self._step = layout.samples(spec.window_s), layout.samples(spec.step_s)
        self.reach = max(self._window, layout.samples(spec.span_s) if spec.span_s else 0)
        self.left_out: list[Message] = []
        self._sessions = SessionReader(dataset)
        self._stream, self._segments = "", list[_Read]()

    def cut(self, recording: RecordingInfo) -> list[WindowCut]:
        """Return the windows of a recording; if there is none, add it to `left_out`."""
        cuts: list[WindowCut] = []
        if self._spec.context == "stream" and recording.stream_row >= 0:
            cuts = self._from_stream(recording)
        elif self._spec.context == ROWS:
            segments = whole_recording(self._dataset.read(recording), self._dataset.layout)
            cuts = from_recording(segments, self._dataset, self.reach, self._step)
            cuts = [replace(cut, context=ROWS) for cut in cuts]
        if not cuts and self._spec.context != ROWS:
            segments = self._sessions.recording(recording)
            # Where a stream begins too late or has a gap, rest was no better (docs/measurements/people.md).
            rest = self._spec.context == REST or (self._spec.context != "loop" and recording.stream_row < 0)
            cuts = from_recording(segments, self._dataset, self.reach, self._step, rest)
        if not cuts:
            still = recording.id in self._sessions.standing
            template = "{recording}: its clock stands still" if still else "{recording}: no valid sample"
            self.left_out.append(Message(template, recording=recording.id))
        return cuts

    def _from_stream(self, recording: RecordingInfo) -> list[WindowCut]:
        if recording.stream != self._stream:
            self._stream = recording.stream
            segments = self._sessions.stream(self._stream)
            self._segments = [(segment, network_inputs(segment.data, self._dataset.layout)) for segment in segments]
        first = recording.stream_row + recording.start
        last = recording.stream_row + recording.stop
        return _from_stream(self._segments, first, last, self._window, self.reach, self._step)

    def refuse_none(self, recordings: Sequence[RecordingInfo], gestures: GestureSet) -> None:
        """Raise DatasetError: the data set gives no window, maybe because clocks stand still."""
        name, standing = self._dataset.head.name, self._sessions.standing
        if standing:
            raise DatasetError(
                "Data set '{name}' gives no window: the clock stands still in {n} recordings, for instance in "
                "{standing}: import the files again with all digits of their times, or with row_rate_hz in a pattern.",
                name=name,
                n=len(standing),
                standing=min(standing),
            )
        raise DatasetError(
            "Data set '{name}' gives no window: {n:recording} of {of:gesture} ({labels}…).",
            name=name,
            n=len(recordings),
            of=len(gestures),
            labels=", ".join(gestures.labels[:6]),
        )


def cut_windows(
    dataset: Dataset,
    spec: WindowSpec | None = None,
    gestures: GestureSet | None = None,
    progress: Progress | None = None,
) -> WindowSet:
    """Cut the used recordings of ``dataset`` into windows.

    Args:
        gestures: the classes, in order; by default all of the data set but those of free choice, which `train` and
            `evaluate` leave out as well. Recordings of other gestures are left out.
        progress: called with (recordings done, total number of recordings).

    Raises:
        ConfigError: for the context ``anywhere``.
        DatasetError: if there is no window.
    """
    spec = spec or WindowSpec()
    if spec.context == ANYWHERE:
        raise ConfigError(
            "Windows anywhere in a stream are cut by plushsense.windows.anywhere.cut_anywhere: call that."
        )
    if spec.context == ROWS and dataset.layout.self_calibration:
        raise ConfigError(
            f"The layout '{dataset.layout.name}' calibrates its sensors in the course of a session, which the context "
            f"'{ROWS}' does not know: use the context stream, rest or loop."
        )
    of_choice = [] if gestures is not None else [g.label for g in dataset.gestures.gestures if g.free_choice]
    if gestures is None:
        gestures = dataset.gestures.subset([label for label in dataset.gestures.labels if label not in of_choice])
    left_out = [
        Message("{label}: free choice, everybody did something else", label=label, gestures=[label])
        for label in of_choice
    ]
    recordings, too_long = drop_long_recordings([r for r in dataset.used if r.gesture in gestures.labels], spec)
    recordings.sort(key=lambda r: (r.stream, r.id))
    cutter = RecordingCutter(dataset, spec)
    cuts: list[tuple[RecordingInfo, WindowCut]] = []
    for done, recording in enumerate(recordings, 1):
        cuts += [(recording, cut) for cut in cutter.cut(recording)]
        if progress is not None:
            progress(done, len(recordings))
    if not cuts:
        cutter.refuse_none(recordings, gestures)
    return replace(assemble(cuts, gestures, dataset), left_out=(*left_out, *too_long, *cutter.left_out))


def constant_windows(windows: WindowSet) -> Message | None:
    """Return a warning if windows are constant in time, None if none is."""
    constant = np.flatnonzero((windows.integers == windows.integers[:, :, :1]).all(axis=(1, 2)))
    if not len(constant):
        return None
    first = windows.recording_ids[windows.recording[constant[0]]]
    return Message(
        "{n} of {of} windows are constant in time, for instance of {recording}: look at the sensors and the clock "
        "with  plushsense check",
        n=len(constant),
        of=len(windows),
        recording=first,
    )


def drop_long_recordings(
    recordings: list[RecordingInfo], spec: WindowSpec
) -> tuple[list[RecordingInfo], list[Message]]:
    """Return the recordings to cut, and a description of each recording that was not stopped in time."""
    usual = usual_rows((r.gesture, r.subject, r.stop - r.start) for r in recordings)
    in_time, left_out = list[RecordingInfo](), list[Message]()
    for r in recordings:
        own_file = r.file.startswith(f"{RECORDINGS}/")
        if (
            spec.longest_factor
            and spec.context != ROWS
            and own_file
            and r.stop - r.start > spec.longest_factor * usual[r.gesture]
        ):
            left_out.append(
                Message(
                    "{recording}: {stop} rows where {label} usually has {usual:.0f}",
                    recording=r.id,
                    stop=r.stop - r.start,
                    label=r.gesture,
                    usual=usual[r.gesture],
                    gesture=[r.gesture],
                )
            )
        else:
            in_time.append(r)
    return in_time, left_out


def recordings_in_time(recordings: list[RecordingInfo], spec: WindowSpec | None = None) -> list[RecordingInfo]:
    """Return the recordings that were stopped in time, according to `WindowSpec.longest_factor`."""
    return drop_long_recordings(recordings, spec or WindowSpec())[0]


def assemble(cuts: list[tuple[RecordingInfo, WindowCut]], gestures: GestureSet, dataset: Dataset) -> WindowSet:
    ids = tuple(sorted({r.id for r, _ in cuts}))
    number = {identity: i for i, identity in enumerate(ids)}
    cuts = sorted(cuts, key=lambda cut: number[cut[0].id])
    # Layouts ensure that every input fits 32 bits.
    integers = np.stack([c.x.astype(np.int32).T for _, c in cuts])
    order = np.array([number[r.id] for r, _ in cuts], dtype=np.int64)
    rows = [(r.stream_row + r.start, r.stream_row + r.stop) if r.stream_row >= 0 else (-1, -1) for r, _ in cuts]

    def text(values: Iterable[str]) -> NDArray[np.str_]:
        return np.array(list(values), dtype=np.str_)

    return WindowSet(
        integers=integers,
        units=InputUnits.of(dataset.layout),
        y=np.array([gestures.index(r.gesture) for r, _ in cuts], dtype=np.int64),
        labels=gestures.labels,
        affects=gestures.affects,
        families=gestures.families,
        recording=order,
        recording_ids=ids,
        subject=text(r.subject for r, _ in cuts),
        context=text(c.context for _, c in cuts),
        stream=text(r.stream if r.stream_row >= 0 else "" for r, _ in cuts),
        window_rows=np.array([c.window_rows for _, c in cuts], dtype=np.int64),
        recording_rows=np.array(rows, dtype=np.int64),
        rate_hz=dataset.layout.rate_hz,
        inputs=dataset.layout.inputs,
        vectors=dataset.layout.input_vectors,
        self_calibration="causal" if dataset.layout.self_calibration else "",
    )


def shared_gestures(dataset: Dataset, share: float = 0.9) -> tuple[GestureSet, dict[str, str]]:
    """Return the gestures for a model of all people, and for each other gesture the reason why it is left out.

    Included are gestures that at least ``share`` of the people made, and those that are recorded without a person;
    never gestures of free choice.
    """
    # People whose recordings are all excluded do not count.
    people = {r.subject for r in dataset.used} - {NOBODY, UNKNOWN_SUBJECT}
    shared, left_out = [], {}
    for gesture in dataset.gestures.gestures:
        made = {r.subject for r in dataset.used if r.gesture == gesture.label}
        if gesture.free_choice:
            left_out[gesture.label] = "free choice: everybody did something else"
        elif not made:
            left_out[gesture.label] = "no recording"
        elif gesture.nobody or len(made & people) >= share * len(people):
            shared.append(gesture.label)
        else:
            left_out[gesture.label] = f"made by {len(made & people)} of {len(people)} people"
    return dataset.gestures.subset(shared), left_out
