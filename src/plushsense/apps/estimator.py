"""A classifier of scikit-learn, for people who have arrays and know its tools and not ours."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense import __version__
from plushsense.apps.arrays import (
    ANONYMOUS,
    anonymous_layout,
    gestures_of,
    labels_from,
    labels_table,
    people_of,
    refuse_holes,
    rows_of,
    shape_of,
    to_integers,
    watching_of,
    windows_of,
)
from plushsense.core.errors import ArrayError
from plushsense.core.extras import need
from plushsense.core.gestures import GestureSet
from plushsense.core.signal import Layout, load_layout
from plushsense.deploy.calibration import calibration
from plushsense.live.decide import DecideSpec
from plushsense.models.arch import DEFAULT_FILTERS, DEFAULT_SYMBOL, Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import softmax
from plushsense.training.spec import PADDING, preset

if TYPE_CHECKING or importlib.util.find_spec("sklearn") is None:
    # The name must load in every install (`from plushsense import *`), so what scikit-learn would give is only
    # declared here; making a classifier says what to install. The type checker reads the same lines.
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

# Windows at a time: what a layer computes is in memory whole.
_READ = 256


class PlushClassifier(ClassifierMixin, BaseEstimator):
    """Learns to tell windows apart: a small 1D CNN, with the manners of scikit-learn.

        windows = ps.cut_windows(dataset)
        y = np.array(windows.labels)[windows.y]
        model = ps.PlushClassifier(layout=dataset.layout)
        cross_val_score(model, windows.x, y, groups=windows.subject, cv=LeaveOneGroupOut())
        model.fit(windows.x, y).save("model.plush", gestures=dataset.gestures)     # for ``plushsense live``

    ``X`` is (N, C, T): N windows of C channels of T samples; or (N, C·T), as ``X.reshape(N, -1)`` makes it and
    pipelines pass it on: one channel after the other, how many says ``channels`` (1 where neither it nor ``layout`` is
    given). Both forms may be mixed between ``fit`` and ``predict``. Labels may be of any type that scikit-learn
    sorts; ``predict`` gives the same type back. Sample weights are not supported, nor is ``partial_fit``.

    Training needs the extra ``train`` (PyTorch); a trained or unpickled classifier predicts without it. A pickle holds
    the network as a bundle's bytes and no object of PyTorch.

    Args:
        arch, filters, padding, norm: the network (see `Arch`). The padding None is the preset's: ``stream`` for
            most, which needs T of at least the receptive field; ``mirror`` works with any T from 2.
        preset, epochs, batch, learning_rate: the training; None keeps the preset's number.
        channels: how many channels a row (N, C·T) holds.
        layout: a `Layout`, or its name or path, where ``X`` holds the integers of `cut_windows`: then vectors are
            turned in training as `train` does, and the bundle reads a toy. Without it, channels are anonymous, floats
            are read in steps of at most 1/65536 of a channel's spread, and the bundle assumes 100 Hz.
        random_state: a whole number gives the same weights each time; also a RandomState, or None for chance.

    Attributes:
        classes_: the labels in class order, (K,).
        n_features_in_: C·T.
        bundle_: the trained `Bundle`; its gestures are the classes.
        history_: one row an epoch, as `Fitted.history`.

    Raises:
        ArrayError: a ValueError, for arrays that do not fit. What scikit-learn checks itself it refuses in its own
            words (ValueError, NotFittedError).
    """

    # With metadata routing on, groups reach ``fit`` unless set_fit_request says otherwise.
    __metadata_request__fit = {"groups": True}  # noqa: RUF012 - read by scikit-learn, which wants a plain dict

    classes_: NDArray[Any]
    n_features_in_: int
    bundle_: Bundle
    history_: list[dict[str, Any]]

    def __init__(
        self,
        arch: str = DEFAULT_SYMBOL,
        filters: Sequence[int] | str = DEFAULT_FILTERS,
        padding: str | None = None,
        norm: str = "batch",
        preset: str = "people",
        epochs: int | None = None,
        batch: int | None = None,
        learning_rate: float | None = None,
        channels: int | None = None,
        layout: Layout | str | os.PathLike[str] | None = None,
        random_state: int | np.random.RandomState | None = 0,
    ) -> None:
        self.arch = arch
        self.filters = filters
        self.padding = padding
        self.norm = norm
        self.preset = preset
        self.epochs = epochs
        self.batch = batch
        self.learning_rate = learning_rate
        self.channels = channels
        self.layout = layout
        self.random_state = random_state

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        return tags

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Self:
        """Train on the windows ``X`` with the labels ``y`` (N,).

        ``groups`` (N,) names the person of each window. Under a preset that stops early (``loso``, ``paper``) 15 % of
        the people decide when; without groups 15 % of the windows do, which is leaky. Other presets train on all of X.
        The bundle keeps their names, as that of `train` does, so that `forget` finds it.
        """
        from sklearn.utils.multiclass import check_classification_targets
        from sklearn.utils.validation import validate_data

        from plushsense.training.fit import fit

        layout = self._known_layout()
        rows, found = rows_of(X)
        rows, labels = validate_data(self, rows, y, ensure_all_finite=False)
        asked = self.channels
        if layout is not None:
            if asked not in (None, layout.n_inputs):
                raise ArrayError(f"channels is {asked}, but the layout '{layout.name}' has {layout.n_inputs} inputs.")
            asked = layout.n_inputs
        channels, samples = shape_of(rows.shape[1], found, asked)
        x = rows.reshape(len(rows), channels, samples)
        refuse_holes(x)
        check_classification_targets(labels)
        classes, index = np.unique(labels, return_inverse=True)
        if len(classes) < 2:
            raise ArrayError(f"y holds one class ({classes[0]!s}) and no other: telling apart needs at least two.")
        spec = preset(
            self.preset,
            epochs=_plain(self.epochs),
            batch=_plain(self.batch),
            learning_rate=_plain(self.learning_rate),
            seed=_seed(self.random_state),
        )
        layout = layout or anonymous_layout(x)
        gestures = gestures_of(classes)
        arch = Arch.parse(
            self.arch,
            self.filters,
            channels=channels,
            classes=len(classes),
            padding=PADDING[self.preset] if self.padding is None else self.padding,
            norm=self.norm,
            window=samples,
            step=min(5, samples),
        )
        if arch.span > samples:
            raise ArrayError(
                f"X has windows of {samples} samples, but {arch.symbol} under the padding '{arch.padding}' sees "
                f"{arch.span}: give longer windows, a shorter network, or padding='mirror'."
            )
        people = people_of(groups, len(x))
        windows = windows_of(to_integers(x, layout), index.astype(np.int64), people, layout, gestures)
        watching = watching_of(people, spec.seed) if spec.patience is not None else np.zeros(len(x), dtype=bool)
        fitted = fit(
            windows.take(np.flatnonzero(~watching)),
            windows.take(np.flatnonzero(watching)) if watching.any() else None,
            arch,
            spec,
        )
        named = groups is not None
        self.classes_, self.history_ = classes, fitted.history
        self.bundle_ = Bundle(
            arch=arch,
            weights=fitted.weights,
            layout=layout,
            scaler=fitted.scaler,
            gestures=gestures,
            windowing={"window_s": samples / layout.rate_hz, "context": "unknown"},
            decision=DecideSpec().to_dict(),
            provenance={
                "dataset": "arrays given to PlushClassifier",
                "estimator": {"settings": self._settings(), **labels_table(classes)},
                "windows": len(x),
                "subjects": sorted(set(people[~watching].tolist())) if named else [],
                "validation_subjects": sorted(set(people[watching].tolist())) if named else [],
                "split": "none",
                "preset": self.preset,
                "training": spec.to_dict(),
                "code_version": __version__,
            },
            calibration=calibration(arch, fitted.weights, fitted.scaler, windows.x[~watching]),
        )
        return self

    def decision_function(self, X: ArrayLike) -> NDArray[np.float64]:
        """Logits (N, K) in the order of ``classes_``; of two classes the second's minus the first's, (N,)."""
        logits = self._logits(X)
        return logits[:, 1] - logits[:, 0] if logits.shape[1] == 2 else logits

    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Probabilities (N, K) in the order of ``classes_``."""
        return softmax(self._logits(X))

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """The most probable label of each window, (N,)."""
        best = self._logits(X).argmax(axis=1)
        found: NDArray[Any] = self.classes_[best]
        return found

    def to_bundle(self, gestures: GestureSet | None = None) -> Bundle:
        """The trained network as a bundle; affects and families come from ``gestures`` where it knows the labels."""
        from sklearn.utils.validation import check_is_fitted

        check_is_fitted(self, "bundle_")
        return (
            self.bundle_ if gestures is None else replace(self.bundle_, gestures=gestures_of(self.classes_, gestures))
        )

    def save(self, path: str | os.PathLike[str], gestures: GestureSet | None = None) -> Path:
        """Save the bundle (``*.plush``), for `load`, ``plushsense live`` and `from_bundle`."""
        return self.to_bundle(gestures).save(Path(path))

    @classmethod
    def from_bundle(cls, bundle: Bundle | str | os.PathLike[str]) -> Self:
        """A trained classifier from a bundle, whoever trained it; ``X`` is then what that training read."""
        bundle = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
        arch = bundle.arch
        settings: dict[str, Any] = {
            "arch": arch.symbol,
            "filters": arch.filters,
            "padding": arch.padding,
            "norm": arch.norm,
            "channels": arch.channels,
            "layout": None if bundle.layout.name == ANONYMOUS else bundle.layout,
        }
        kept = bundle.provenance.get("estimator", {}).get("settings", {})
        made = cls(**settings, **{name: kept[name] for name in _TRAINING if name in kept})
        made.bundle_, made.classes_, made.history_ = bundle, labels_from(bundle), []
        made.n_features_in_ = arch.channels * max(arch.window, arch.span)
        return made

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

    def _settings(self) -> dict[str, Any]:
        """The training's settings as a bundle keeps them for `from_bundle`."""
        kept = {name: _plain(getattr(self, name)) for name in _TRAINING}
        return kept | {"random_state": kept["random_state"] if isinstance(kept["random_state"], int) else None}

    def _logits(self, X: ArrayLike) -> NDArray[np.float64]:
        from sklearn.utils.validation import check_is_fitted, validate_data

        check_is_fitted(self, "bundle_")
        channels = self.bundle_.arch.channels
        shape = (channels, self.n_features_in_ // channels)
        rows, found = rows_of(X)
        if found not in (None, shape):
            raise ArrayError(f"X has the shape {np.asarray(X).shape}: expected (N, {shape[0]}, {shape[1]}), as in fit.")
        rows = validate_data(self, rows, reset=False, ensure_all_finite=False)
        x = to_integers(rows.reshape(len(rows), *shape), self.bundle_.layout)
        network, scaler = self.bundle_.network(), self.bundle_.scaler
        return np.concatenate([network.forward(scaler.apply(x[at : at + _READ])) for at in range(0, len(x), _READ)])


# The settings that only the training reads.
_TRAINING = ("preset", "epochs", "batch", "learning_rate", "random_state")


def _seed(random_state: Any) -> int:
    from sklearn.utils import check_random_state

    if isinstance(random_state, int | np.integer):
        return int(random_state)
    return int(check_random_state(random_state).randint(np.iinfo(np.int32).max))


def _plain(value: Any) -> Any:
    """A number of NumPy, as a grid of settings holds them, as Python's."""
    return value.item() if isinstance(value, np.generic) else value
