"""From a bundle to what its toy computes with: the calibration that training kept, and the model made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError
from plushsense.deploy.quantize import Ranges, calibrate, quantize, refuse_undeployable
from plushsense.live.decide import DecideSpec
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.fixed import PROBABILITY_BITS, smoothing_weight, softmax
from plushsense.models.image import IntegerModel
from plushsense.models.integer import IntegerNetwork, deployable
from plushsense.models.reference import Network
from plushsense.windows.features import Scaler

_MOST = 1024  # windows


def calibration(
    arch: Arch, weights: Mapping[str, NDArray[np.float32]], scaler: Scaler, x: NDArray[np.integer[Any]]
) -> dict[str, Any]:
    """What a bundle keeps for its deployment, from raw training windows (N, C, T): plain values, nobody's samples.

    Empty for a network that cannot be deployed, and without windows.
    """
    if not deployable(arch) or not len(x):
        return {}
    # Of many windows some tell the ranges as well; the first to the last, so that every person is among them.
    some = np.unique(np.linspace(0, len(x) - 1, min(len(x), _MOST)).round().astype(np.int64))
    return calibrate(Network(arch, weights), scaler.apply(x[some, :, x.shape[2] - arch.span :])).to_dict()


def calibrated(bundle: Bundle, x: NDArray[np.integer[Any]]) -> Bundle:
    """The bundle with the calibration of raw windows (N, C, T) of the people it was trained on.

    Raises:
        ArchError: for a network that cannot be deployed; BundleError: without windows.
    """
    refuse_undeployable(bundle.arch)
    if not len(x):
        raise BundleError("There are no windows to calibrate on: give those that the network was trained on.")
    return replace(bundle, calibration=calibration(bundle.arch, bundle.weights, bundle.scaler, x))


def integer_network(bundle: Bundle) -> IntegerNetwork:
    """The bundle's network in whole numbers; the same bundle gives the same numbers.

    Raises:
        ArchError: for a network that cannot be deployed; BundleError: for a bundle without calibration.
    """
    refuse_undeployable(bundle.arch)
    if not bundle.calibration:
        raise BundleError(
            "The bundle holds no calibration (it was made by an earlier PlushSense): train it again, or give the data "
            "set that it was trained on, with plushsense export BUNDLE OUT --dataset DS."
        )
    return quantize(bundle.arch, bundle.weights, bundle.scaler, Ranges.from_dict(bundle.calibration))


def integer_model(bundle: Bundle, decide: DecideSpec | None = None) -> IntegerModel:
    """All that the toy computes with; ``decide`` None: the bundle's own decision settings.

    Raises:
        ArchError, BundleError: as for `integer_network`; ConfigError: for decision settings that there are not.
    """
    spec = decide or DecideSpec.from_dict(bundle.decision)
    step_s = bundle.arch.step * bundle.layout.period_us / 1e6
    weight = smoothing_weight(spec.smoothing_s, step_s)
    return IntegerModel(integer_network(bundle), bundle.layout, bundle.gestures, weight, spec.rules(step_s))


def integer_probabilities(network: IntegerNetwork, x: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
    """What a deployed network says of raw windows (N, C, T), not smoothed: probabilities (N, K)."""
    rows = [softmax(logits) for logits in network.forward(x)]
    found = np.array(rows, dtype=np.float32).reshape(len(x), network.arch.classes)
    return found / np.float32(1 << PROBABILITY_BITS)
