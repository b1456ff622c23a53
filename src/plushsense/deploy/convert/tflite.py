"""Convert a network to LiteRT (.tflite): in floats, or with int8 convolutions.

Needs neither TensorFlow nor PyTorch.

The input ``raw`` (1, span, C) is float32, in the units of the layout (`InputUnits`), time before channels as usual in
LiteRT; the outputs are ``logits`` and ``probabilities`` (1, K). All operators are built into the interpreters of LiteRT
and TensorFlow Lite Micro.
"""

from __future__ import annotations

import json
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
    refuse_unwritable,
    refuse_window,
    sum_scales,
)
from plushsense.deploy.quantize import integer_network
from plushsense.models.arch import NORM_EPSILON, Arch, ConvLayer, reflected
from plushsense.models.bundle import Bundle
from plushsense.models.reference import affine
from plushsense.runtime.integer import IntegerNetwork
from plushsense.windows.features import InputUnits, Scaler

SCHEMA_VERSION = 3
ALIGNMENT = 16  # bytes, of the data of each buffer (force_align in the schema)
_ZERO = -128  # zero point of int8 codes, which are those of 0 to 255 minus 128


class _TfliteGraph:
    """Builds a graph; tensors and operators are stored in the order in which they are added."""

    def __init__(self) -> None:
        self.schema = need("ai_edge_litert.schema_py_generated", "tflite")
        self.flatbuffers = need("flatbuffers", "tflite")
        self.tensors: list[Any] = []
        self.buffers: list[Any] = [self.schema.BufferT()]  # the first is empty, for computed tensors
        self.operators: list[Any] = []
        self.codes: dict[tuple[str, int], int] = {}

    def _put(self, name: str, shape: tuple[int, ...], dtype: str, buffer: int) -> int:
        tensor = self.schema.TensorT()
        tensor.name, tensor.shape, tensor.buffer = name, list(shape), buffer
        tensor.type = getattr(self.schema.TensorType, dtype.upper())
        self.tensors.append(tensor)
        return len(self.tensors) - 1

    def _buffer(self, data: bytes) -> int:
        buffer = self.schema.BufferT()
        buffer.data, pack = np.frombuffer(data, dtype=np.uint8), buffer.Pack

        def aligned(builder: Any) -> Any:
            # The generated code of the schema ignores force_align.
            builder.Prep(ALIGNMENT, len(data))
            return pack(builder)

        buffer.Pack = aligned
        self.buffers.append(buffer)
        return len(self.buffers) - 1

    def value(self, name: str, *shape: int, dtype: str = "float32") -> int:
        """Add a computed tensor; an int8 one has codes with scale 1."""
        at = self._put(name, shape, dtype, 0)
        if dtype == "int8":
            self._quantized(at, np.ones(1), _ZERO)
        return at

    def constant(self, name: str, values: NDArray[Any], scales: NDArray[np.float64] | None = None) -> int:
        """Add a constant tensor; ``scales`` (F,) are the quantization scales of its first dimension."""
        little = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        at = self._put(name, values.shape, values.dtype.name, self._buffer(little.tobytes()))
        if scales is not None:
            self._quantized(at, scales, 0)
        return at

    def _quantized(self, at: int, scales: NDArray[np.float64], zero: int) -> None:
        q = self.schema.QuantizationParametersT()
        q.scale, q.zeroPoint = scales.astype(np.float32), np.full(len(scales), zero, dtype=np.int64)
        q.quantizedDimension = 0
        self.tensors[at].quantization = q

    def add(self, kind: str, out: int, *inputs: int, options: str = "", version: int = 1, **settings: Any) -> int:
        op = self.schema.OperatorT()
        op.opcodeIndex = self.codes.setdefault((kind, version), len(self.codes))
        op.inputs, op.outputs = list(inputs), [out]
        if options:
            op.builtinOptionsType = getattr(self.schema.BuiltinOptions, options)
            op.builtinOptions = getattr(self.schema, f"{options}T")()
            for name, setting in settings.items():
                setattr(op.builtinOptions, name, setting)
        self.operators.append(op)
        return out

    def per_channel(self, kind: str, name: str, z: int, values: Floats, *shape: int) -> int:
        """Add an operator ADD, SUB or MUL with one value per channel."""
        options = f"{kind.title()}Options"
        return self.add(kind, self.value(name, *shape), z, self.constant(f"{name}.by", values), options=options)

    def model(self, bundle: Bundle, raw: int, logits: int, probabilities: int) -> bytes:
        """Serialise the graph as a .tflite file."""
        schema = self.schema
        graph = schema.SubGraphT()
        graph.name, graph.tensors, graph.operators = "main", self.tensors, self.operators
        graph.inputs, graph.outputs = [raw], [logits, probabilities]
        model = schema.ModelT()
        model.version, model.subgraphs, model.buffers = SCHEMA_VERSION, [graph], self.buffers
        model.description = f"PlushSense, touch gestures, {bundle.arch.title}. {_input_note(bundle)}"
        model.operatorCodes = []
        for kind, version in self.codes:
            code = schema.OperatorCodeT()
            code.builtinCode = code.deprecatedBuiltinCode = getattr(schema.BuiltinOperator, kind)
            code.version = version
            model.operatorCodes.append(code)
        entry = schema.MetadataT()
        entry.name, entry.buffer = "plushsense", self._buffer(json.dumps(_facts(bundle), ensure_ascii=False).encode())
        model.metadata = [entry]
        model.signatureDefs = [self._signature(raw, logits, probabilities)]
        builder = self.flatbuffers.Builder(1 << 16)
        builder.Finish(model.Pack(builder), b"TFL3")
        return bytes(builder.Output())

    def _signature(self, raw: int, logits: int, probabilities: int) -> Any:
        named = []
        for name, at in ((RAW, raw), (LOGITS, logits), (PROBABILITIES, probabilities)):
            entry = self.schema.TensorMapT()
            entry.name, entry.tensorIndex = name, at
            named.append(entry)
        signature = self.schema.SignatureDefT()
        signature.signatureKey, signature.subgraphIndex = "serving_default", 0
        signature.inputs, signature.outputs = named[:1], named[1:]
        return signature

    def conv(self, z: int, out: int, weights: int, bias: int, layer: ConvLayer, version: int) -> int:
        """Add a convolution with ReLU over (1, 1, T, C)."""
        schema = self.schema
        return self.add(
            "CONV_2D",
            out,
            z,
            weights,
            bias,
            options="Conv2DOptions",
            version=version,
            padding=schema.Padding.VALID,
            strideW=1,
            strideH=1,
            dilationWFactor=layer.dilation,
            dilationHFactor=1,
            fusedActivationFunction=schema.ActivationFunctionType.RELU,
        )

    def mean(self, name: str, z: int, axes: tuple[int, ...], *shape: int, keep: bool) -> int:
        over = self.constant(f"{name}.axes", np.array(axes, dtype=np.int32))
        return self.add("MEAN", self.value(name, *shape), z, over, options="ReducerOptions", keepDims=keep)

    def softmax(self, logits: int, classes: int) -> int:
        out = self.value(PROBABILITIES, 1, classes)
        return self.add("SOFTMAX", out, logits, options="SoftmaxOptions", beta=1.0)

    def raised(self, z: int, name: str, arch: Arch, dtype: str = "float32") -> int:
        """Reshape (1, span, C) to (1, 1, span, C)."""
        shape = (1, 1, arch.span, arch.channels)
        new = self.constant(f"{name}.shape", np.array(shape, dtype=np.int32))
        return self.add("RESHAPE", self.value(name, *shape, dtype=dtype), z, new)


