"""Write the network as a float .tflite file with LiteRT's schema, quantize it with LiteRT's own tool, make C of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def float_model(case: Mapping[str, NDArray[Any]]) -> bytes:
    """Build the float model with time before channels: ``x`` (1, 1, T, C) → ``logits`` (1, K).

    If the case is a stream, each state is another input (1, 1, T, C), and another output.
    """
    import flatbuffers
    from ai_edge_litert import schema_py_generated as schema

    buffers, tensors, operators, codes = [schema.BufferT()], [], [], []

    def tensor(name: str, shape: tuple[int, ...], values: NDArray[Any] | None = None) -> int:
        made = schema.TensorT()
        made.name, made.shape, made.buffer = name, list(shape), 0
        made.type = schema.TensorType.FLOAT32
        if values is not None:
            held = schema.BufferT()
            held.data = np.frombuffer(np.ascontiguousarray(values).tobytes(), dtype=np.uint8)
            buffers.append(held)
            made.buffer = len(buffers) - 1
            made.type = schema.TensorType.INT32 if values.dtype == np.int32 else schema.TensorType.FLOAT32
        tensors.append(made)
        return len(tensors) - 1

    def given(name: str, values: NDArray[Any]) -> int:
        return tensor(name, values.shape, values)

    def operator(kind: str, version: int, read: list[int], out: int, options: str, **settings: Any) -> int:
        code = (getattr(schema.BuiltinOperator, kind), version)
        if code not in codes:
            codes.append(code)
        made = schema.OperatorT()
        made.opcodeIndex, made.inputs, made.outputs = codes.index(code), read, [out]
        made.builtinOptionsType = getattr(schema.BuiltinOptions, options)
        made.builtinOptions = getattr(schema, f"{options}T")()
        for name, value in settings.items():
            setattr(made.builtinOptions, name, value)
        operators.append(made)
        return out

    def with_state(name: str, z: int) -> int:
        """Put a state before new samples, and let the newest ones be the next state."""
        (_, channels, past), (_, _, new, _) = case[f"calibration.{name}"].shape, tensors[z].shape
        starts.append(tensor(name, (1, 1, past, channels)))
        whole = tensor(f"{name}.whole", (1, 1, past + new, channels))
        operator("CONCATENATION", 1, [starts[-1], z], whole, "ConcatenationOptions", axis=2)
        at, size = (given(f"{name}.{what}", np.array(v, dtype=np.int32)) for what, v in (
            ("at", [0, 0, new, 0]), ("size", [1, 1, past, channels])))  # fmt: skip
        ends.append(
            operator("SLICE", 1, [whole, at, size], tensor(f"{name}.next", (1, 1, past, channels)), "SliceOptions")
        )
        return whole

    def mean(name: str, z: int, *, keep: bool) -> int:
        channels = tensors[z].shape[3]
        out = tensor(name, (1, 1, 1, channels) if keep else (1, channels))
        return operator("MEAN", 1, [z, axes], out, "ReducerOptions", keepDims=keep)

    _, channels, length = case["x"].shape
    starts, ends = [tensor("x", (1, 1, length, channels))], list[int]()
    z = starts[0]
    for i in range(int(case["layers"])):
        w, dilation = case[f"w{i}"], int(case[f"dilation{i}"])
        reach = (w.shape[2] - 1) * dilation
        if case["padded"] and reach:
            out = tensor(f"padded{i}", (1, 1, length + reach, channels))
            pads = given(f"pads{i}", np.array([[0, 0], [0, 0], [reach, 0], [0, 0]], dtype=np.int32))
            z = operator("PAD", 1, [z, pads], out, "PadOptions")
        elif f"calibration.history{i}" in case:
            z = with_state(f"history{i}", z)
        read = [z, given(f"w{i}", w.transpose(0, 2, 1)[:, None]), given(f"b{i}", case[f"b{i}"])]
        length, channels = tensors[z].shape[2] - reach, len(w)
        z = operator(
            "CONV_2D", 1, read, tensor(f"layer{i}", (1, 1, length, channels)), "Conv2DOptions",
            padding=schema.Padding.VALID, strideW=1, strideH=1, dilationWFactor=dilation, dilationHFactor=1,
            fusedActivationFunction=schema.ActivationFunctionType.RELU,
        )  # fmt: skip
    axes = given("axes", np.array([1, 2], dtype=np.int32))
    if "calibration.blocks" in case:
        z = with_state("blocks", mean("block", z, keep=True))
    read = [mean("mean", z, keep=False), given("dense_w", case["dense_w"]), given("dense_b", case["dense_b"])]
    ends.insert(
        0, operator("FULLY_CONNECTED", 1, read, tensor("logits", (1, len(case["dense_b"]))), "FullyConnectedOptions")
    )

    model, graph = schema.ModelT(), schema.SubGraphT()
    graph.name, graph.tensors, graph.operators = "main", tensors, operators
    graph.inputs, graph.outputs = starts, ends
    model.version, model.subgraphs, model.buffers, model.description = 3, [graph], buffers, "bench"
    model.operatorCodes = []
    for builtin, version in codes:
        code = schema.OperatorCodeT()
        code.builtinCode = code.deprecatedBuiltinCode = builtin
        code.version = version
        model.operatorCodes.append(code)
    signature = schema.SignatureDefT()
    signature.signatureKey, signature.subgraphIndex, signature.inputs, signature.outputs = "serving_default", 0, [], []
    for ports, indices in ((signature.inputs, starts), (signature.outputs, ends)):
        for index in indices:
            port = schema.TensorMapT()
            port.name, port.tensorIndex = tensors[index].name, index
            ports.append(port)
    model.signatureDefs = [signature]
    builder = flatbuffers.Builder(1 << 16)
    builder.Finish(model.Pack(builder), b"TFL3")
    return bytes(builder.Output())


def quantized(model: bytes, case: Mapping[str, NDArray[Any]]) -> bytes:
    """Quantize with ai-edge-quantizer: int8 weights by channel and int8 activations.

    By default it calibrates with a moving mean of each window's extremes, which clips rare values. The extremes of all
    windows, which it also offers, give answers closer to the float ones here.
    """
    from ai_edge_quantizer import calibrator, quantizer, recipe, recipe_manager
    from ai_edge_quantizer.utils import qsv_utils

    how = recipe.static_wi8_ai8()
    recipes = recipe_manager.RecipeManager()
    recipes.load_quantization_recipe(how)
    names = [name for name in case if name.startswith("calibration.")]
    given = {name.removeprefix("calibration."): case[name].transpose(0, 2, 1)[:, None, None] for name in names}
    rows = [dict(zip(given, row, strict=True)) for row in zip(*given.values(), strict=True)]
    seen = calibrator.Calibrator(model, num_threads=1, qsv_update_func=qsv_utils.min_max_update)
    seen.calibrate({"serving_default": rows}, recipes)
    tool = quantizer.Quantizer(model, how)
    return bytes(tool.quantize(seen.get_model_qsvs(), enable_progress_report=False).quantized_model)


def integers(model: bytes, case: Mapping[str, NDArray[Any]]) -> tuple[str, dict[str, tuple[float, int]]]:
    """Return a quantized model as C for `cmsis.c`, and the scale and zero of its input and logits."""
    from ai_edge_litert import schema_py_generated as schema

    whole = schema.ModelT.InitFromObj(schema.Model.GetRootAs(model, 0))
    graph, text, rows = whole.subgraphs[0], "", []
    named = {tensor.name.decode(): tensor for tensor in graph.tensors}

    def scale(name: str) -> tuple[float, int]:
        q = named[name].quantization
        return float(q.scale[0]), int(q.zeroPoint[0])

    def array(kind: str, name: str, values: Any) -> str:
        return f"static const {kind} {name}[] = {{{', '.join(map(str, values))}}};\n"

    def multipliers(name: str, ratios: NDArray[np.float64]) -> tuple[str, list[int], list[int]]:
        """Split ratios into 31 bits and a power of two."""
        parts, powers = np.frexp(ratios)
        codes = np.rint(parts * 2.0**31).astype(np.int64)
        powers, codes = powers + (codes == 2**31), np.where(codes == 2**31, 2**30, codes)
        arrays = array("int32_t", f"{name}_multiplier", codes) + array("int32_t", f"{name}_shift", powers)
        return arrays, codes.tolist(), powers.tolist()

    def product(name: str, read: str, out: str, w: str, b: str) -> str:
        """Return weights, biases and multipliers of a convolution or the dense layer."""
        ratios = scale(read)[0] * np.array(named[w].quantization.scale, dtype=np.float64) / scale(out)[0]
        held = [
            np.frombuffer(bytes(whole.buffers[named[key].buffer].data), kind) for key, kind in ((w, "i1"), (b, "<i4"))
        ]
        arrays = array("int8_t", f"{name}_w", held[0]) + array("int32_t", f"{name}_b", held[1])
        return arrays + multipliers(name, ratios)[0]

    stream, columns = "calibration.blocks" in case, 0
    _, _, fresh = case["x"].shape
    count = int(case["layers"])
    # The input of a layer with history is what the state joins; of a window, what it is padded to has the same scale.
    reads = [
        f"history{i}.whole" if f"history{i}.whole" in named else f"layer{i - 1}" if i else "x" for i in range(count)
    ]
    for i, read in enumerate(reads):
        w, dilation = case[f"w{i}"], int(case[f"dilation{i}"])
        filters, channels, kernel = w.shape
        reach = (kernel - 1) * dilation
        kept, pad = (reach, 0) if stream else (0, reach if case["padded"] else 0)
        left = fresh if stream or case["padded"] else fresh - reach
        text += product(f"layer{i}", read, f"layer{i}", f"w{i}", f"b{i}")
        text += f"static int8_t input{i}[{(kept + fresh) * channels}];\n"
        numbers = [kept, fresh, pad, channels, kernel, dilation, filters, scale(read)[1]]
        pointers = [f"layer{i}_{what}" for what in ("w", "b", "multiplier", "shift")]
        rows.append(", ".join(map(str, [*numbers, scale(f"layer{i}")[1], *pointers, f"input{i}"])))
        fresh, columns = left, max(columns, 4 * -(-kernel * channels // 4))
    text += product("dense", "mean", "logits", "dense_w", "dense_b")
    text += f"static const conv_layer layers[] = {{{', '.join(f'{{{row}}}' for row in rows)}}};\n"
    blocks = case["calibration.blocks"].shape[2] + 1 if stream else 1
    block = "block" if stream else "mean"
    (last, zero), (mean, _) = scale(f"layer{count - 1}"), scale(block)
    ratios = np.array([last / mean / fresh, mean / scale("mean")[0] / blocks])
    _, codes, powers = multipliers("mean", ratios)
    facts = {
        "LAYERS": count, "POSITIONS": fresh, "FEATURES": case["dense_w"].shape[1], "CLASSES": len(case["dense_b"]),
        "BLOCKS": blocks, "MOST_COLUMNS": columns, "BLOCK_READ_ZERO": zero, "BLOCK_WRITE_ZERO": scale(block)[1],
        "BLOCK_MULTIPLIER": codes[0], "BLOCK_SHIFT": powers[0], "MEAN_MULTIPLIER": codes[1], "MEAN_SHIFT": powers[1],
        "MEAN_WRITE_ZERO": scale("mean")[1], "LOGITS_ZERO": scale("logits")[1],
    }  # fmt: skip
    head = "".join(f"#define {name} ({value})\n" for name, value in facts.items())
    return head + text, {"input": scale(reads[0]), "logits": scale("logits")}
