"""The classical programs that a network must beat: statistics or flattened windows, with and without PCA.

A baseline is scaling, perhaps PCA, and a classifier of scikit-learn (extra ``baselines``), all fitted to the training
windows of a fold and to nothing else. Names such as "cubic SVM" and "subspace kNN" are those of MATLAB's Classification
Learner, which the paper used (sections 3.4 and 4.5); it gives no settings, so ours stand beside each name below.
"""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, nearest
from plushsense.core.extras import need
from plushsense.evaluation.compare import Contender, Reader
from plushsense.windows.cut import WindowSet
from plushsense.windows.statistics import statistics

Floats = NDArray[np.float64]

# Part of every job's id: raise it when the same name would be another program.
BASELINES_VERSION = 1
# The share of the variance that PCA keeps.
PCA_VARIANCE = 0.95
TREES = 200

EXTRA = "baselines"


def _sklearn(module: str) -> Any:
    return need(f"sklearn.{module}", extra=EXTRA)


def _forest(seed: int) -> Any:
    return _sklearn("ensemble").RandomForestClassifier(TREES, random_state=seed, n_jobs=1)


def _extra_trees(seed: int) -> Any:
    return _sklearn("ensemble").ExtraTreesClassifier(TREES, random_state=seed, n_jobs=1)


def _knn(seed: int) -> Any:
    return _sklearn("neighbors").KNeighborsClassifier(5, n_jobs=1)


def _subspace_knn(seed: int) -> Any:
    """30 nearest neighbours, each of all windows on another random half of the values (Ho 1998)."""
    one = _sklearn("neighbors").KNeighborsClassifier(1, n_jobs=1)
    return _sklearn("ensemble").BaggingClassifier(
        one, 30, max_features=0.5, bootstrap=False, random_state=seed, n_jobs=1
    )


def _cubic_svm(seed: int) -> Any:
    return _sklearn("svm").SVC(kernel="poly", degree=3, coef0=1.0, C=1.0)


def _rbf_svm(seed: int) -> Any:
    return _sklearn("svm").SVC(kernel="rbf", C=1.0)


def _tree(seed: int) -> Any:
    return _sklearn("tree").DecisionTreeClassifier(random_state=seed)


def _boosting(seed: int) -> Any:
    return _sklearn("ensemble").HistGradientBoostingClassifier(max_iter=100, early_stopping=False, random_state=seed)


def _mlp(seed: int) -> Any:
    return _sklearn("neural_network").MLPClassifier((64,), max_iter=200, random_state=seed)


# How each classifier is made; it is given the seed.
BASELINES: dict[str, Callable[[int], Any]] = {
    "forest": _forest,
    "extra-trees": _extra_trees,
    "knn": _knn,
    "subspace-knn": _subspace_knn,
    "cubic-svm": _cubic_svm,
    "rbf-svm": _rbf_svm,
    "tree": _tree,
    "boosting": _boosting,
    "mlp": _mlp,
}

TITLES = {
    "forest": f"random forest ({TREES})",
    "extra-trees": f"extra trees ({TREES})",
    "knn": "kNN (5)",
    "subspace-knn": "subspace kNN (30)",
    "cubic-svm": "cubic SVM",
    "rbf-svm": "RBF SVM",
    "tree": "decision tree",
    "boosting": "gradient boosting",
    "mlp": "MLP (64)",
}


def _statistics(windows: WindowSet, samples: int) -> Floats:
    return statistics(windows.x[:, :, -samples:], windows.rate_hz)


def _flattened(windows: WindowSet, samples: int) -> Floats:
    return windows.x[:, :, -samples:].reshape(len(windows), -1).astype(np.float64)


# What takes longest and gains least: on flattened windows of 3 channels one fit took 52 s, on 11 it would take minutes.
TOO_LONG = (("boosting", "flattened", False),)

# What a classifier is given of a window's last ``samples`` samples, (N, values).
FEATURES: dict[str, Callable[[WindowSet, int], Floats]] = {"statistics": _statistics, "flattened": _flattened}


@dataclass(frozen=True)
class ClassicalFit:
    """Fits one baseline; ``samples`` is the window that it reads, counted from the end."""

    name: str
    features: str
    pca: bool
    samples: int
    seed: int

    def __call__(self, train: WindowSet, validation: WindowSet, /) -> Reader:
        """Scaling, PCA and classifier fitted to ``train``; ``validation`` is not looked at."""
        enough_to_learn(train)
        steps = [_sklearn("preprocessing").StandardScaler()]
        if self.pca:
            steps.append(_sklearn("decomposition").PCA(PCA_VARIANCE, svd_solver="full"))
        pipeline = _sklearn("pipeline").make_pipeline(*steps, BASELINES[self.name](self.seed))
        with warnings.catch_warnings():
            # The small network is given its rounds, like everybody; that it could do with more is no news to the user.
            warnings.simplefilter("ignore", _sklearn("exceptions").ConvergenceWarning)
            pipeline.fit(FEATURES[self.features](train, self.samples), train.y)
        return ClassicalReader(pipeline, self.features, self.samples)


class ClassicalReader:
    """A fitted baseline.

    ``size_bytes`` is the length of its pickle, taken in memory: a measure like MATLAB's "model size", never a format in
    which anything is kept or read.
    """

    def __init__(self, pipeline: Any, features: str, samples: int) -> None:
        self.pipeline, self._features, self._samples = pipeline, features, samples

    @property
    def size_bytes(self) -> int:
        return len(pickle.dumps(self.pipeline, protocol=pickle.HIGHEST_PROTOCOL))

    def __call__(self, windows: WindowSet, /) -> NDArray[np.float32]:
        return likelihoods(self.pipeline, FEATURES[self._features](windows, self._samples), len(windows.labels))


def likelihoods(model: Any, x: Any, classes: int) -> NDArray[np.float32]:
    """Probabilities (N, K) over all classes; one that was not trained on gets 0.

    A support vector machine gives no probabilities: its decision values, votes with their margins, go through a
    softmax, which keeps their order and is not calibrated.
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
    """Refuse a fold that trains on windows of one gesture."""
    if len(np.unique(train.y)) < 2:
        found = ", ".join(train.labels[k] for k in np.unique(train.y)) or "none"
        raise BadInput(
            f"A fold has windows of {found} only to train on, and two gestures are needed: use fewer folds, or choose "
            "others with --classes."
        )


def classical(
    names: Sequence[str], features: Sequence[str], pca: Sequence[bool], samples: int, seed: int
) -> list[Contender]:
    """Every asked baseline on every asked view of the windows, but what takes `TOO_LONG`.

    Raises:
        ConfigError: for a name or a view that there is not, with the nearest.
        MissingExtraError: without scikit-learn.
    """
    for what, given, known in (("baseline", names, tuple(BASELINES)), ("features", features, tuple(FEATURES))):
        for one in given:
            if one not in known:
                raise ConfigError(f"Unknown {what} '{one}': accepted are {', '.join(known)}.{nearest(one, known)}")
    library = f"scikit-learn {need('sklearn', extra=EXTRA).__version__}"
    return [
        Contender(
            name,
            TITLES[name],
            view,
            reduced,
            ClassicalFit(name, view, reduced, samples, seed),
            {"version": BASELINES_VERSION, "library": library, "samples": samples, "seed": seed},
        )
        for view in features
        for reduced in pca
        for name in names
        if (name, view, reduced) not in TOO_LONG
    ]
