"""A classifier with the manners of scikit-learn, for people who have arrays and not a data set folder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import ConfigError, TrainingError, nearest
from plushsense.models.arch import DEFAULT_FILTERS, DEFAULT_SYMBOL, Arch
from plushsense.scoring.splits import VALIDATION_SHARE
from plushsense.training.spec import preset
from plushsense.windows.cut import WindowSet


class PlushClassifier:
    """Learns to tell windows (N, C, T) apart; ``fit``, ``predict``, ``predict_proba``, ``score``.

    Args:
        arch, filters, padding, norm: the network; the padding ``stream`` needs ``T`` of at least its span, which
            fits the window by default.
        preset, epochs, seed: the training.

    After ``fit``: ``classes_`` the labels in class order, ``arch_``, ``history_``, ``weights_``.
    """

    _parameters = ("arch", "filters", "padding", "norm", "preset", "epochs", "seed")

    def __init__(
        self,
        arch: str = DEFAULT_SYMBOL,
        filters: Sequence[int] = DEFAULT_FILTERS,
        padding: str = "stream",
        norm: str = "batch",
        preset: str = "people",
        epochs: int | None = None,
        seed: int = 0,
    ) -> None:
        self.arch = arch
        self.filters = filters
        self.padding = padding
        self.norm = norm
        self.preset = preset
        self.epochs = epochs
        self.seed = seed

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The settings, as scikit-learn asks for them."""
        return {name: getattr(self, name) for name in self._parameters}

    def set_params(self, **settings: Any) -> PlushClassifier:
        """Change settings; an unknown one is refused."""
        for name, value in settings.items():
            if name not in self._parameters:
                accepted = ", ".join(self._parameters)
                raise ConfigError(
                    f"Unknown setting '{name}': accepted are {accepted}.{nearest(name, self._parameters)}"
                )
            setattr(self, name, value)
        return self

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> PlushClassifier:
        """Train on windows ``X`` (N, C, T) of integers or floats with labels ``y`` (N,).

        ``groups`` (N,) names the person of each window: then whole people validate. Floats are used as they are,
        to a ten-thousandth of each channel's spread.

        Raises:
            TrainingError: for arrays that do not fit each other.
        """
        from plushsense.training.fit import fit

        x, labels = np.asarray(X, dtype=np.float64), np.asarray(y).astype(str)
        if x.ndim != 3 or len(x) != len(labels) or len(x) == 0:
            raise TrainingError(
                f"X has the shape {x.shape} and y {labels.shape}: expected (N, C, T) and (N,), N above 0."
            )
        people = np.asarray(groups).astype(str) if groups is not None else np.arange(len(x)).astype(str)
        if len(people) != len(x):
            raise TrainingError(f"groups has {len(people)} entries for {len(x)} windows: one a window is expected.")
        self.classes_, index = np.unique(labels, return_inverse=True)
        spread = x.std(axis=(0, 2))
        self._unit = np.where(spread > 0, spread, 1.0) / 10_000.0
        self.arch_ = Arch.parse(
            self.arch,
            tuple(self.filters),
            channels=x.shape[1],
            classes=len(self.classes_),
            padding=self.padding,
            norm=self.norm,
            window=x.shape[2],
        )
        windows = self._windows(x, index.astype(np.int64), people)
        names = np.unique(people)
        held = np.random.default_rng(self.seed).permutation(names)[: max(1, round(VALIDATION_SHARE * len(names)))]
        watching = np.isin(people, held) if len(names) > 1 else np.zeros(len(x), dtype=bool)
        fitted = fit(
            windows.take(np.flatnonzero(~watching)),
            windows.take(np.flatnonzero(watching)) if watching.any() else None,
            self.arch_,
            preset(self.preset, epochs=self.epochs, seed=self.seed),
        )
        self.history_, self.weights_, self.scaler_ = fitted.history, fitted.weights, fitted.scaler
        return self

    def _windows(self, x: NDArray[np.float64], y: NDArray[np.int64], people: NDArray[np.str_]) -> WindowSet:
        n, channels, _ = x.shape
        labels = tuple(str(label) for label in self.classes_)
        limit = np.iinfo(np.int32).max
        rows = np.full((n, 2), -1, dtype=np.int64)
        return WindowSet(
            x=np.clip(np.round(x / self._unit[:, None]), -limit, limit).astype(np.int32),
            y=y,
            labels=labels,
            affects=("none",) * len(labels),
            families=labels,
            recording=np.arange(n, dtype=np.int64),
            recording_ids=tuple(map(str, range(n))),
            subject=people,
            context=np.full(n, "inside"),
            stream=np.full(n, ""),
            window_rows=rows,
            recording_rows=rows,
            rate_hz=100.0,
            inputs=tuple(f"channel {i}" for i in range(channels)),
        )

    def predict_proba(self, X: ArrayLike) -> NDArray[np.float32]:
        """Probabilities (N, K) in the order of ``classes_``."""
        from plushsense.training.fit import predict

        if not hasattr(self, "weights_"):
            raise TrainingError("This classifier is not trained yet: call fit first.")
        x = np.asarray(X, dtype=np.float64)
        if x.ndim != 3 or x.shape[1] != self.arch_.channels:
            raise TrainingError(f"X has the shape {x.shape}: expected (N, {self.arch_.channels}, T), as in fit.")
        blank = np.zeros(len(x), dtype=np.int64)
        return predict(self.arch_, self.weights_, self.scaler_, self._windows(x, blank, blank.astype(str)))

    def predict(self, X: ArrayLike) -> NDArray[np.str_]:
        """The most probable label of each window, (N,)."""
        best = self.predict_proba(X).argmax(axis=1)
        found: NDArray[np.str_] = self.classes_[best]
        return found

    def score(self, X: ArrayLike, y: ArrayLike) -> float:
        """Accuracy."""
        return float(np.mean(self.predict(X) == np.asarray(y).astype(str)))
