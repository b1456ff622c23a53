#!/bin/sh
# onnx.reference, the executable form of the standard: MaxPool of stride 1 takes `pads` otherwise than the standard says.
#
# Guess:     the reference evaluator gives what the operator's text and the shape inference of the same package give:
#            `pads` are all beginnings, then all ends, and MaxPool is padded at stride 1 as at stride 2.
# Version:   onnx 1.23.2, numpy 2.4.6.
# Input:     one MaxPool node without dilation, ceil_mode or auto_pad; onnx.checker passes each.
# Behaviour: stride 1 has a code path of its own. There, a 1-D input isn't padded at all: a pad at its end makes the output
#            shorter than the standard's, without a word (a pad at its beginning ends in an IndexError); and the four pads
#            of a 2-D input are read as both of the first axis, then both of the second. At stride 2 all is right, as with
#            AveragePool. The tests of explicit pads at stride 1 that come with onnx pad all sides alike.
# Output:    1-D, stride 1: shape inference [1, 1, 6], reference [1, 1, 5]: 2 3 4 5 6
#            1-D, stride 2: shape inference [1, 1, 3], reference [1, 1, 3]: 2 4 6
#            2-D, stride 1: shape inference [1, 1, 1, 7], reference [1, 1, 2, 6]: 8 9 10 11 12 12 8 9 10 11 12 12
# Why it matters: an export of a network is held against this evaluator because it is taken to be the standard. A right
#            export of a 1-D network then looks wrong, and one made to fit it is wrong everywhere else.
#
# Exits with 0 while this is so. Installs the packages in a temporary folder.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --disable-pip-version-check install --quiet onnx==1.23.2 numpy==2.4.6
"$folder/venv/bin/python" - <<'END'
import itertools

import numpy as np
import onnx
from onnx import TensorProto, helper
from onnx.reference import ReferenceEvaluator


def by_the_text(x, kernel, pads, stride):
    """Pool as the operator's text says: beginnings first, padding never the largest."""
    n = len(kernel)
    padded = np.pad(x, [(0, 0), (0, 0), *zip(pads[:n], pads[n:])], constant_values=-np.inf)
    sizes = [(size - k) // stride + 1 for size, k in zip(padded.shape[2:], kernel)]
    y = np.empty((*x.shape[:2], *sizes), np.float32)
    for at in itertools.product(*map(range, sizes)):
        y[(..., *at)] = padded[(..., *[slice(i * stride, i * stride + k) for i, k in zip(at, kernel)])].max(
            axis=tuple(range(2, 2 + n))
        )
    return y


def differs(size, kernel, pads, stride):
    rank = len(size)
    node = helper.make_node("MaxPool", ["x"], ["y"], kernel_shape=kernel, pads=pads, strides=[stride] * len(kernel))
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, size)
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [f"d{i}" for i in range(rank)])
    model = helper.make_model(helper.make_graph([node], "pool", [x], [y]), opset_imports=[helper.make_opsetid("", 22)])
    onnx.checker.check_model(model, full_check=True)
    dims = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph.output[0].type.tensor_type.shape.dim
    inferred = [dim.dim_value for dim in dims]
    ramp = np.arange(1, 1 + np.prod(size), dtype=np.float32).reshape(size)
    (found,) = ReferenceEvaluator(model).run(None, {"x": ramp})
    expected = by_the_text(ramp, kernel, pads, stride)
    assert list(expected.shape) == inferred
    values = " ".join(f"{value:g}" for value in found.ravel())
    print(f"{rank - 2}-D, stride {stride}: shape inference {inferred}, reference {list(found.shape)}: {values}")
    return not np.array_equal(found, expected)


seen = [
    differs([1, 1, 6], [2], [0, 1], 1),
    differs([1, 1, 6], [2], [0, 1], 2),
    differs([1, 1, 2, 6], [2, 2], [0, 1, 0, 1], 1),
    differs([1, 1, 2, 6], [2, 2], [0, 1, 0, 1], 2),
]
raise SystemExit(0 if seen == [True, False, True, False] else f"This has changed: {seen}")
END