def _facts(bundle: Bundle) -> dict[str, str]:
    shape = f"(1, {bundle.arch.span}, {bundle.arch.channels})"
    return describe(bundle, f"'{RAW}', float32 {shape}, also for whole numbers: window, samples, channels")


def _input_note(bundle: Bundle) -> str:
    return f"Input {_facts(bundle)['input']}."


def float_model(bundle: Bundle) -> bytes:
    """Return the float network as .tflite."""
    g, arch = _TfliteGraph(), bundle.arch
    shape_in = (1, arch.span, arch.channels)
    raw = z = g.value(RAW, *shape_in)
    z = g.raised(_scaled(g, z, arch, InputUnits.of(bundle.layout).scaler(bundle.scaler)), "image", arch)
    for i, (layer, positions) in enumerate(zip(arch.layers, arch.positions, strict=True)):
        z = _padded(g, i, arch, layer, z)
        w = g.constant(f"conv{i}.weight", bundle.weights[f"conv{i}.weight"].transpose(0, 2, 1)[:, None])
        b = g.constant(f"conv{i}.bias", bundle.weights[f"conv{i}.bias"])
        shape = (1, 1, positions, layer.filters)
        z = g.conv(z, g.value(f"relu{i}", *shape), w, b, layer, 1)
        z = _normed(g, i, bundle, z, shape)
    z = g.mean("pooled", z, (1, 2), 1, arch.filters[-1], keep=False)
    w, b = (g.constant(n, bundle.weights[n]) for n in ("dense.weight", "dense.bias"))
    logits = g.add("FULLY_CONNECTED", g.value(LOGITS, 1, arch.classes), z, w, b, options="FullyConnectedOptions")
    return g.model(bundle, raw, logits, g.softmax(logits, arch.classes))


