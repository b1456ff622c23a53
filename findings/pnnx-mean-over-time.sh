#!/bin/sh
# pnnx: the mean over time at the end of a 1-D network is left out of the ncnn network when ONNX gives its axis as an input.
#
# Guess:     ReduceMean over the samples becomes a mean over the samples in ncnn, whether the axis is an attribute (operator
#            set 17 and before) or a constant input (18 and later, what current exporters write).
# Version:   pnnx 20261020, ncnn 1.0.20261020, onnx 1.23.2, onnxruntime 1.32.0.
# Input:     a convolution of 3 channels to 4 and ReduceMean, the same weights each time; onnx.checker passes all of them.
# Behaviour: with one axis as an input, ncnn's layer Reduction gets an empty list of axes (-23303=0) and gives its input
#            back: 38 samples a channel instead of their mean. pnnx ends with status 0 and without a warning, and its own
#            intermediate file still has the axis. As an attribute, or with the two axes of an image, it is right.
# Output:    17, 1-D: ncnn (4,), as in onnxruntime: True
#            18, 1-D: ncnn (4, 38), as in onnxruntime: False, -23303=0
#            18, 2-D: ncnn (4,), as in onnxruntime: True
# Why it matters: 1-D networks that end with a mean over time lose it, 2-D ones do not, so that no example of an image
#            network shows it. A dense layer behind it then takes too many numbers, and the scores mean nothing.
#
# Exits with 0 while this is so. Installs the packages in a temporary folder; of pnnx only the converter, not PyTorch.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip="$folder/venv/bin/pip --disable-pip-version-check install --quiet"
$pip numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 ncnn==1.0.20261020
$pip --no-deps pnnx==20261020
cd "$folder"
venv/bin/python - <<'END'
import subprocess
import sysconfig

import ncnn
import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

CONVERTER = sysconfig.get_path("purelib") + "/pnnx/pnnx"
subprocess.run(["chmod", "+x", CONVERTER], check=True)
generator = np.random.default_rng(0)


def network(operators, sizes):
    """Return a convolution and a mean over all axes after the channels."""
    axes = list(range(2, 2 + len(sizes)))
    weights = generator.normal(size=(4, 3, *[3] * len(sizes))).astype(np.float32)
    kept = [numpy_helper.from_array(weights, "w")]
    if operators < 18:
        mean = helper.make_node("ReduceMean", ["c"], ["y"], axes=axes, keepdims=0)
    else:
        mean = helper.make_node("ReduceMean", ["c", "axes"], ["y"], keepdims=0)
        kept.append(numpy_helper.from_array(np.array(axes), "axes"))
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, *sizes])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 4])
    graph = helper.make_graph([helper.make_node("Conv", ["x", "w"], ["c"]), mean], "mean", [x], [y], kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", operators)], ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model


def converted(model, window):
    onnx.save(model, "net.onnx")
    shape = "inputshape=[" + ",".join(map(str, window.shape)) + "]"
    subprocess.run([CONVERTER, "net.onnx", shape, "fp16=0"], check=True, capture_output=True)
    net = ncnn.Net()
    net.opt.use_fp16_packed = net.opt.use_fp16_storage = net.opt.use_fp16_arithmetic = False
    assert net.load_param("net.ncnn.param") == 0 and net.load_model("net.ncnn.bin") == 0
    extractor = net.create_extractor()
    extractor.input("in0", ncnn.Mat(window[0]).clone())
    status, out = extractor.extract("out0")
    assert status == 0
    return np.array(out)


def same(operators, sizes):
    model = network(operators, sizes)
    window = generator.normal(size=(1, 3, *sizes)).astype(np.float32)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (expected,) = session.run(None, {"x": window})[0]
    found = converted(model, window)
    agrees = found.shape == expected.shape and bool(np.allclose(found, expected, atol=1e-4))
    empty = any(line.startswith("Reduction") and " -23303=0 " in line for line in open("net.ncnn.param"))
    tail = ", -23303=0" if empty else ""
    print(f"{operators}, {len(sizes)}-D: ncnn {found.shape}, as in onnxruntime: {agrees}{tail}")
    return agrees, found.shape


seen = [same(17, [40]), same(18, [40]), same(18, [8, 40])]
raise SystemExit(0 if seen == [(True, (4,)), (False, (4, 38)), (True, (4,))] else "This has changed.")
END
