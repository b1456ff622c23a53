"""Convert a network to ONNX: in floats, or quantized with QuantizeLinear and DequantizeLinear (QDQ).

The input ``raw`` (N, C, span) is float32, in the units of the layout (`InputUnits`); the outputs are ``logits`` and
``probabilities`` (N, K). Opset 13, for small compilers and older importers; 17 with layer normalisation.
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
    in_float32,
    input_codes,
    sum_scales,
)
from plushsense.deploy.quantize import integer_network
from plushsense.models.arch import NORM_EPSILON, Arch, ConvLayer, VectorLayer, reflected
from plushsense.models.bundle import Bundle
from plushsense.models.reference import affine
from plushsense.models.vectors import LENGTH_EPSILON, TURN_EPSILON
from plushsense.runtime.integer import AXIS_LIMIT, IntegerNetwork
from plushsense.windows.features import InputUnits, Scaler

OPSET = 13
OPSET_OF_LAYER_NORMALIZATION = 17
WEIGHT_ZERO = 128  # of the weights in 8 bits
Shape = list[str | int]


class OnnxGraph:
    """Builds a graph node by node. A node has one output, after which it is named unless ``name`` is given."""

    def __init__(self, extra: str = "onnx") -> None:
        self.onnx = need("onnx", extra)
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, values: NDArray[Any]) -> str:
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(values, order="C"), name))
        return name

    def add(self, kind: str, out: str, *inputs: str, **settings: Any) -> str:
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [out], **{"name": out, **settings}))
        return out

    def columns(self, name: str, values: Floats) -> str:
        """Add a constant with one value per channel, as (C, 1) to broadcast over windows (N, C, T)."""
        return self.constant(name, values[:, None])

    def part(self, out: str, z: str, axis: int, first: int, last: int) -> str:
        """Add a slice of one axis."""
        edges = (np.array([v], dtype=np.int64) for v in (first, last, axis))
        return self.add("Slice", out, z, *(self.constant(f"{out}.{k}", v) for k, v in enumerate(edges)))

    def turned(self, out: str, z: str, axis: int, order: Sequence[int]) -> str:
        """Add a new order of the indices of one axis."""
        return self.add("Gather", out, z, self.constant(f"{out}.order", np.array(order, dtype=np.int64)), axis=axis)

    def model(self, inputs: dict[str, Shape], outputs: dict[str, Shape], **settings: Any) -> Any:
        """Check the graph and return it as an ONNX model; inputs and outputs map names to shapes of float32 tensors."""
        helper, real = self.onnx.helper, self.onnx.TensorProto.FLOAT
        infos = [[helper.make_tensor_value_info(n, real, s) for n, s in part.items()] for part in (inputs, outputs)]
        graph = helper.make_graph(self.nodes, "plushsense", *infos, self.constants)
        normed = any(node.op_type == "LayerNormalization" for node in self.nodes)
        opset = [helper.make_opsetid("", OPSET_OF_LAYER_NORMALIZATION if normed else OPSET)]
        version = helper.find_min_ir_version_for(opset)
        model = helper.make_model(graph, ir_version=version, opset_imports=opset, **settings)
        self.onnx.checker.check_model(model, full_check=True)
        return model

    def to_bytes(self, bundle: Bundle) -> bytes:
        """Serialise the graph with the input RAW and the outputs LOGITS and PROBABILITIES."""
        arch = bundle.arch
        inputs: dict[str, Shape] = {RAW: ["N", arch.channels, arch.span]}
        classes: Shape = ["N", arch.classes]
        about = {"producer_name": "plushsense", "doc_string": f"Touch gestures, {arch.title}"}
        model = self.model(inputs, {LOGITS: classes, PROBABILITIES: classes}, **about)
        facts = _facts(bundle)
        self.onnx.helper.set_model_props(model, facts)
        model.graph.input[0].doc_string = facts["input"]
        return bytes(model.SerializeToString(deterministic=True))


def _facts(bundle: Bundle) -> dict[str, str]:
    shape = f"(N, {bundle.arch.channels}, {bundle.arch.span})"
    return describe(bundle, f"'{RAW}', float32 {shape}, also for whole numbers: windows, channels, samples")


def float_model(bundle: Bundle) -> bytes:
    """Return the float network as ONNX."""
    g, arch = OnnxGraph(), bundle.arch
    z = _scaled(g, RAW, InputUnits.of(bundle.layout).scaler(bundle.scaler))
    if arch.vector is not None:
        weights = bundle.weights["vector.weight"].astype(np.float64)
        z = _invariants(g, arch, arch.vector, z, weights, (LENGTH_EPSILON, TURN_EPSILON))
        z = g.add("Sub", "vector.centred", z, g.columns("vector.mean", bundle.weights["vector.mean"]))
        root = np.sqrt(bundle.weights["vector.var"].astype(np.float64) + NORM_EPSILON)
        z = g.add("Mul", "vector", z, g.columns("vector.gain", (1.0 / root).astype(np.float32)))
    for i, layer in enumerate(arch.layers):
        z = _padded(g, i, arch, layer, z)
        w, b = (g.constant(n, bundle.weights[n]) for n in (f"conv{i}.weight", f"conv{i}.bias"))
        z = g.add("Conv", f"conv{i}", z, w, b, dilations=[layer.dilation], kernel_shape=[layer.kernel])
        z = g.add("Relu", f"relu{i}", z)
        if arch.norm == "batch":
            # No BatchNormalization, which onnx's own evaluator computes as in a training up to opset 13.
            factor, term = (part.astype(np.float32) for part in affine(arch, i, bundle.weights))
            z = g.add("Mul", f"gained{i}", z, g.columns(f"norm{i}.gain", factor))
            z = g.add("Add", f"norm{i}", z, g.columns(f"norm{i}.shift", term))
        elif arch.norm == "layer":
            gain, shift = (g.constant(n, bundle.weights[n]) for n in (f"norm{i}.gain", f"norm{i}.shift"))
            z = g.add("Transpose", f"norm{i}.rows", z, perm=[0, 2, 1])
            z = g.add("LayerNormalization", f"norm{i}.normed", z, gain, shift, axis=-1, epsilon=NORM_EPSILON)
            z = g.add("Transpose", f"norm{i}", z, perm=[0, 2, 1])
    z = _pooled(g, arch, z)
    w, b = (g.constant(n, bundle.weights[n]) for n in ("dense.weight", "dense.bias"))
    g.add("Gemm", LOGITS, z, w, b, transB=1)
    g.add("Softmax", PROBABILITIES, LOGITS, axis=-1)
    return g.to_bytes(bundle)


def _scaled(g: OnnxGraph, z: str, scaler: Scaler, start: NDArray[np.float64] | float = 0.0) -> str:
    offset, gain, rest = in_float32(scaler, start)
    z = g.add("Sub", "shifted", z, g.columns("input.offset", offset))
    z = g.add("Mul", "sized", z, g.columns("input.gain", gain))
    return g.add("Add", "scaled", z, g.columns("input.rest", rest))


def _padded(g: OnnxGraph, i: int, arch: Arch, layer: ConvLayer, z: str) -> str:
    if arch.padding == "stream" or not layer.reach:
        return z
    if arch.padding == "mirror" and layer.reach >= arch.window:
        # Pad reflects only once; longer padding needs several reflections.
        indices = reflected(arch.window, layer.reach).astype(np.int64)
        return g.add("Gather", f"padded{i}", z, g.constant(f"padded{i}.places", indices), axis=2)
    # Not by the attribute of Conv, of whose two sides OpenCV reads one.
    pads = g.constant(f"padded{i}.pads", np.array([0, 0, layer.reach, 0, 0, 0], dtype=np.int64))
    return g.add("Pad", f"padded{i}", z, pads, mode="reflect" if arch.padding == "mirror" else "constant")


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
    of each vector, which are then clipped as in `plushsense.runtime.integer`.
    """
    others, one = arch.channels - layer.axes, g.constant("axis.1", np.array([1], dtype=np.int64))

    def length(name: str, z: str) -> str:
        # With keepdims=0, the sums of some filters are wrong in OpenVINO 2026.4 where all shapes are fixed.
        squares = g.add("ReduceSum", f"{name}.squares", g.add("Mul", f"{name}.each", z, z), one, keepdims=1)
        return g.add("Sqrt", name, g.add("Add", f"{name}.sum", squares, small))

    small, smaller = (g.constant(f"epsilon.{i}", np.array(e, dtype=np.float32)) for i, e in enumerate(epsilons))
    newest = g.part("newest", z, 2, layer.reach, arch.span)
    gravity = g.part("gravity", newest, 1, arch.channels - 3, arch.channels)
    up = g.add("Div", "up", gravity, length("gravity.length", gravity))
    up = g.add("Unsqueeze", "up.rows", up, g.constant("axis.2", np.array([2], dtype=np.int64)))
    outputs = [g.part("others", newest, 1, 0, others)] if others else []
    for v, kernels in enumerate(weights):
        n = f"vector{v}"
        axes = g.part(f"{n}.axes", z, 1, others + 3 * v, others + 3 * v + 3)
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
        after = g.turned(f"{n}.next", h, 2, [*range(1, layer.filters), 0])
        ahead, back = (1, 2, 0), (2, 0, 1)
        one_way = g.add("Mul", f"{n}.a", g.turned(f"{n}.h1", h, 1, ahead), g.turned(f"{n}.n2", after, 1, back))
        other_way = g.add("Mul", f"{n}.b", g.turned(f"{n}.h2", h, 1, back), g.turned(f"{n}.n1", after, 1, ahead))
        cross = g.add("Sub", f"{n}.cross", one_way, other_way)
        turn = g.add("ReduceSum", f"{n}.turn", g.add("Mul", f"{n}.around", cross, up), one, keepdims=0)
        sized = g.add("Add", f"{n}.turn.sum", g.add("Mul", f"{n}.turn.square", turn, turn), smaller)
        power = g.constant(f"{n}.power", np.array(-0.25, dtype=np.float32))
        sense = g.add("Mul", f"{n}.sense", turn, g.add("Pow", f"{n}.root", sized, power))
        flat = g.add("Squeeze", f"{n}.v", vertical, one)
        outputs += [flat, g.add("Squeeze", f"{n}.n", length(f"{n}.length", h), one), sense]
    return g.add("Concat", "invariants", *outputs, axis=1)