def _scaled(g: _TfliteGraph, z: int, arch: Arch, scaler: Scaler, start: NDArray[np.float64] | float = 0.0) -> int:
    names = (("SUB", "shifted"), ("MUL", "sized"), ("ADD", "scaled"))
    for (kind, name), values in zip(names, in_float32(scaler, start), strict=True):
        z = g.per_channel(kind, name, z, values, 1, arch.span, arch.channels)
    return z


def _padded(g: _TfliteGraph, i: int, arch: Arch, layer: ConvLayer, z: int) -> int:
    if arch.padding == "stream" or not layer.reach:
        return z
    out = g.value(f"padded{i}", 1, 1, arch.window + layer.reach, arch.inputs[i])
    if arch.padding == "mirror" and layer.reach >= arch.window:
        # MIRROR_PAD reflects only once; longer padding needs several reflections.
        indices = g.constant(f"padded{i}.places", reflected(arch.window, layer.reach).astype(np.int32))
        return g.add("GATHER", out, z, indices, options="GatherOptions", axis=2)
    pads = g.constant(f"padded{i}.pads", np.array([[0, 0], [0, 0], [layer.reach, 0], [0, 0]], dtype=np.int32))
    if arch.padding == "causal":
        return g.add("PAD", out, z, pads, options="PadOptions")
    return g.add("MIRROR_PAD", out, z, pads, options="MirrorPadOptions", mode=g.schema.MirrorPadMode.REFLECT)


def _normed(g: _TfliteGraph, i: int, bundle: Bundle, z: int, shape: tuple[int, ...]) -> int:
    if bundle.arch.norm == "none":
        return z
    gain, shift = affine(bundle.arch, i, bundle.weights)
    if bundle.arch.norm == "layer":
        row = (*shape[:3], 1)
        mean = g.mean(f"mean{i}", z, (3,), *row, keep=True)
        squares = g.add("SQUARED_DIFFERENCE", g.value(f"squares{i}", *shape), z, mean)
        var = g.mean(f"var{i}", squares, (3,), *row, keep=True)
        var = g.per_channel("ADD", f"eps{i}", var, np.full(1, NORM_EPSILON, dtype=np.float32), *row)
        root = g.add("RSQRT", g.value(f"root{i}", *row), var)
        z = g.add("SUB", g.value(f"centred{i}", *shape), z, mean, options="SubOptions")
        z = g.add("MUL", g.value(f"even{i}", *shape), z, root, options="MulOptions")
    z = g.per_channel("MUL", f"gain{i}", z, gain.astype(np.float32), *shape)
    return g.per_channel("ADD", f"norm{i}", z, shift.astype(np.float32), *shape)


