"""The programs to compare a network with: classical classifiers, recurrent networks and random convolutions.

A classical one is a pipeline of scaling, optional PCA and a classifier of scikit-learn (extra ``baselines``), fitted
only to the training windows of a fold. The paper (sections 3.4 and 4.5) gives no settings; ours are in `BASELINES`.
Names such as "cubic SVM" and "subspace kNN" are presets of MATLAB's Classification Learner.
"""

from __future__ import annotations

import math
import pickle
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, check_known, need
from plushsense.experiments.baselines.score import UNSCALED, Contender, Pca, Reader
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import statistics, statistics_in_order

Floats = NDArray[np.float64]

# Part of every job's id: increase it when a name comes to mean another program or other settings.
BASELINES_VERSION = 2
# The share of the variance that PCA keeps.
PCA_VARIANCE = 0.95
TREES = 200

EXTRA = "baselines"


def _sklearn(module: str) -> Any:
    return need(f"sklearn.{module}", extra=EXTRA)


class Baseline(NamedTuple):
    """A classical program: its title in tables, and a function that makes its classifier from a seed."""

    title: str
    make: Callable[[int], Any]


def _subspace_knn(seed: int) -> Any:
    """Return an ensemble of 30 nearest-neighbour classifiers, each on a random half of the features (Ho 1998)."""
    one = _sklearn("neighbors").KNeighborsClassifier(1, n_jobs=1)
    return _sklearn("ensemble").BaggingClassifier(
        one, 30, max_features=0.5, bootstrap=False, random_state=seed, n_jobs=1
    )


BASELINES: dict[str, Baseline] = {
    "forest": Baseline(
        f"random forest ({TREES})",
        lambda seed: _sklearn("ensemble").RandomForestClassifier(TREES, random_state=seed, n_jobs=1),
    ),
    "extra-trees": Baseline(
        f"extra trees ({TREES})",
        lambda seed: _sklearn("ensemble").ExtraTreesClassifier(TREES, random_state=seed, n_jobs=1),
    ),
    "knn": Baseline("kNN (5)", lambda seed: _sklearn("neighbors").KNeighborsClassifier(5, n_jobs=1)),
    "subspace-knn": Baseline("subspace kNN (30)", _subspace_knn),
    "cubic-svm": Baseline("cubic SVM", lambda seed: _sklearn("svm").SVC(kernel="poly", degree=3, coef0=1.0, C=1.0)),
    "rbf-svm": Baseline("RBF SVM", lambda seed: _sklearn("svm").SVC(kernel="rbf", C=1.0)),
    "tree": Baseline("decision tree", lambda seed: _sklearn("tree").DecisionTreeClassifier(random_state=seed)),
    "boosting": Baseline(
        "gradient boosting",
        lambda seed: _sklearn("ensemble").HistGradientBoostingClassifier(
            max_iter=100, early_stopping=False, random_state=seed
        ),
    ),
    "mlp": Baseline(
        "MLP (64)", lambda seed: _sklearn("neural_network").MLPClassifier((64,), max_iter=200, random_state=seed)
    ),
}


def _last(windows: WindowSet, samples: int) -> Floats:
    """Return the last samples of windows in units, less the offsets: energies are those around zero."""
    return np.asarray(windows.integers[:, :, -samples:] / windows.units.steps[:, None])


def _statistics(windows: WindowSet, samples: int) -> Floats:
    return statistics_in_order(_last(windows, samples), windows.rate_hz)


def _paper_statistics(windows: WindowSet, samples: int) -> Floats:
    return statistics(_last(windows, samples), windows.rate_hz)


def _flattened(windows: WindowSet, samples: int) -> Floats:
    return _last(windows, samples).reshape(len(windows), -1)


# (name, features, PCA) left out: one fit on flattened windows of 3 channels took 52 s; 11 channels would take minutes.
TOO_LONG = (("boosting", "flattened", False),)

# Functions that compute a classifier's input (N, values) from the last ``samples`` samples of the windows.
FEATURES: dict[str, Callable[[WindowSet, int], Floats]] = {
    "statistics": _statistics,
    "paper-statistics": _paper_statistics,
    "flattened": _flattened,
}
DEFAULT_FEATURES = ("statistics", "flattened")