def _pooled(g: OnnxGraph, arch: Arch, z: str, *image: int) -> str:
    """Add the statistics over time, (N, features), of activations (N, F, T), or of an image with this height."""
    mean = g.add("GlobalAveragePool", "mean", z)
    if arch.pooling == "mean":
        return g.add("Flatten", "pooled", mean, axis=1)
    shape = [*image, arch.step]
    z = g.add("AveragePool", "step.means", z, kernel_shape=shape, strides=shape)
    z = g.add("Abs", "apart", g.add("Sub", "from.mean", z, mean))
    both = g.add("Concat", "statistics", mean, g.add("GlobalAveragePool", "deviation", z), axis=1)
    return g.add("Flatten", "pooled", both, axis=1)


def integer_model(bundle: Bundle, network: IntegerNetwork) -> bytes:
    """Return the integer network as ONNX with QuantizeLinear and DequantizeLinear.

    Activations have the uint8 codes of `IntegerNetwork` with scale 1; the scale of each filter is applied to its
    weights. The statistics over time and the dense layer are computed in float32, the latter with 8-bit weights.

    Weights are uint8 with the zero point `WEIGHT_ZERO`: on processors without VNNI, onnxruntime and others add pairs of
    products of uint8 and int8 in 16 bits, which saturate without an error.
    """
    g, arch = OnnxGraph(), network.arch
    one = g.constant("code.scale", np.array(1, dtype=np.float32))
    zero = g.constant("code.zero", np.array(0, dtype=np.uint8))

    def quantized(z: str, name: str) -> str:
        z = g.add("QuantizeLinear", f"{name}.codes", z, one, zero)
        return g.add("DequantizeLinear", f"{name}.read", z, one, zero)

    def dequantized(name: str, codes: NDArray[Any], scales: NDArray[np.float64], zero: int = 0) -> str:
        scale = g.constant(f"{name}.scale", scales.astype(np.float32))
        zeros = g.constant(f"{name}.zero", np.full(len(scales), zero, dtype=codes.dtype))
        return g.add("DequantizeLinear", f"{name}.real", g.constant(name, codes), scale, zeros, axis=0)

    def weights_of(name: str, whole: NDArray[np.int8], scales: NDArray[np.float64]) -> str:
        return dequantized(name, (whole.astype(np.int16) + WEIGHT_ZERO).astype(np.uint8), scales, WEIGHT_ZERO)

    z, units, (scaler, start) = RAW, InputUnits.of(bundle.layout), input_codes(network)
    if arch.vector is not None and network.vectors is not None:
        # In floats, so that the codes may differ by the rounding of the integer layer.
        weights = network.vectors.weights / np.ldexp(1.0, network.vectors.down)[:, :, None]
        sizes = np.ldexp(1.0, network.vectors.shift)
        z = g.add("Mul", "steps", z, g.columns("input.steps", units.steps.astype(np.float32)))
        z = g.add("Sub", "integers", z, g.columns("input.zero", units.zero.astype(np.float32)))
        z = _invariants(g, arch, arch.vector, z, weights, (1.0, 1.0), sizes)
    else:
        scaler = units.scaler(scaler)
    z = quantized(_scaled(g, z, scaler, start), "input")
    for i, (layer, integer_layer) in enumerate(zip(arch.layers, network.layers, strict=True)):
        scales = sum_scales(integer_layer.scale.multiplier, integer_layer.scale.before, integer_layer.scale.after)
        w = weights_of(f"conv{i}.weight", integer_layer.weights, scales)
        b = dequantized(f"conv{i}.bias", integer_layer.bias.astype(np.int32), scales)
        z = _padded(g, i, arch, layer, z)
        z = g.add("Conv", f"conv{i}", z, w, b, dilations=[layer.dilation], kernel_shape=[layer.kernel])
        z = quantized(g.add("Relu", f"relu{i}", z), f"layer{i}")
    # Over images, because OpenVINO 2026.4 averages 8-bit codes (N, F, T) over time to 0 in all but the first F windows.
    z = g.add("Unsqueeze", "image", z, g.constant("image.axis", np.array([2], dtype=np.int64)))
    z = _pooled(g, arch, z, 1)
    dense = network.dense
    scales = sum_scales(dense.scale.multiplier, dense.scale.before, dense.scale.after) / 256
    w = weights_of("dense.weight", dense.weights, scales * arch.pooled)
    z = g.add("Gemm", "dense", z, w, g.constant("dense.bias", (dense.bias * scales).astype(np.float32)), transB=1)
    low = g.constant("logits.low", np.array(-LIMIT, dtype=np.float32))
    high = g.constant("logits.high", np.array(LIMIT, dtype=np.float32))
    g.add("Clip", LOGITS, z, low, high)
    g.add("Softmax", PROBABILITIES, LOGITS, axis=-1)
    return g.to_bytes(bundle)


