"""The network as a scikit-learn classifier of arrays."""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import ArrayError, BundleError, need
from plushsense.core.gestures import Gesture, GestureSet, plain_label
from plushsense.core.layouts import DEVICE_MS, HOST_MS, Channel, CsvFormat, Layout, load_layout
from plushsense.core.version import __version__
from plushsense.deploy.quantize import calibration
from plushsense.models.arch import (
    DEFAULT_FILTERS,
    DEFAULT_SYMBOL,
    Arch,
    default_pooling,
    parse_symbol,
    symbol_at_rate,
    symbol_within,
)
from plushsense.models.bundle import Bundle
from plushsense.models.reference import softmax
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.splits import VALIDATION_SHARE
from plushsense.training.spec import PADDING, EpochRow, preset
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import InputUnits

ANONYMOUS = "arrays"
ANONYMOUS_RATE_HZ = 100.0

_INT32 = np.iinfo(np.int32).max
# Smallest number of steps in a channel's standard deviation, and largest number of steps up to its peak, which leaves
# room for later values.
_STEPS_IN_SPREAD = 2.0**16
_STEPS_IN_PEAK = 2.0**29
# Relative standard deviation below which a channel is constant but for rounding errors.
_CONSTANT = 1e-12
# Number of windows to predict at once, which limits memory: the output of a layer is kept for all of them.
_BATCH = 256
# Weights are scaled if an epoch would have fewer windows than X, or more than this many times as many.
_MOST_REPEATS = 10.0
# A default network that is shortened reads half of the window at a position, as the default does of 2.5 s, but at least
# this many samples. Accuracy on makeability, 5 folds by person, 30 epochs, one seed, of half and of the whole window:
# 0.477 and 0.457 with 100 samples, 0.388 and 0.383 with 60.
_SHORTEST_FIELD = 16
# The settings that are used only in training.
_TRAINING = ("preset", "epochs", "batch", "learning_rate", "random_state")


def rows_of(X: Any) -> tuple[Any, tuple[int, int] | None]:
    """Return windows (N, C, T) as rows (N, C·T), which scikit-learn can check, and (C, T); other input and None.

    Raises:
        ArrayError: for windows of different shapes, or more than three axes.
    """
    nested = np.asarray(X) if hasattr(X, "dtypes") else X  # a table of pandas, perhaps with a series in each cell
    if isinstance(nested, np.ndarray) and nested.dtype.kind == "O" and nested.size and _is_sequence(nested.flat[0]):
        nested = nested.tolist()
    if isinstance(nested, list | tuple) and nested and _is_sequence(nested[0]):
        try:
            X = np.asarray([np.asarray(window) for window in nested])
        except ValueError:
            raise ArrayError(
                "X has windows, or channels of a window, of different lengths, and the network reads one: cut "
                "recordings into windows (ps.cut_windows does it for a data set), or all to the shortest, as in "
                "np.stack([w[:, :n] for w in X])."
            ) from None
    shape = X.shape if hasattr(X, "shape") else np.asarray(X).shape
    if len(shape) < 3:
        return X, None
    if len(shape) > 3:
        raise ArrayError(f"X has the shape {shape}: expected (N, C, T), or (N, C·T) with channels=C.")
    return np.reshape(np.asarray(X), (shape[0], shape[1] * shape[2])), (shape[1], shape[2])


def _is_sequence(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, str | bytes | Mapping) and getattr(value, "ndim", 1) > 0


def shape_of(features: int, shape: tuple[int, int] | None, given: int | None) -> tuple[int, int]:
    """Return (C, T) of windows with C·T = ``features``; C is that of ``shape``, or else ``given``, or else 1.

    Raises:
        ArrayError: if they do not agree, or if ``shape`` seems to be (T, C).
    """
    if given is not None and (not isinstance(given, int | np.integer) or given < 1):
        raise ArrayError(f"channels is {given!r}: accepted are None and whole numbers from 1 up.")
    if shape is not None and (shape[0] > shape[1] if given is None else shape[0] != given):
        unless = f", or channels={shape[0]} if it does have so many" if given is None else ""
        expected = "fewer channels than samples" if given is None else f"{given} channels, as channels or layout say"
        raise ArrayError(
            f"X has windows of {shape[0]} channels of {shape[1]} samples; expected is (N, C, T) with {expected}. If X "
            f"is (N, T, C), give np.swapaxes(X, 1, 2){unless}."
        )
    channels = shape[0] if shape is not None else int(given or 1)
    if features % channels or features // channels < 2:
        raise ArrayError(
            f"X has n_features = {features}, and {channels} channels: expected is (N, C·T) with at least 2 samples of "
            "each channel."
        )
    return channels, features // channels


