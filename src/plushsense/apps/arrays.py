"""Arrays from Python as the rest of PlushSense reads them: integers of a layout, windows, a gesture set.

A layout is what turns numbers into integers: ``round(value / step)`` a channel. Arrays that come without one get an
honest one ("channel 0", "channel 1", …), whose steps are chosen by their values, so that a network trained on them is
a bundle like any other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import ArrayError
from plushsense.core.gestures import Gesture, GestureSet, plain_label
from plushsense.core.signal import DEVICE_MS, HOST_MS, Channel, CsvFormat, Layout
from plushsense.models.bundle import Bundle
from plushsense.scoring.splits import VALIDATION_SHARE
from plushsense.windows.cut import WindowSet

ANONYMOUS = "arrays"
ANONYMOUS_RATE_HZ = 100.0

_INT32 = np.iinfo(np.int32).max
# Steps in one spread (standard deviation) of a channel, and steps up to its largest value, which leave room for twice
# that value later.
_STEPS_IN_SPREAD = 2.0**16
_STEPS_IN_PEAK = 2.0**29
# What a sum's rounding leaves of a channel's spread that has none.
_CONSTANT = 1e-12


def rows_of(X: Any) -> tuple[Any, tuple[int, int] | None]:
    """``X`` as scikit-learn checks it: windows (N, C, T) as rows (N, C·T), and (C, T); anything else untouched."""
    shape = X.shape if hasattr(X, "shape") else np.asarray(X).shape
    if len(shape) < 3:
        return X, None
    if len(shape) > 3:
        raise ArrayError(f"X has the shape {shape}: expected (N, C, T), or (N, C·T) with channels=C.")
    return np.reshape(np.asarray(X), (shape[0], shape[1] * shape[2])), (shape[1], shape[2])


def shape_of(features: int, found: tuple[int, int] | None, asked: int | None) -> tuple[int, int]:
    """(C, T) of windows: as they came, else as asked for, else one channel."""
    if asked is not None and (not isinstance(asked, int | np.integer) or asked < 1):
        raise ArrayError(f"channels is {asked!r}: accepted are None and whole numbers from 1 up.")
    if found is not None and asked is not None and found[0] != asked:
        raise ArrayError(
            f"X holds windows of {found[0]} channels, but channels or layout say {asked}: change one of them."
        )
    channels = found[0] if found is not None else int(asked or 1)
    if features % channels:
        raise ArrayError(f"X has n_features = {features}, which {channels} channels do not divide: give (N, C·T).")
    if features // channels < 2:
        raise ArrayError(
            f"X has n_features = {features} in {channels} channels: a window needs at least 2 samples of each."
        )
    return channels, features // channels


def people_of(groups: ArrayLike | None, n: int) -> NDArray[np.str_]:
    """Whose window each is; without groups each is its own."""
    people = np.arange(n) if groups is None else np.asarray(groups)
    if people.shape != (n,):
        raise ArrayError(f"groups has the shape {people.shape}: expected ({n},), one a window.")
    return people.astype(str)


def watching_of(people: NDArray[np.str_], seed: int) -> NDArray[np.bool_]:
    """The windows of the people who decide when to stop."""
    names = np.unique(people)
    if len(names) < 2:
        return np.zeros(len(people), dtype=bool)
    held = np.random.default_rng(seed).permutation(names)[: max(1, round(VALIDATION_SHARE * len(names)))]
    return np.isin(people, held)


def anonymous_layout(x: NDArray[Any]) -> Layout:
    """A layout for windows (N, C, T) of which only the numbers are known.

    Integers of up to 32 bits keep their value (step 1). Floats are read in steps of a power of two, at most 1/65536
    of the channel's spread but no finer than 2⁻²⁹ of its largest value; a constant channel, from which nothing is
    learnt, in steps as large as itself. The rate is unknown; 100 Hz stands in for it.
    """
    whole = x.dtype.kind in "biu"
    names = [f"channel {i}" for i in range(x.shape[1])]
    channels = tuple(
        Channel(name, "unknown", "unknown", step=_step(x[:, i].astype(np.float64), whole))
        for i, name in enumerate(names)
    )
    columns = (HOST_MS, DEVICE_MS, *names)
    return Layout(
        name=ANONYMOUS,
        title=f"Arrays of unknown sensors; {ANONYMOUS_RATE_HZ:g} Hz assumed",
        rate_hz=ANONYMOUS_RATE_HZ,
        channels=channels,
        wire=(DEVICE_MS, *names),
        derived=(),
        inputs=tuple(names),
        csv=CsvFormat(columns, columns, ", "),
    )


def _step(values: NDArray[np.float64], whole: bool) -> float:
    peak = float(np.abs(values).max())
    if peak == 0.0 or (whole and peak <= _INT32):
        return 1.0
    # Divided first: squares of large values would not be finite.
    spread = float((values / peak).std())
    finest = max(spread / _STEPS_IN_SPREAD, 1.0 / _STEPS_IN_PEAK) if spread > _CONSTANT else 1.0
    return float(2.0 ** np.floor(np.log2(max(finest * peak, 1e-300))))


def to_integers(x: NDArray[Any], layout: Layout) -> NDArray[np.int32]:
    """Windows (N, C, T) as the integers that a network of ``layout`` reads.

    With an anonymous layout, values are rounded to its steps, and what 32 bits do not hold is cut off. With a real
    one, windows are those of `cut_windows`, integers already.

    Raises:
        ArrayError: for values that are not finite, or no integers where the layout is real.
    """
    refuse_holes(x)
    if layout.name == ANONYMOUS:
        steps = np.array([c.step for c in layout.channels])
        whole: NDArray[np.int32] = np.clip(np.rint(x / steps[:, None]), -_INT32, _INT32).astype(np.int32)
        return whole
    if x.dtype.kind == "f" and (np.rint(x) != x).any():
        raise ArrayError(
            f"X holds values that are not whole numbers, but with the layout '{layout.name}' it must hold the integers "
            "that cut_windows gives: leave scaling to the classifier, or leave layout out."
        )
    if x.size and (x.max() > _INT32 or x.min() < -_INT32 - 1):
        raise ArrayError(f"X holds values beyond 32 bits, which the layout '{layout.name}' cannot hold: check X.")
    return x.astype(np.int32)


def refuse_holes(x: NDArray[Any]) -> None:
    """Refuse NaN and infinity, saying where the first is."""
    if x.dtype.kind == "f" and not np.isfinite(x).all():
        bad = ~np.isfinite(x)
        window, channel, sample = (int(i) for i in np.argwhere(bad)[0])
        raise ArrayError(
            f"X holds NaN or infinity in {int(bad.any(axis=(1, 2)).sum())} of {len(x)} windows, first in window "
            f"{window}, channel {channel}, sample {sample}: fill such places or leave these windows out."
        )


def windows_of(
    x: NDArray[np.int32], y: NDArray[np.int64], people: NDArray[np.str_], layout: Layout, gestures: GestureSet
) -> WindowSet:
    """Windows each of which is a recording of its own."""
    n = len(x)
    rows = np.full((n, 2), -1, dtype=np.int64)
    return WindowSet(
        x=x,
        y=y,
        labels=gestures.labels,
        affects=gestures.affects,
        families=gestures.families,
        recording=np.arange(n, dtype=np.int64),
        recording_ids=tuple(map(str, range(n))),
        subject=people,
        context=np.full(n, "inside"),
        stream=np.full(n, ""),
        window_rows=rows,
        recording_rows=rows,
        rate_hz=layout.rate_hz,
        inputs=layout.inputs,
        vectors=tuple(
            tuple(layout.inputs.index(axis) for axis in vector)
            for vector in layout.vectors
            if set(vector) <= set(layout.inputs)
        ),
    )


def gestures_of(classes: NDArray[Any], known: GestureSet | None = None) -> GestureSet:
    """A gesture a class, in class order; affect and family where ``known`` has the label.

    Labels that a gesture set would take for one (``a`` and ``A``), or that are empty, are told apart by their number.
    """
    texts = [str(c) for c in classes.tolist()]
    plain = [plain_label(t) for t in texts]
    if "" in plain or len(set(plain)) < len(plain):
        texts = [f"class {i}: {t}" for i, t in enumerate(texts)]
    found = [known.find(t) if known is not None else None for t in texts]
    gestures = tuple(replace(g, label=t) if g else Gesture(t) for g, t in zip(found, texts, strict=True))
    return GestureSet(known.name if known is not None else ANONYMOUS, gestures, inferred=known is None)


def labels_table(classes: NDArray[Any]) -> dict[str, Any]:
    """The labels of ``classes`` for a bundle, so that `labels_from` gives them back with their type."""
    values = classes.tolist()
    if not all(isinstance(v, str | int | float) for v in values):
        return {"labels": [str(v) for v in values], "dtype": "O"}
    return {"labels": values, "dtype": "O" if classes.dtype.kind == "O" else classes.dtype.str}


def labels_from(bundle: Bundle) -> NDArray[Any]:
    """The labels of a bundle's classes: as the classifier had them that made it, else the gestures' labels."""
    table = bundle.provenance.get("estimator", {})
    if "labels" not in table:
        return np.array(bundle.gestures.labels)
    return np.array(table["labels"], dtype=np.dtype(table["dtype"]))