@dataclass(frozen=True)
class ClassicalFit:
    """A function that fits one baseline; it uses the last ``samples`` samples of each window."""

    name: str
    features: str
    pca: Pca
    samples: int
    seed: int

    def __call__(self, train: WindowSet, validation: WindowSet, /) -> Reader:
        """Fit scaling, PCA and classifier to ``train``; ``validation`` is not used."""
        enough_to_learn(train)
        steps = [_sklearn("preprocessing").StandardScaler()]
        if self.pca:
            # MATLAB's Classification Learner does not scale before PCA; some of its classifiers scale the components.
            at = 0 if self.pca == UNSCALED else 1
            steps.insert(at, _sklearn("decomposition").PCA(PCA_VARIANCE, svd_solver="full"))
        pipeline = _sklearn("pipeline").make_pipeline(*steps, BASELINES[self.name].make(self.seed))
        with warnings.catch_warnings():
            # The MLP stops after a fixed number of iterations; the user can do nothing about the warning.
            warnings.simplefilter("ignore", _sklearn("exceptions").ConvergenceWarning)
            pipeline.fit(FEATURES[self.features](train, self.samples), train.y)
        return FittedClassifier(pipeline, lambda windows: FEATURES[self.features](windows, self.samples))


class FittedClassifier:
    """A fitted ``model`` and the function ``view`` that computes its input from windows.

    ``size_bytes`` is the length of the pickled model, comparable to MATLAB's "model size". The pickle is not stored.
    """

    def __init__(self, model: Any, view: Callable[[WindowSet], NDArray[Any]]) -> None:
        self.model, self._view = model, view

    @property
    def size_bytes(self) -> int:
        return len(pickle.dumps(self.model, protocol=pickle.HIGHEST_PROTOCOL))

    def __call__(self, windows: WindowSet, /) -> NDArray[np.float32]:
        return likelihoods(self.model, self._view(windows), len(windows.labels))


def likelihoods(model: Any, x: Any, classes: int) -> NDArray[np.float32]:
    """Return probabilities (N, K) over all classes; 0 for a class without training windows.

    Support vector machines give no probabilities here. The softmax of their decision values (votes and margins)
    replaces them: it keeps the order of the classes and is not calibrated.
    """
    out = np.zeros((len(x), classes), dtype=np.float32)
    if hasattr(model, "predict_proba"):
        out[:, model.classes_] = model.predict_proba(x)
        return out
    margin = np.asarray(model.decision_function(x), dtype=np.float64)
    if margin.ndim == 1:
        margin = np.stack([-margin, margin], axis=1)
    power = np.exp(margin - margin.max(axis=1, keepdims=True))
    out[:, model.classes_] = power / power.sum(axis=1, keepdims=True)
    return out


def enough_to_learn(train: WindowSet) -> None:
    """Raise `BadInput` unless the training windows contain at least two gestures."""
    if len(np.unique(train.y)) < 2:
        found = ", ".join(train.labels[k] for k in np.unique(train.y)) or "none"
        raise BadInput(
            f"A fold has windows of {found} only to train on, and two gestures are needed: use fewer folds, or choose "
            "others with --classes."
        )


def classical(
    names: Sequence[str], features: Sequence[str], pca: Sequence[Pca], samples: int, seed: int
) -> list[Contender]:
    """Return a contender for each combination of ``names``, ``features`` and ``pca``, except those in `TOO_LONG`.

    Raises:
        ConfigError: for an unknown name or kind of features; the message suggests the nearest one.
        MissingExtraError: without scikit-learn.
    """
    for kind, given, known in (("baseline", names, tuple(BASELINES)), ("features", features, tuple(FEATURES))):
        for one in given:
            check_known(one, known, kind, ConfigError)
    library = f"scikit-learn {need('sklearn', extra=EXTRA).__version__}"
    key = {"version": BASELINES_VERSION, "library": library, "samples": samples, "seed": seed}
    return [
        Contender(
            name,
            BASELINES[name].title,
            view,
            reduced,
            ClassicalFit(name, view, reduced, samples, seed),
            # Earlier versions read integers; the other programs scale their features.
            {**key, "reads": "units of the layout"} if reduced == UNSCALED else dict(key),
            samples,
        )
        for view in features
        for reduced in pca
        for name in names
        if (name, view, reduced) not in TOO_LONG
    ]