def balanced_by_class(
    weights: NDArray[np.float64], y: NDArray[Any], class_weight: Mapping[Any, float] | str | None
) -> NDArray[np.float64]:
    """Return the weights (N,) times those of the classes ``y`` (N,); "balanced" gives all classes the same sum."""
    from sklearn.utils.class_weight import compute_class_weight

    if class_weight is None:
        return weights
    classes, index = np.unique(y, return_inverse=True)
    if class_weight == "balanced":
        sums = np.bincount(index, weights)
        return np.asarray(weights * (sums.mean() / sums)[index])
    of_class = compute_class_weight(class_weight, classes=classes, y=y)
    if not (np.isfinite(of_class).all() and (of_class >= 0.0).all() and of_class.any()):
        raise ArrayError(f"class_weight is {class_weight}: give weights from 0 up, and one above 0.")
    return np.asarray(weights * of_class[index])


def in_own_order(x: NDArray[Any], *others: NDArray[Any]) -> NDArray[np.int64]:
    """Return an order of windows (N, C, T) and their ``others`` (N,) that does not depend on the order they are in."""
    keys = [blake2b(window.tobytes(), digest_size=16).digest() for window in x]
    return np.array(sorted(range(len(x)), key=lambda i: (*(o[i] for o in others), keys[i])), dtype=np.int64)


