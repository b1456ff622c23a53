"""Hard negatives for the training of continuous streams: idle time that a first network takes for a gesture.

Most idle windows are easy, and evenly spaced ones hold few of those at which a network reports a gesture for no reason.
"""

from __future__ import annotations

import numpy as np

from plushsense.models.arch import Arch
from plushsense.training.fit import Progress, fit, predict
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

# Probability of a gesture from which an idle window is hard.
_HARD = 0.3


def with_hard_negatives(
    train: WindowSet,
    candidates: WindowSet,
    idle: int,
    arch: Arch,
    spec: TrainSpec,
    share: float,
    progress: Progress | None = None,
) -> WindowSet:
    """Return the training windows with the hardest idle windows added.

    A network is trained on ``train`` and computes the candidates of class ``idle``, which must be of the training
    people. Those that it takes for a gesture with a probability of at least 0.3 are added, the clearest first.

    Args:
        candidates: windows of the same classes; those of other classes are ignored. Windows that are in ``train``
            already may be among them, and then count twice.
        share: largest number of added windows, as a share of ``train``.
        progress: as for `fit`.
    """
    at = np.flatnonzero(candidates.y == idle)
    most = int(share * len(train))
    if not len(at) or not most:
        return train
    first = fit(train, None, arch, spec, progress)
    gesture = 1.0 - predict(arch, first.weights, first.scaler, candidates.take(at), spec.device)[:, idle]
    hardest = np.argsort(-gesture, kind="stable")[:most]
    return train.joined(candidates.take(at[hardest[gesture[hardest] >= _HARD]]))