def run_model(model: bytes, values: Floats) -> NDArray[np.float32] | None:
    """Run a model in onnxruntime with its default settings; return the logits (N, K), or None if it is not installed.

    Args:
        values: windows (N, C, span) in the units of the layout.
    """
    if importlib.util.find_spec("onnxruntime") is None:
        return None
    ort = need("onnxruntime", "onnx")
    settings = ort.SessionOptions()
    settings.intra_op_num_threads = 1  # has no effect on the answers
    settings.log_severity_level = 3
    session = ort.InferenceSession(model, settings, providers=["CPUExecutionProvider"])
    return np.asarray(session.run([LOGITS], {RAW: values})[0])


_UNCHECKED = "Not tried: run  pip install 'plushsense[onnx]'  to have it compared in onnxruntime."


def to_onnx(job: ConversionJob) -> Conversion:
    """Convert the float network."""
    return _conversion(job, float_model(job.bundle), None)


def to_integer_onnx(job: ConversionJob) -> Conversion:
    """Convert the integer network; its outputs are close to those of the exported C, but not bit-identical."""
    network = integer_network(job.bundle)
    return _conversion(job, integer_model(job.bundle, network), network.forward(job.windows) / 256, NOT_EXACT)


def _conversion(job: ConversionJob, model: bytes, expected: NDArray[np.float64] | None, *notes: str) -> Conversion:
    notes = (*notes, f"Input {_facts(job.bundle)['input']}.")
    logits = run_model(model, job.values)
    if logits is None:
        return Conversion(model, None, (_UNCHECKED, *notes))
    return compared(job, model, logits, "ONNX", notes, expected)