def anonymous_layout(x: NDArray[Any]) -> Layout:
    """Build a layout for windows (N, C, T) without channel names.

    Channels of integers of up to 32 bits have the step 1. The step of floats is a power of two, at most 1/65536 of the
    channel's standard deviation but about 2⁻²⁹ of its largest value or more; for a constant channel, it is the power of
    two at or below that value. The sampling rate is unknown and set to `ANONYMOUS_RATE_HZ`.
    """
    integers = x.dtype.kind in "biu"
    names = [f"channel {i}" for i in range(x.shape[1])]
    channels = tuple(
        Channel(name, "unknown", "unknown", step=_step(x[:, i].astype(np.float64), integers))
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


def _step(values: NDArray[np.float64], integers: bool) -> float:
    peak = float(np.abs(values).max())
    if peak == 0.0 or (integers and peak <= _INT32):
        return 1.0
    # Divide first: squares of large values may overflow.
    spread = float((values / peak).std())
    finest = max(spread / _STEPS_IN_SPREAD, 1.0 / _STEPS_IN_PEAK) if spread > _CONSTANT else 1.0
    return float(2.0 ** np.floor(np.log2(max(finest * peak, 1e-300))))


def to_integers(x: NDArray[Any], layout: Layout) -> NDArray[np.int32]:
    """Convert windows (N, C, T) to the integers that are the input of a network with this layout.

    Values are rounded to the steps of the layout. With an anonymous layout, they are clipped to 32 bits. With a real
    layout, they must be those of `cut_windows`: measured values in its steps.

    Raises:
        ArrayError: for values that are not finite; with a real layout, also between two steps or beyond 32 bits.
    """
    refuse_holes(x)
    units = InputUnits.of(layout)
    counted = units.counted(x)
    whole = np.rint(counted)
    if layout.name == ANONYMOUS:
        return np.asarray(np.clip(whole, -_INT32, _INT32), dtype=np.int32)
    if whole.size and (whole.max() > _INT32 or whole.min() < -_INT32 - 1):
        raise ArrayError(f"X has values beyond 32 bits, the limit of the layout '{layout.name}': check X.")
    for at, name in enumerate(layout.inputs):
        # float32 has 24 bits.
        apart = np.abs(counted[:, at] - whole[:, at]) > 0.01 + np.abs(x[:, at]) * units.steps[at] * 2.0**-23
        if name in layout.names and name not in layout.self_calibration and apart.any():
            step = layout.channels[layout.index(name)].step
            raise ArrayError(
                f"X has {float(x[:, at][apart][0]):g} in '{name}', which the layout '{layout.name}' counts in steps of "
                f"{step:g}: give x of cut_windows, and leave scaling to the classifier, or leave layout out."
            )
    return whole.astype(np.int32)


def refuse_holes(x: NDArray[Any]) -> None:
    """Raise ArrayError if there is NaN or infinity; the message has the position of the first."""
    if x.dtype.kind == "f" and not np.isfinite(x).all():
        bad = ~np.isfinite(x)
        window, channel, sample = (int(i) for i in np.argwhere(bad)[0])
        raise ArrayError(
            f"X has NaN or infinity in {int(bad.any(axis=(1, 2)).sum())} of {len(x)} windows, first in window "
            f"{window}, channel {channel}, sample {sample}: replace such values or leave these windows out."
        )


def windows_of(
    x: NDArray[np.int32], y: NDArray[np.int64], people: NDArray[np.str_], layout: Layout, gestures: GestureSet
) -> WindowSet:
    """Build a window set in which each window is a recording of its own."""
    n = len(x)
    rows = np.full((n, 2), -1, dtype=np.int64)
    return WindowSet(
        integers=x,
        units=InputUnits.of(layout),
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
        vectors=layout.input_vectors,
    )


def gestures_of(classes: NDArray[Any], known: GestureSet | None = None) -> GestureSet:
    """Build a gesture for each class, in class order, with affect and family where ``known`` has the label.

    If labels are empty or equal in a gesture set (as ``a`` and ``A``), all labels get their class number as a prefix.
    """
    texts = [str(c) for c in classes.tolist()]
    plain = [plain_label(t) for t in texts]
    if "" in plain or len(set(plain)) < len(plain):
        texts = [f"class {i}: {t}" for i, t in enumerate(texts)]
    matches = [known.find(t) if known is not None else None for t in texts]
    gestures = tuple(replace(g, label=t) if g else Gesture(t) for g, t in zip(matches, texts, strict=True))
    return GestureSet(known.name if known is not None else ANONYMOUS, gestures, inferred=known is None)


def _labels_table(classes: NDArray[Any]) -> dict[str, Any]:
    """Return the labels of ``classes`` in the form that a bundle stores and `labels_from` restores."""
    values = classes.tolist()
    plain = all(isinstance(v, str | int | float) for v in values)
    dtype = classes.dtype.str if plain and classes.dtype.kind != "O" else "O"
    return {"labels": values if plain else [str(v) for v in values], "dtype": dtype}


def labels_from(bundle: Bundle) -> NDArray[Any]:
    """Restore the class labels of a bundle with their type; without a stored table, return its gestures' labels.

    Raises:
        BundleError: for a stored table that does not fit.
    """
    table = bundle.provenance.get("estimator", {})
    if "labels" not in table:
        return np.array(bundle.gestures.labels)
    try:
        kind = np.dtype(table["dtype"])
        if kind.itemsize > 1 << 16 or len(table["labels"]) != len(bundle.gestures):
            raise ValueError("another number or size of labels")
        return np.array(table["labels"], dtype=kind)
    except (KeyError, TypeError, ValueError, OverflowError) as cause:
        raise BundleError(f"The bundle's class labels cannot be read ({cause}): train again.") from None


if TYPE_CHECKING:
    from plushsense.training.fit import FittedNetwork

if TYPE_CHECKING or importlib.util.find_spec("sklearn") is None:
    # PlushClassifier must be importable without scikit-learn (`from plushsense import *`); constructing one then raises
    # MissingExtraError. Type checkers use these declarations as well.
    class BaseEstimator:
        def __new__(cls, *_: Any, **__: Any) -> Self:
            need("sklearn", "baselines")
            return super().__new__(cls)

        def get_params(self, deep: bool = True) -> dict[str, Any]: ...
        def set_params(self, **params: Any) -> Self: ...
        def set_fit_request(self, *, groups: bool | str | None = None) -> Self: ...
        def __sklearn_tags__(self) -> Any: ...
        def __getstate__(self) -> dict[str, Any]: ...
        def __setstate__(self, state: dict[str, Any]) -> None: ...

    class ClassifierMixin:
        def score(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> float: ...

else:
    from sklearn.base import BaseEstimator, ClassifierMixin


class PlushClassifier(ClassifierMixin, BaseEstimator):
    """A small 1D CNN as a scikit-learn classifier of windows.

        windows = ps.cut_windows(dataset)
        y = np.array(windows.labels)[windows.y]
        model = ps.PlushClassifier(layout=dataset.layout)
        cross_val_score(model, windows.x, y, groups=windows.subject, cv=LeaveOneGroupOut())
        model.fit(windows.x, y).save("model.plush", gestures=dataset.gestures)     # for ``plushsense live``

    ``X`` has shape (N, C, T), N windows of C channels of T samples, or (N, C·T) as from ``X.reshape(N, -1)``, one
    channel after the other; ``fit`` and ``predict`` may get different forms. Without ``channels`` and ``layout``, rows
    have one channel, and (N, C, T) with more channels than samples is refused, as it may be (N, T, C). Labels may be of
    any type that scikit-learn can sort. The order of the windows does not matter. ``partial_fit`` is not supported.

    Training needs the extra ``train`` (PyTorch); a trained or unpickled classifier predicts without it. A pickle
    contains the network as the bytes of a bundle, without objects of PyTorch.

    Args:
        arch, filters, padding, norm, pooling: the network (see `Arch`). With arch None it is the default network, at
            the rate of ``layout``; if T is less than its receptive field, its layers are shortened, so that they reach
            over half of the window, with a warning. With padding None the preset's is used, which for most presets is
            ``stream`` and requires T to be at least the receptive field; ``mirror`` works with any T from 2. With
            pooling None it is that of `plushsense.models.arch.default_pooling`.
        preset, epochs, batch, learning_rate: settings of the training; None: the value of the preset.
        channels: number of channels C in rows (N, C·T); default: that of ``layout``, else 1.
        layout: a `Layout`, its name or its path, if ``X`` has the values of `cut_windows`. Vectors are then rotated
            in training as by `train`, and the bundle can be used with a toy. Without it, channels are anonymous (see
            `anonymous_layout`).
        random_state: an integer for reproducible weights, a RandomState, or None.
        class_weight: a weight for each label (others have 1), "balanced" (all classes count alike), or None.

    Attributes:
        classes_: the labels in class order, (K,).
        n_features_in_: C·T.
        bundle_: the trained `Bundle`; its gestures are the classes.
        history_: one row for each epoch, as `Fitted.history`.

    Raises:
        ArrayError: for arrays that do not fit; scikit-learn's own checks raise ValueError or NotFittedError.
    """

    # With metadata routing, ``groups`` is passed to ``fit`` unless set_fit_request changes that.
    __metadata_request__fit = {"groups": True}  # noqa: RUF012, RUF100

    classes_: NDArray[Any]
    n_features_in_: int
    bundle_: Bundle
    history_: list[EpochRow]

    def __init__(
        self,
        arch: str | None = None,
        filters: Sequence[int] | str = DEFAULT_FILTERS,
        padding: str | None = None,
        norm: str = "batch",
        pooling: str | None = None,
        preset: str = "people",
        epochs: int | None = None,
        batch: int | None = None,
        learning_rate: float | None = None,
        channels: int | None = None,
        layout: Layout | str | os.PathLike[str] | None = None,
        random_state: int | np.random.RandomState | None = 0,
        class_weight: Mapping[Any, float] | str | None = None,
    ) -> None:
        self.arch = arch
        self.filters = filters
        self.padding = padding
        self.norm = norm
        self.pooling = pooling
        self.preset = preset
        self.epochs = epochs
        self.batch = batch
        self.learning_rate = learning_rate
        self.channels = channels
        self.layout = layout
        self.random_state = random_state
        self.class_weight = class_weight

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        return tags

    def fit(
        self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Train on the windows ``X`` with the labels ``y`` (N,).

        ``groups`` (N,) has the person of each window; the bundle stores these names, so that `forget` can find it. With
        a preset that stops early (``loso``, ``paper``), 15 % of the people are held out for validation, or without
        groups 15 % of the windows, which is leaky. Other presets train on all of ``X``.

        A window with the ``sample_weight`` 2 counts like two such windows, and one with 0 not at all. These weights,
        times those of ``class_weight``, are scaled to a mean of 1 to 10; they have no effect on validation.
        """
        from plushsense.training.fit import fit

        layout = self._known_layout()
        x, labels = self._windows(X, y, layout)
        x, labels, people, weights = self._weighted(x, labels, groups, sample_weight)
        classes, index = np.unique(labels, return_inverse=True)
        if len(classes) < 2:
            listed = ", ".join(map(str, classes))
            raise ArrayError(f"y has {len(classes)} class with a weight ({listed}): a classifier needs at least two.")
        numbers = {name: _python_number(getattr(self, name)) for name in ("epochs", "batch", "learning_rate")}
        layout = layout or anonymous_layout(x)
        symbol = self._symbol(x.shape[2], layout.rate_hz)
        spec = preset(self.preset, parse_symbol(symbol).vector is not None, **numbers, seed=_seed(self.random_state))
        arch = self._network(symbol, x.shape[1], len(classes), x.shape[2])
        x = to_integers(x, layout)
        order = in_own_order(x, index, *([people] if groups is not None else []))
        x, index, weights = x[order], index[order].astype(np.int64), weights[order]
        people = people[order] if groups is not None else np.arange(len(x)).astype(str)
        windows = windows_of(x, index, people, layout, gestures_of(classes))
        held_back = np.zeros(len(x), dtype=bool)
        if spec.patience is not None and len(names := np.unique(people)) > 1:
            drawn = np.random.default_rng(spec.seed).permutation(names)
            held_back = np.isin(people, drawn[: max(1, round(VALIDATION_SHARE * len(names)))])
        trained = weights[~held_back]
        scaling = np.clip(trained.mean(), 1.0, _MOST_REPEATS) / trained.mean()
        fitted = fit(
            windows.take(np.flatnonzero(~held_back)),
            windows.take(np.flatnonzero(held_back)),
            arch,
            spec,
            weights=None if (trained == 1.0).all() else trained * scaling,
        )
        self.classes_, self.history_ = classes, fitted.history
        people_of = [sorted(set(people[p].tolist())) for p in (~held_back, held_back) if groups is not None]
        origin: dict[str, Any] = {
            "dataset": "arrays given to PlushClassifier",
            "estimator": {"settings": self._settings(), **_labels_table(classes)},
            "windows": len(x),
            "weighted": bool((trained != 1.0).any()),
            "subjects": people_of[0] if people_of else [],
            "validation_subjects": people_of[1] if people_of else [],
            "split": "none",
            "preset": self.preset,
            "training": spec.to_dict(),
            "code_version": __version__,
        }
        self.bundle_ = self._bundle(arch, fitted, windows.take(np.flatnonzero(~held_back)), layout, origin)
        return self

    def _bundle(
        self, arch: Arch, fitted: FittedNetwork, trained: WindowSet, layout: Layout, origin: dict[str, Any]
    ) -> Bundle:
        return Bundle(
            arch=arch,
            weights=fitted.weights,
            layout=layout,
            scaler=fitted.scaler,
            gestures=gestures_of(self.classes_),
            windowing={"window_s": trained.integers.shape[2] / layout.rate_hz, "context": "unknown"},
            decision=DecideSpec().to_dict(),
            provenance=origin,
            calibration=calibration(arch, fitted.weights, fitted.scaler, trained.integers),
        )

    def _weighted(
        self, x: NDArray[Any], labels: NDArray[Any], groups: ArrayLike | None, sample_weight: ArrayLike | None
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.str_], NDArray[np.float64]]:
        """Return windows, labels, people and weights of the windows with a weight above 0."""
        from sklearn.utils.validation import _check_sample_weight

        rows = x.reshape(len(x), -1)
        weights = _check_sample_weight(sample_weight, rows, dtype=np.float64, ensure_non_negative=True)
        # Without groups, each window counts as another person.
        people = np.asarray(np.arange(len(x)) if groups is None else groups)
        if people.shape != (len(x),):
            raise ArrayError(f"groups has the shape {people.shape}: expected ({len(x)},), one a window.")
        some = weights > 0.0
        weights = balanced_by_class(weights[some], labels[some], self.class_weight)
        return x[some], labels[some], people[some].astype(str), weights

    def _windows(self, X: ArrayLike, y: ArrayLike, layout: Layout | None) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return windows (N, C, T) and labels (N,) that scikit-learn has checked."""
        from sklearn.utils.multiclass import check_classification_targets
        from sklearn.utils.validation import validate_data

        rows, shape = rows_of(X)
        rows, labels = validate_data(self, rows, y, ensure_all_finite=False)
        given = self.channels
        if layout is not None:
            if given not in (None, layout.n_inputs):
                raise ArrayError(f"channels is {given}, but the layout '{layout.name}' has {layout.n_inputs} inputs.")
            given = layout.n_inputs
        x = rows.reshape(len(rows), *shape_of(rows.shape[1], shape, given))
        refuse_holes(x)
        check_classification_targets(labels)
        return x, labels

    def decision_function(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return logits (N, K) in the order of ``classes_``; for two classes the second minus the first, (N,)."""
        logits = self._logits(X)
        return logits[:, 1] - logits[:, 0] if logits.shape[1] == 2 else logits

    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return probabilities (N, K) in the order of ``classes_``."""
        return softmax(self._logits(X))

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the most probable label of each window, (N,)."""
        best = self._logits(X).argmax(axis=1)
        return np.asarray(self.classes_[best])

    def to_bundle(self, gestures: GestureSet | None = None) -> Bundle:
        """Return the trained network as a bundle, with the affects and families of ``gestures``."""
        from sklearn.utils.validation import check_is_fitted

        check_is_fitted(self, "bundle_")
        if gestures is None:
            return self.bundle_
        return replace(self.bundle_, gestures=gestures_of(self.classes_, gestures))

    def save(self, path: str | os.PathLike[str], gestures: GestureSet | None = None) -> Path:
        """Save the bundle (``*.plush``), for `load`, ``plushsense live`` and `from_bundle`."""
        return self.to_bundle(gestures).save(Path(path))

    @classmethod
    def from_bundle(cls, bundle: Bundle | str | os.PathLike[str]) -> Self:
        """Build a trained classifier from a bundle; ``X`` must have the same form and units as in its training."""
        bundle = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
        arch = bundle.arch
        settings: dict[str, Any] = {
            "arch": arch.symbol,
            "filters": arch.filters,
            "padding": arch.padding,
            "norm": arch.norm,
            "pooling": arch.pooling,
            "channels": arch.channels,
            "layout": None if bundle.layout.name == ANONYMOUS else bundle.layout,
        }
        stored = bundle.provenance.get("estimator", {}).get("settings", {})
        classifier = cls(**settings, **{name: stored[name] for name in _TRAINING if name in stored})
        classifier.bundle_, classifier.classes_, classifier.history_ = bundle, labels_from(bundle), []
        classifier.n_features_in_ = arch.channels * max(arch.window, arch.span)
        return classifier

    def __getstate__(self) -> dict[str, Any]:
        state = dict(super().__getstate__())
        if "bundle_" in state:
            state["bundle_"] = state["bundle_"].to_bytes()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = dict(state)
        if "bundle_" in state:
            state["bundle_"] = Bundle.from_bytes(state["bundle_"], "in the pickle")
        super().__setstate__(state)

    def _known_layout(self) -> Layout | None:
        if self.layout is None or isinstance(self.layout, Layout):
            return self.layout
        return load_layout(self.layout if isinstance(self.layout, str) else Path(self.layout))

    def _symbol(self, samples: int, rate_hz: float) -> str:
        """Return the symbol of the network for windows of ``samples``; the default one is shortened if needed."""
        symbol = symbol_at_rate(DEFAULT_SYMBOL, rate_hz) if self.arch is None else self.arch
        if self.arch is None and (shorter := symbol_within(symbol, samples)) != symbol:
            shorter = symbol_within(symbol, max(samples // 2, min(samples, _SHORTEST_FIELD)))
            shorter = Arch.parse(shorter, self.filters).symbol
            warnings.warn(
                f"X has windows of {samples} samples, fewer than the default network {symbol} reads: it is shortened "
                f"to {shorter}. With arch='{shorter}' there is no warning.",
                stacklevel=3,
            )
            symbol = shorter
        return symbol

    def _network(self, symbol: str, channels: int, classes: int, samples: int) -> Arch:
        """Return the network for windows of (C, T); raise ArrayError if they are too short for it."""
        padding = PADDING[self.preset] if self.padding is None else self.padding
        arch = Arch.parse(
            symbol,
            self.filters,
            channels=channels,
            classes=classes,
            padding=padding,
            norm=self.norm,
            pooling=self.pooling,
            window=samples,
            step=1,
        )
        free = samples if padding != "stream" else samples - arch.receptive_field + 1
        if arch.receptive_field > samples:
            problem = (
                f"X has windows of {samples} samples, but {arch.symbol} with padding '{padding}' needs at least "
                f"{arch.receptive_field}: give longer windows or a shorter network (arch=None makes one that fits)"
            )
            if padding == "stream":
                raise ArrayError(f"{problem}, or padding='mirror'.")
            warnings.warn(f"{problem}.", stacklevel=3)
        arch = replace(arch, step=min(5, free), pool=None)
        return arch if self.pooling else replace(arch, pooling=default_pooling(arch))

    def _settings(self) -> dict[str, Any]:
        """Return the training settings as a bundle stores them for `from_bundle`."""
        stored = {name: _python_number(getattr(self, name)) for name in _TRAINING}
        return stored | {"random_state": stored["random_state"] if isinstance(stored["random_state"], int) else None}

    def _logits(self, X: ArrayLike) -> NDArray[np.float64]:
        from sklearn.utils.validation import check_is_fitted, validate_data

        check_is_fitted(self, "bundle_")
        channels = self.bundle_.arch.channels
        expected = (channels, self.n_features_in_ // channels)
        rows, shape = rows_of(X)
        if shape not in (None, expected):
            swap = ": give np.swapaxes(X, 1, 2)" if shape == expected[::-1] else ""
            raise ArrayError(
                f"X has the shape {np.asarray(X).shape}: expected (N, {expected[0]}, {expected[1]}), as in fit{swap}."
            )
        rows = validate_data(self, rows, reset=False, ensure_all_finite=False)
        network, scaler = self.bundle_.network(), self.bundle_.scaler
        x = rows.reshape(len(rows), *expected)
        if self.bundle_.layout.name == ANONYMOUS and x.dtype.kind == "f":
            steps = np.array([c.step for c in self.bundle_.layout.channels])
            coarse = (steps == 1.0) & (scaler.scale > 2.0 / _STEPS_IN_SPREAD)
            if (np.rint(x[:, coarse]) != x[:, coarse]).any():
                warnings.warn(
                    "X has fractions, but the windows in fit were whole numbers, to which they are rounded: give the "
                    "same units as in fit.",
                    stacklevel=3,
                )
        x = to_integers(x, self.bundle_.layout)
        return np.concatenate([network.forward(scaler.apply(x[at : at + _BATCH])) for at in range(0, len(x), _BATCH)])


def _seed(random_state: Any) -> int:
    from sklearn.utils import check_random_state

    if isinstance(random_state, int | np.integer):
        return int(random_state)
    return int(check_random_state(random_state).randint(np.iinfo(np.int32).max))


def _python_number(value: Any) -> Any:
    """Convert a NumPy number to a Python number; return other values unchanged."""
    return value.item() if isinstance(value, np.generic) else value
