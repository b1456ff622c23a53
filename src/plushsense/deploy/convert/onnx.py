"""Convert a network to ONNX: in floats, or quantized with QuantizeLinear and DequantizeLinear (QDQ).

The input ``raw`` (N, C, span) is float32 with whole numbers in raw sensor counts; the outputs are ``logits`` and
``probabilities`` (N, K). Opset 18, IR version 9.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import need
from plushsense.deploy.convert import (
    LIMIT,
    LOGITS,
    NOT_EXACT,
    PROBABILITIES,
    RAW,
    Conversion,
    ConversionJob,
    Floats,
    compared,
    describe,
    input_codes,
    scaling,
    sum_scales,
)
from plushsense.deploy.quantize import integer_network
from plushsense.models.arch import NORM_EPSILON, Arch, ConvLayer, VectorLayer, reflected
from plushsense.models.bundle import Bundle
from plushsense.models.vectors import LENGTH_EPSILON, TURN_EPSILON
from plushsense.runtime.integer import IntegerNetwork
from plushsense.runtime.vectors import AXIS_LIMIT

OPSET = 18
IR_VERSION = 9
Shape = list[str | int]


class OnnxGraph:
    """Builds a graph node by node. A node has one output, after which it is named unless ``name`` is given."""

    def __init__(self, extra: str = "onnx") -> None:
        self.onnx = need("onnx", extra)
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, values: NDArray[Any]) -> str:
        self.constants.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def add(self, kind: str, out: str, *inputs: str, **settings: Any) -> str:
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [out], **{"name": out, **settings}))
        return out

    def columns(self, name: str, values: Floats) -> str:
        """Add a constant with one value per channel, as (C, 1) to broadcast over windows (N, C, T)."""
        return self.constant(name, values[:, None])

    def model(self, inputs: dict[str, Shape], outputs: dict[str, Shape], **settings: Any) -> Any:
        """Check the graph and return it as an ONNX model; inputs and outputs map names to shapes of float32 tensors."""
        helper, real = self.onnx.helper, self.onnx.TensorProto.FLOAT
        infos = [[helper.make_tensor_value_info(n, real, s) for n, s in part.items()] for part in (inputs, outputs)]
        graph = helper.make_graph(self.nodes, "plushsense", *infos, self.constants)
        opset = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, ir_version=IR_VERSION, opset_imports=opset, **settings)
        self.onnx.checker.check_model(model, full_check=True)
        return model

    def to_bytes(self, bundle: Bundle) -> bytes:
        """Serialise the graph with the input RAW and the outputs LOGITS and PROBABILITIES."""
        arch = bundle.arch
        inputs: dict[str, Shape] = {RAW: ["N", arch.channels, arch.span]}
        classes: Shape = ["N", arch.classes]
        about = {"producer_name": "plushsense", "doc_string": f"Touch gestures, {arch.title}"}
        model = self.model(inputs, {LOGITS: classes, PROBABILITIES: classes}, **about)
        self.onnx.helper.set_model_props(model, describe(bundle))
        return bytes(model.SerializeToString(deterministic=True))


def float_model(bundle: Bundle) -> bytes:
    """Return the float network as ONNX."""
    g, arch = OnnxGraph(), bundle.arch
    whole, scale, rest = scaling(bundle.scaler)
    z = g.add("Sub", "shifted", RAW, g.columns("scaler.offset", whole))
    z = g.add("Mul", "sized", z, g.columns("scaler.scale", scale))
    z = g.add("Add", "scaled", z, g.columns("scaler.rest", rest))
    if arch.vector is not None:
        weights = bundle.weights["vector.weight"].astype(np.float64)
        z = _invariants(g, arch, arch.vector, z, weights, (LENGTH_EPSILON, TURN_EPSILON))
        z = g.add("Sub", "vector.centred", z, g.columns("vector.mean", bundle.weights["vector.mean"]))
        root = np.sqrt(bundle.weights["vector.var"].astype(np.float64) + NORM_EPSILON)
        z = g.add("Mul", "vector", z, g.columns("vector.gain", (1.0 / root).astype(np.float32)))
    for i, layer in enumerate(arch.layers):
        z, pads = _padding(g, i, arch, layer, z)
        w, b = (g.constant(n, bundle.weights[n]) for n in (f"conv{i}.weight", f"conv{i}.bias"))
        z = g.add("Conv", f"conv{i}", z, w, b, dilations=[layer.dilation], kernel_shape=[layer.kernel], pads=pads)
        z = g.add("Relu", f"relu{i}", z)
        if arch.norm == "none":
            continue
        gain, shift = (g.constant(n, bundle.weights[n]) for n in (f"norm{i}.gain", f"norm{i}.shift"))
        if arch.norm == "batch":
            mean, var = (g.constant(n, bundle.weights[n]) for n in (f"norm{i}.mean", f"norm{i}.var"))
            z = g.add("BatchNormalization", f"norm{i}", z, gain, shift, mean, var, epsilon=NORM_EPSILON)
        else:
            z = g.add("Transpose", f"norm{i}.rows", z, perm=[0, 2, 1])
            z = g.add("LayerNormalization", f"norm{i}.normed", z, gain, shift, axis=-1, epsilon=NORM_EPSILON)
            z = g.add("Transpose", f"norm{i}", z, perm=[0, 2, 1])
    z = _mean(g, z)
    w, b = (g.constant(n, bundle.weights[n]) for n in ("dense.weight", "dense.bias"))
    g.add("Gemm", LOGITS, z, w, b, transB=1)
    g.add("Softmax", PROBABILITIES, LOGITS, axis=-1)
    return g.to_bytes(bundle)


def _padding(g: OnnxGraph, i: int, arch: Arch, layer: ConvLayer, z: str) -> tuple[str, list[int]]:
    if arch.padding == "stream" or not layer.reach:
        return z, [0, 0]
    if arch.padding == "causal":
        return z, [layer.reach, 0]
    if layer.reach < arch.window:
        pads = np.array([0, 0, layer.reach, 0, 0, 0], dtype=np.int64)
        return g.add("Pad", f"mirror{i}", z, g.constant(f"mirror{i}.pads", pads), mode="reflect"), [0, 0]
    # Pad reflects only once; longer padding needs several reflections.
    indices = reflected(arch.window, layer.reach).astype(np.int64)
    return g.add("Gather", f"mirror{i}", z, g.constant(f"mirror{i}.places", indices), axis=2), [0, 0]


def _invariants(
    g: OnnxGraph,
    arch: Arch,
    layer: VectorLayer,
    z: str,
    weights: NDArray[np.float64],
    epsilons: tuple[float, float],
    sizes: NDArray[np.float64] | None = None,
) -> str:
    """Add the vector layer, before its standardization.

    ``weights`` (V, K, taps) and ``epsilons`` are those of `plushsense.models.vectors`; ``sizes`` (V,) multiply the axes
    of each vector, which are then clipped as in `plushsense.runtime.vectors`.
    """
    others, one = arch.channels - layer.axes, g.constant("axis.1", np.array([1], dtype=np.int64))

    def part(name: str, z: str, axis: int, first: int, last: int) -> str:
        edges = (np.array([v], dtype=np.int64) for v in (first, last, axis))
        return g.add("Slice", name, z, *(g.constant(f"{name}.{k}", v) for k, v in enumerate(edges)))

    def length(name: str, z: str, keep: int) -> str:
        squares = g.add("ReduceSumSquare", f"{name}.squares", z, one, keepdims=keep)
        return g.add("Sqrt", name, g.add("Add", f"{name}.sum", squares, small))

    def turned(name: str, z: str, axis: int, order: Sequence[int]) -> str:
        return g.add("Gather", name, z, g.constant(f"{name}.order", np.array(order, dtype=np.int64)), axis=axis)

    small, smaller = (g.constant(f"epsilon.{i}", np.array(e, dtype=np.float32)) for i, e in enumerate(epsilons))
    newest = part("newest", z, 2, layer.reach, arch.span)
    gravity = part("gravity", newest, 1, arch.channels - 3, arch.channels)
    up = g.add("Div", "up", gravity, length("gravity.length", gravity, 1))
    up = g.add("Unsqueeze", "up.rows", up, g.constant("axis.2", np.array([2], dtype=np.int64)))
    outputs = [part("others", newest, 1, 0, others)] if others else []
    for v, kernels in enumerate(weights):
        n = f"vector{v}"
        axes = part(f"{n}.axes", z, 1, others + 3 * v, others + 3 * v + 3)
        if sizes is not None:
            size, *edges = (np.array(x, dtype=np.float32) for x in (sizes[v], -AXIS_LIMIT, AXIS_LIMIT))
            axes = g.add("Mul", f"{n}.sized", axes, g.constant(f"{n}.size", size))
            limits = (g.constant(f"{n}.edge{k}", edge) for k, edge in enumerate(edges))
            axes = g.add("Clip", f"{n}.clipped", axes, *limits)
        rows = g.constant(f"{n}.rows", np.array([-1, 1, arch.span], dtype=np.int64))
        d = g.add("Reshape", f"{n}.each", axes, rows)
        w = g.constant(f"{n}.weight", kernels[:, None].astype(np.float32))
        d = g.add("Conv", f"{n}.conv", d, w, kernel_shape=[layer.kernel])
        shape = np.array([-1, 3, layer.filters, arch.span - layer.reach], dtype=np.int64)
        d = g.add("Reshape", f"{n}.vectors", d, g.constant(f"{n}.shape", shape))
        vertical = g.add("ReduceSum", f"{n}.vertical", g.add("Mul", f"{n}.upward", d, up), one, keepdims=1)
        h = g.add("Sub", f"{n}.horizontal", d, g.add("Mul", f"{n}.lifted", vertical, up))
        after = turned(f"{n}.next", h, 2, [*range(1, layer.filters), 0])
        ahead, back = (1, 2, 0), (2, 0, 1)
        one_way = g.add("Mul", f"{n}.a", turned(f"{n}.h1", h, 1, ahead), turned(f"{n}.n2", after, 1, back))
        other_way = g.add("Mul", f"{n}.b", turned(f"{n}.h2", h, 1, back), turned(f"{n}.n1", after, 1, ahead))
        cross = g.add("Sub", f"{n}.cross", one_way, other_way)
        turn = g.add("ReduceSum", f"{n}.turn", g.add("Mul", f"{n}.around", cross, up), one, keepdims=0)
        sized = g.add("Add", f"{n}.turn.sum", g.add("Mul", f"{n}.turn.square", turn, turn), smaller)
        power = g.constant(f"{n}.power", np.array(-0.25, dtype=np.float32))
        sense = g.add("Mul", f"{n}.sense", turn, g.add("Pow", f"{n}.root", sized, power))
        flat = g.add("Squeeze", f"{n}.v", vertical, one)
        outputs += [flat, length(f"{n}.n", h, 0), sense]
    return g.add("Concat", "invariants", *outputs, axis=1)


def _mean(g: OnnxGraph, z: str) -> str:
    return g.add("ReduceMean", "pooled", z, g.constant("time", np.array([2], dtype=np.int64)), keepdims=0)


def integer_model(bundle: Bundle, network: IntegerNetwork) -> bytes:
    """Return the integer network as ONNX with QuantizeLinear and DequantizeLinear.

    Activations have the uint8 codes of `IntegerNetwork` with scale 1; the scale of each filter is applied to its int8
    weights. The mean over time and the dense layer are computed in float32, the latter with int8 weights.
    """
    g, arch = OnnxGraph(), network.arch
    one = g.constant("code.scale", np.array(1, dtype=np.float32))
    zero = g.constant("code.zero", np.array(0, dtype=np.uint8))

    def quantized(z: str, name: str) -> str:
        z = g.add("QuantizeLinear", f"{name}.codes", z, one, zero)
        return g.add("DequantizeLinear", f"{name}.read", z, one, zero)

    def dequantized(name: str, whole: NDArray[Any], scales: NDArray[np.float64]) -> str:
        scale = g.constant(f"{name}.scale", scales.astype(np.float32))
        none = g.constant(f"{name}.zero", np.zeros(len(scales), dtype=whole.dtype))
        return g.add("DequantizeLinear", f"{name}.real", g.constant(name, whole), scale, none, axis=0)

    offset, gain, start = input_codes(network)
    z = RAW
    if arch.vector is not None and network.vectors is not None:
        # In floats, so that the codes may differ by the rounding of the integer layer.
        weights = network.vectors.weights / np.ldexp(1.0, network.vectors.down)[:, :, None]
        sizes = np.ldexp(1.0, network.vectors.shift)
        z = _invariants(g, arch, arch.vector, z, weights, (1.0, 1.0), sizes)
    z = g.add("Sub", "shifted", z, g.columns("input.offset", offset))
    z = g.add("Mul", "sized", z, g.columns("input.gain", gain))
    z = quantized(g.add("Add", "scaled", z, g.columns("input.start", start)), "input")
    for i, (layer, integer_layer) in enumerate(zip(arch.layers, network.layers, strict=True)):
        scales = sum_scales(integer_layer.scale.multiplier, integer_layer.scale.before, integer_layer.scale.after)
        w = dequantized(f"conv{i}.weight", integer_layer.weights, scales)
        b = dequantized(f"conv{i}.bias", integer_layer.bias.astype(np.int32), scales)
        z, pads = _padding(g, i, arch, layer, z)
        z = g.add("Conv", f"conv{i}", z, w, b, dilations=[layer.dilation], kernel_shape=[layer.kernel], pads=pads)
        z = quantized(g.add("Relu", f"relu{i}", z), f"layer{i}")
    z = _mean(g, z)
    dense = network.dense
    scales = sum_scales(dense.scale.multiplier, dense.scale.before, dense.scale.after) / 256
    w = dequantized("dense.weight", dense.weights, scales * arch.pooled)
    z = g.add("Gemm", "dense", z, w, g.constant("dense.bias", (dense.bias * scales).astype(np.float32)), transB=1)
    low = g.constant("logits.low", np.array(-LIMIT, dtype=np.float32))
    high = g.constant("logits.high", np.array(LIMIT, dtype=np.float32))
    g.add("Clip", LOGITS, z, low, high)
    g.add("Softmax", PROBABILITIES, LOGITS, axis=-1)
    return g.to_bytes(bundle)


def run_model(model: bytes, windows: NDArray[Any]) -> NDArray[np.float32] | None:
    """Run a model in onnxruntime on raw windows and return the logits (N, K); None if it is not installed."""
    if importlib.util.find_spec("onnxruntime") is None:
        return None
    ort = need("onnxruntime", "onnx")
    settings = ort.SessionOptions()
    settings.intra_op_num_threads = 1
    settings.log_severity_level = 3
    # Otherwise sums of 8-bit products overflow in 16 bits on processors without VNNI.
    settings.add_session_config_entry("session.x64quantprecision", "1")
    session = ort.InferenceSession(model, settings, providers=["CPUExecutionProvider"])
    return np.asarray(session.run([LOGITS], {RAW: windows.astype(np.float32)})[0])


_UNCHECKED = "Not tried: run  pip install 'plushsense[onnx]'  to have it compared in onnxruntime."


def to_onnx(job: ConversionJob) -> Conversion:
    """Convert the float network."""
    note = f"Input '{RAW}' (N, {job.bundle.arch.channels}, span)."
    return _conversion(job, float_model(job.bundle), None, note)


def to_integer_onnx(job: ConversionJob) -> Conversion:
    """Convert the integer network; its outputs are close to those of the exported C, but not bit-identical."""
    network = integer_network(job.bundle)
    model = integer_model(job.bundle, network)
    return _conversion(job, model, network.forward(job.windows) / 256, NOT_EXACT)


def _conversion(job: ConversionJob, model: bytes, expected: NDArray[np.float64] | None, note: str) -> Conversion:
    logits = run_model(model, job.windows)
    if logits is None:
        return Conversion(model, None, (_UNCHECKED, note))
    return compared(job, model, logits, "ONNX", expected, note)
