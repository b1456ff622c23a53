#!/bin/sh
# OpenVINO averages 8-bit codes over time to 0 for all but the first windows of a batch.
#
# Guess:     the mean over time of N windows (N, C, T), after QuantizeLinear and DequantizeLinear, is that of onnxruntime
#            for each window, however many there are. It is how quantized 1-D networks end.
# Version:   openvino 2026.4.1 (CPU without VNNI), onnx 1.23.2, onnxruntime 1.31.1.
# Behaviour: only the first C windows have their mean, C being the number of channels; the others have 0. No error or
#            warning. As (N, C, 1, T), or without the 8 bits, all are right.
# Output:    rank 3: windows with another mean than in onnxruntime: [4, 5, 6, 7], their means in OpenVINO: [0.0]
#            rank 4: windows with another mean than in onnxruntime: []
# Why it matters: one window at a time, as in a first test, is right; an evaluation in batches is not, and scores of a
#            quantized network then look like a loss by quantization.
#
# Exits with 0 while this is so. Installs the packages in a temporary folder.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --disable-pip-version-check install --quiet openvino==2026.4.1 onnx==1.23.2 onnxruntime==1.31.1
"$folder/venv/bin/python" - <<'END'
import numpy as np
import onnxruntime
import openvino
from onnx import TensorProto, helper, numpy_helper

WINDOWS, CHANNELS, SAMPLES = 8, 4, 40


def differing(rank):
    constants = {"scale": np.float32(1), "zero": np.uint8(0)} | ({"axis": np.array([2])} if rank == 4 else {})
    image = [helper.make_node("Unsqueeze", ["read", "axis"], ["image"])] if rank == 4 else []
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "scale", "zero"], ["codes"]),
        helper.make_node("DequantizeLinear", ["codes", "scale", "zero"], ["read"]),
        *image,
        helper.make_node("GlobalAveragePool", ["image" if image else "read"], ["mean"]),
        helper.make_node("Flatten", ["mean"], ["y"]),
    ]
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", CHANNELS, SAMPLES])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", CHANNELS])
    kept = [numpy_helper.from_array(np.asarray(v), n) for n, v in constants.items()]
    graph = helper.make_graph(nodes, "mean", [x], [y], kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=7).SerializeToString()
    windows = np.random.default_rng(0).integers(1, 256, (WINDOWS, CHANNELS, SAMPLES)).astype(np.float32)
    (expected,) = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"]).run(None, {"x": windows})
    np.testing.assert_allclose(expected, windows.mean(axis=2), rtol=1e-5)
    core = openvino.Core()
    found = core.compile_model(core.read_model(model), "CPU")(windows)["y"]
    rows = np.flatnonzero(np.abs(found - expected).max(axis=1) > 0.5).tolist()
    means = f", their means in OpenVINO: {sorted({float(v) for v in found[rows].ravel()})}" if rows else ""
    print(f"rank {rank}: windows with another mean than in onnxruntime: {rows}{means}")
    return rows


raise SystemExit(0 if differing(3) == list(range(CHANNELS, WINDOWS)) and differing(4) == [] else "This has changed.")
END