def integer_model(bundle: Bundle, network: IntegerNetwork) -> bytes:
    """Return the network with int8 convolutions as .tflite.

    Activations have the codes of `IntegerNetwork` minus 128 with scale 1; the scale of each filter is applied to its
    weights. The scaling of inputs, the mean over time and the dense layer are computed in float32.
    """
    g, arch = _TfliteGraph(), network.arch
    shape_in = (1, arch.span, arch.channels)
    raw = z = g.value(RAW, *shape_in)
    scaler, start = input_codes(network)
    z = _scaled(g, z, arch, InputUnits.of(bundle.layout).scaler(scaler), start)
    z = g.add("QUANTIZE", g.value("codes", *shape_in, dtype="int8"), z)
    z = g.raised(z, "image", arch, "int8")
    for i, (layer, part, positions) in enumerate(zip(arch.layers, network.layers, arch.positions, strict=True)):
        scales = sum_scales(part.scale.multiplier, part.scale.before, part.scale.after)
        w = g.constant(f"conv{i}.weight", part.weights.transpose(0, 2, 1)[:, None], scales)
        b = g.constant(f"conv{i}.bias", part.bias.astype(np.int32), scales)
        z = g.conv(z, g.value(f"layer{i}", 1, 1, positions, layer.filters, dtype="int8"), w, b, layer, 3)
    z = g.add("DEQUANTIZE", g.value("real", 1, 1, arch.pooled, arch.filters[-1]), z, version=2)
    z = g.mean("pooled", z, (1, 2), 1, arch.filters[-1], keep=False)
    dense = network.dense
    scales = sum_scales(dense.scale.multiplier, dense.scale.before, dense.scale.after) / 256
    w = g.constant("dense.weight", (dense.weights * (scales * arch.pooled)[:, None]).astype(np.float32))
    b = g.constant("dense.bias", (dense.bias * scales).astype(np.float32))
    z = g.add("FULLY_CONNECTED", g.value("dense", 1, arch.classes), z, w, b, options="FullyConnectedOptions")
    for kind, limit in (("MINIMUM", LIMIT), ("MAXIMUM", -LIMIT)):
        name = LOGITS if limit < 0 else "lowered"
        by = g.constant(f"{name}.by", np.full(1, limit, dtype=np.float32))
        z = g.add(kind, g.value(name, 1, arch.classes), z, by, options="MaximumMinimumOptions")
    return g.model(bundle, raw, z, g.softmax(z, arch.classes))


def run_model(model: bytes, values: Floats) -> NDArray[np.float32]:
    """Run a model in the LiteRT interpreter; return the logits (N, K).

    Args:
        values: windows (N, C, span) in the units of the layout.
    """
    litert = need("ai_edge_litert.interpreter", "tflite")
    run = litert.Interpreter(model_content=model, num_threads=1).get_signature_runner("serving_default")
    rows = values.transpose(0, 2, 1)[:, None]
    return np.concatenate([run(**{RAW: np.ascontiguousarray(row)})[LOGITS] for row in rows])


def to_tflite(job: ConversionJob) -> Conversion:
    """Convert the float network."""
    refuse_unwritable(job.bundle.arch, ".tflite")
    model = float_model(job.bundle)
    return compared(job, model, run_model(model, job.values), "LiteRT", (_input_note(job.bundle),))


def to_integer_tflite(job: ConversionJob) -> Conversion:
    """Convert the network with int8 convolutions; its outputs are close to those of the C, not bit-identical."""
    refuse_window(job.bundle.arch, "tflite-int8")
    refuse_unwritable(job.bundle.arch, ".tflite")
    network = integer_network(job.bundle)
    model = integer_model(job.bundle, network)
    logits, expected = run_model(model, job.values), network.forward(job.windows) / 256
    return compared(job, model, logits, "LiteRT", (NOT_EXACT, _input_note(job.bundle)), expected)
