"""MiniRocket and MultiRocket-Hydra beside the baselines: random convolutions, a linear classifier (extra ``rocket``).

They come from the package aeon and read the windows themselves, scaled by channel.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.extras import need
from plushsense.evaluation.baselines import enough_to_learn, likelihoods
from plushsense.evaluation.compare import Contender, Reader
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import Scaler

# Part of every job's id: raise it when the same name would be another program.
ROCKETS_VERSION = 1
EXTRA = "rocket"

# The title, and aeon's class.
ROCKETS: dict[str, tuple[str, str]] = {
    "minirocket": ("MiniRocket", "MiniRocketClassifier"),
    "multirocket-hydra": ("MultiRocket-Hydra", "MultiRocketHydraClassifier"),
}
# Windows that compile a rocket's kernels.
_FIRST = 32


@dataclass(frozen=True)
class RocketFit:
    """Fits a classifier of random convolutions (Dempster, Schmidt & Webb 2021, 2023) to windows scaled by channel.

    Its kernels are compiled when they first run in a process (seconds to a minute): a few windows are read for that
    first, so that no time that is reported holds it.
    """

    name: str
    samples: int
    seed: int

    def __call__(self, train: WindowSet, validation: WindowSet, /) -> Reader:
        """The classifier fitted to ``train``; ``validation`` is not looked at."""
        enough_to_learn(train)
        scaler = Scaler.fit(train.x[:, :, -self.samples :])
        x = scaler.apply(train.x[:, :, -self.samples :])
        model = _rocket(self.name, self.seed)
        model.fit(x, train.y)
        return RocketReader(model, scaler, self.samples)

    def prepare(self, train: WindowSet, /) -> None:
        """Compile, once a process: before the clock starts."""
        _compiled(self.name, train.x.shape[1], min(self.samples, train.x.shape[2]))


class RocketReader:
    """A fitted rocket; ``size_bytes`` the length of its pickle in memory, as for a `ClassicalReader`."""

    def __init__(self, model: Any, scaler: Scaler, samples: int) -> None:
        self.model, self._scaler, self._samples = model, scaler, samples

    @property
    def size_bytes(self) -> int:
        return len(pickle.dumps(self.model, protocol=pickle.HIGHEST_PROTOCOL))

    def __call__(self, windows: WindowSet, /) -> NDArray[np.float32]:
        x = self._scaler.apply(windows.x[:, :, -self._samples :])
        return likelihoods(self.model, x, len(windows.labels))


def _rocket(name: str, seed: int) -> Any:
    module = need("aeon.classification.convolution_based", extra=EXTRA)
    return getattr(module, ROCKETS[name][1])(random_state=seed, n_jobs=1)


@lru_cache(maxsize=8)
def _compiled(name: str, channels: int, samples: int) -> None:
    """Run a rocket's kernels once in this process, on noise."""
    x = np.random.default_rng(0).normal(size=(_FIRST, channels, samples)).astype(np.float32)
    model = _rocket(name, 0)
    model.fit(x, np.arange(_FIRST) % 2)
    model.predict_proba(x[:2])


def rockets(names: Sequence[str], samples: int, seed: int) -> list[Contender]:
    """The classifiers of aeon; what they read is the window itself.

    Raises:
        MissingExtraError: without aeon, or without PyTorch, which MultiRocket-Hydra needs.
    """
    library = f"aeon {need('aeon', extra=EXTRA).__version__}" if names else ""
    if "multirocket-hydra" in names:
        need("torch", extra=EXTRA)
    return [
        Contender(
            name,
            ROCKETS[name][0],
            "windows",
            False,
            RocketFit(name, samples, seed),
            {"version": ROCKETS_VERSION, "library": library, "samples": samples, "seed": seed},
        )
        for name in names
    ]
