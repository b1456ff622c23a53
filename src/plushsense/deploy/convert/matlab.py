"""Write variables to MATLAB files, and the parameters of a network in the shapes of MATLAB's layers.

``model.mat`` has a structure for each layer, named as in the authors' ``e_train.m``: ``convolution1``, ``layernorm1``
(or ``batchnorm1``), …, ``fc``, with properties of the layer as fields. ``input`` holds the scaling as the ``Mean`` and
``StandardDeviation`` of a ``sequenceInputLayer``, ``c`` the classes.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import need
from plushsense.deploy.convert import Conversion, ConversionJob, describe, refuse_unwritable
from plushsense.models.arch import NORM_EPSILON, Arch
from plushsense.models.bundle import Bundle
from plushsense.windows.features import InputUnits

# SciPy states the time of writing here, so that equal contents would give other bytes.
_HEAD = b"MATLAB 5.0 MAT-file, written by PlushSense".ljust(116)
_NAMES = {"gain": "Scale", "shift": "Offset", "mean": "TrainedMean", "var": "TrainedVariance"}
_UNTRIED = "Not tried in MATLAB. Tested: read again, the parameters give the logits of the network."


def mat_bytes(variables: Mapping[str, Any]) -> bytes:
    """Return a MATLAB file of version 5, as ``save(file, '-v7')`` writes it.

    Raises:
        MissingExtraError: if SciPy is not installed.
    """
    out = io.BytesIO()
    need("scipy.io", "matlab").savemat(out, variables, do_compression=True, oned_as="column")
    return _HEAD + out.getvalue()[len(_HEAD) :]


def cells(values: Sequence[Any]) -> NDArray[Any]:
    """Return a column that is written as a cell array, of texts or of arrays."""
    column = np.empty((len(values), 1), dtype=object)
    for at, value in enumerate(values):
        column[at, 0] = value
    return column


def parameters(bundle: Bundle) -> dict[str, object]:
    """Return the variables of ``model.mat``: sizes are those of MATLAB's layers, values of windows in layout units."""
    arch, weights = bundle.arch, bundle.weights
    scaler = InputUnits.of(bundle.layout).scaler(bundle.scaler)
    with np.errstate(divide="ignore"):
        deviation = 1 / scaler.scale
    found: dict[str, Any] = {"input": {"Mean": scaler.offset[:, None], "StandardDeviation": deviation[:, None]}}
    for i, layer in enumerate(arch.layers):
        found[f"convolution{i + 1}"] = {
            # (filters, channels, taps) to (taps, channels, filters); the first tap is the oldest in both.
            "Weights": weights[f"conv{i}.weight"].transpose(2, 1, 0),
            "Bias": weights[f"conv{i}.bias"][None],
            "DilationFactor": float(layer.dilation),
            **_padding(arch),
        }
        norm = {of: weights[f"norm{i}.{name}"][:, None] for name, of in _NAMES.items() if f"norm{i}.{name}" in weights}
        if norm:
            found[f"{arch.norm}norm{i + 1}"] = {**norm, "Epsilon": NORM_EPSILON}
    found["fc"] = {"Weights": weights["dense.weight"], "Bias": weights["dense.bias"][:, None]}
    about = describe(bundle, f"a window for each call, {arch.span} samples as rows and {arch.channels} channels")
    return {**found, "c": cells(bundle.gestures.labels), "about": about}


def _padding(arch: Arch) -> dict[str, Any]:
    """Return the properties of a convolution1dLayer that pads as the network does."""
    if arch.padding == "stream":
        return {"Padding": 0.0}
    mirrored = arch.padding == "mirror"
    return {"Padding": "causal", "PaddingValue": "symmetric-exclude-edge" if mirrored else 0.0}


def to_matlab(job: ConversionJob) -> Conversion:
    """Write the parameters of the float network."""
    refuse_unwritable(job.bundle.arch, ".mat")
    return Conversion(mat_bytes(parameters(job.bundle)), None, (_UNTRIED,))