# Title in tables, by kind.
RECURRENT = {"lstm": "LSTM", "bilstm": "BiLSTM"}
# Smallest and largest value of each setting; the largest number of units limits memory.
_LIMITS: dict[str, tuple[float, float]] = {"units": (1, 4096), "layers": (1, 8), "dropout": (0, 0.99)}


@dataclass(frozen=True)
class RecurrentSpec:
    """The form of an LSTM or BiLSTM: units in each layer and direction, layers, and the share that dropout sets to 0.

    The default has about as many parameters as the default network. The authors' script has an LSTM of 128 units and a
    BiLSTM of 512, each with a dropout of 0.5.
    """

    kind: str
    units: int = 32
    layers: int = 1
    dropout: float = 0.0

    def changes(self) -> dict[str, float]:
        """Return the settings that differ from the default."""
        return {f.name: value for f in fields(self)[1:] if (value := getattr(self, f.name)) != f.default}

    @property
    def name(self) -> str:
        """The model as `parse_recurrent` reads it, without settings that are the default."""
        return ":".join([self.kind, *(f"{key}={value}" for key, value in self.changes().items())])

    @property
    def title(self) -> str:
        layers = f", {self.layers} layers" if self.layers > 1 else ""
        dropout = f", dropout {self.dropout}" if self.dropout else ""
        return f"{RECURRENT[self.kind]} ({self.units}{layers}{dropout})"


def parse_recurrent(text: str) -> RecurrentSpec:
    """Return the network of a text such as ``lstm``, or ``bilstm:units=512:layers=2:dropout=0.5``.

    Raises:
        ConfigError: for a setting that is unknown, given twice or out of range.
    """
    kind, *settings = text.split(":")
    found: dict[str, Any] = {}
    for name, _, value in (setting.partition("=") for setting in settings):
        low, high = _LIMITS.get(name, (1, 0))
        try:
            number = float(value) if name == "dropout" else int(value)
        except ValueError:
            number = math.nan
        if name in found or not low <= number <= high:
            limits = ", ".join(f":{key}=NUMBER ({low:g} to {high:g})" for key, (low, high) in _LIMITS.items())
            raise ConfigError(f"Model '{text}': after {kind}, accepted are {limits}, each at most once.")
        found[name] = number
    return RecurrentSpec(kind, **found)


@dataclass(frozen=True)
class RecurrentFit:
    """A function that trains a recurrent network on the last ``samples`` of the windows."""

    network: RecurrentSpec
    spec: TrainSpec
    samples: int

    def __call__(self, train: WindowSet, validation: WindowSet, /) -> Reader:
        """Train on ``train`` for all epochs; ``validation`` is not used."""
        from plushsense.training.recurrent import fit_recurrent

        form = self.network
        return fit_recurrent(
            train,
            self.spec,
            self.samples,
            both_ways=form.kind == "bilstm",
            units=form.units,
            layers=form.layers,
            dropout=form.dropout,
        )


def recurrent(names: Sequence[str], samples: int, spec: TrainSpec, vectors: Sequence[Sequence[int]]) -> list[Contender]:
    """Return a contender for each text that `parse_recurrent` reads; ``vectors`` are channels for the augmentations.

    Raises:
        MissingExtraError: without PyTorch.
    """
    if not names:
        return []
    from plushsense.training.recurrent import RECURRENT_VERSION

    made = []
    for network in map(parse_recurrent, names):
        # Settings that are the default are left out, so that the ids of earlier trainings stay the same.
        key = {"version": RECURRENT_VERSION, "units": network.units, "samples": samples, "vectors": vectors}
        key |= {"training": spec.key(), **network.changes()}
        fit = RecurrentFit(network, spec, samples)
        made.append(Contender(network.name, network.title, "windows", False, fit, key, samples))
    return made
