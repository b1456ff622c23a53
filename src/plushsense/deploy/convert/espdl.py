"""Convert the network to .espdl for Espressif's ESP-DL, by esp-ppq (which needs PyTorch).

ESP-DL has an 8-bit format of its own: signed, with one power-of-two scale per tensor (on the P4 per filter). Therefore
esp-ppq quantizes the float network; the integers are not those of the toy. Input is ``scaled`` (1, C, span), output
``logits`` (1, K): the caller scales the values, by the numbers in the metadata of the file.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError, need
from plushsense.deploy.convert import (
    LOGITS,
    Conversion,
    ConversionJob,
    Floats,
    compared,
    describe,
    refuse_vectors,
    refuse_window,
)
from plushsense.deploy.convert.onnx import OnnxGraph
from plushsense.deploy.quantize import Ranges, folded, refuse_undeployable
from plushsense.models.bundle import Bundle
from plushsense.windows.features import InputUnits

SCALED = "scaled"
MAGIC = b"EDL2"
HEAD_BYTES = 16
_MOST = 128  # windows; esp-ppq simulates a few dozen per second


def plain_model(bundle: Bundle) -> Any:
    """Return the folded network as an ONNX model for esp-ppq: only Conv, Relu, GlobalAveragePool, Flatten and Gemm."""
    g, arch, z = OnnxGraph("espdl"), bundle.arch, SCALED
    # Do not equalise the ranges of the filters: on the S3 the answers then differed more from the float network.
    *convolutions, dense = [tuple(v.astype(np.float32) for v in part) for part in folded(arch, bundle.weights)]
    for i, (layer, (weights, bias)) in enumerate(zip(arch.layers, convolutions, strict=True)):
        w, b = g.constant(f"w{i}", weights), g.constant(f"b{i}", bias)
        shape = {"kernel_shape": [layer.kernel], "dilations": [layer.dilation], "pads": [0, 0], "strides": [1]}
        z = g.add("Relu", f"relu{i}", g.add("Conv", f"conv{i}", z, w, b, **shape, group=1))
    w, b = (g.constant(name, values) for name, values in zip("wb", dense, strict=True))
    z = g.add("Flatten", "pooled", g.add("GlobalAveragePool", "mean", z), axis=1)
    g.add("Gemm", LOGITS, z, w, b, name="dense", transB=1)
    return g.model({SCALED: [1, arch.channels, arch.span]}, {LOGITS: [1, arch.classes]})


def to_espdl(job: ConversionJob, target: str) -> Conversion:
    """Convert the network for ``target`` (esp32, esp32s3, esp32c3, esp32p4 …); each has another weight layout.

    The file includes the last window and its answer, with which ESP-DL's ``model->test()`` tests it on the chip.
    """
    bundle = job.bundle
    refuse_undeployable(bundle.arch)
    refuse_window(bundle.arch, "espdl")
    refuse_vectors(bundle.arch, ".espdl")
    job = job.thinned(_MOST)
    scaled = bundle.scaler.apply(job.windows)
    some = scaled[: job.given or None]
    if not job.given and bundle.calibration:
        ranges = Ranges.from_dict(bundle.calibration)
        some = np.clip(some, ranges.low[:, None], ranges.high[:, None]).astype(np.float32)
    model = plain_model(bundle)
    facts = describe(bundle, f"'{SCALED}' (1, C, span): channels, samples: (value - offset) * scale of each channel")
    facts |= {k: json.dumps(v) for k, v in InputUnits.of(bundle.layout).scaler(bundle.scaler).to_dict().items()}
    data, logits = _quantized(bundle, model, some, scaled, target, facts)
    origin = (
        f"{len(some)} given windows" if job.given else "made-up windows only, so give windows of the training people"
    )
    note = (
        f"For {target}, quantized by esp-ppq with ranges from {origin}; compared in esp-ppq's simulation with the "
        "float network, not run on a chip."
    )
    result = compared(job, data, logits, "ESP-DL", (note,), job.reference())
    return replace(result, notes=result.notes[::-1])


to_esp32 = partial(to_espdl, target="esp32")
to_esp32s3 = partial(to_espdl, target="esp32s3")
to_esp32p4 = partial(to_espdl, target="esp32p4")


def _quantized(
    bundle: Bundle, model: Any, some: Floats, scaled: Floats, target: str, facts: dict[str, str]
) -> tuple[bytes, NDArray[np.float32]]:
    """Return the bytes of the file, with ranges from ``some``, and the logits (N, K) that esp-ppq simulates."""
    torch = need("torch", "espdl")
    output = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        ppq, executor = need("esp_ppq.api", "espdl"), need("esp_ppq.executor", "espdl")
        source, out = Path(folder, "model.onnx"), Path(folder, "model.espdl")
        source.write_bytes(model.SerializeToString())
        windows = [torch.from_numpy(np.ascontiguousarray(w[None])) for w in scaled]
        graph = ppq.espdl_quantize_onnx(
            str(source),
            str(out),
            [torch.from_numpy(np.ascontiguousarray(w[None])) for w in some],
            len(some),
            list(windows[0].shape),
            inputs=[windows[-1]],
            target=target,
            quant_type="w8a8",
            error_report=False,
            export_config=False,
            export_test_values=True,
            verbose=0,
            metadata_props=facts,
        )
        run = executor.TorchExecutor(graph, device="cpu")
        logits = np.concatenate([run(w)[0].numpy() for w in windows])
        data = out.read_bytes()
    kinds: list[str] = []
    if data[:4] == MAGIC:
        graph = need("esp_ppq.parser.espdl.FlatBuffers.Dl.Model", "espdl").Model.GetRootAs(data, HEAD_BYTES).Graph()
        kinds = [graph.Node(i).OpType().decode() for i in range(graph.NodeLength())]
    if kinds.count("Conv") != len(bundle.arch.layers):
        raise BundleError(f"esp-ppq wrote no usable .espdl file ({len(data)} bytes, operators {kinds}): report this.")
    return data, logits
