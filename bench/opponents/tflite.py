"""Write the network as a float .tflite file with LiteRT's schema, and quantize it with LiteRT's own tool."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def float_model(case: Mapping[str, NDArray[Any]]) -> bytes:
    """Build the float model with time before channels: ``window`` (1, 1, T, C) → ``logits`` (1, K)."""
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

    length, channels = case["windows"].shape[2], case["windows"].shape[1]
    start = z = tensor("window", (1, 1, length, channels))
    for i in range(int(case["layers"])):
        w, dilation = case[f"w{i}"], int(case[f"dilation{i}"])
        filters, reach = len(w), (w.shape[2] - 1) * dilation
        if case["padded"] and reach:
            out = tensor(f"padded{i}", (1, 1, length + reach, channels))
            pads = given(f"pads{i}", np.array([[0, 0], [0, 0], [reach, 0], [0, 0]], dtype=np.int32))
            z = operator("PAD", 1, [z, pads], out, "PadOptions")
        else:
            length -= reach
        read = [z, given(f"w{i}", w.transpose(0, 2, 1)[:, None]), given(f"b{i}", case[f"b{i}"])]
        z = operator(
            "CONV_2D", 1, read, tensor(f"layer{i}", (1, 1, length, filters)), "Conv2DOptions",
            padding=schema.Padding.VALID, strideW=1, strideH=1, dilationWFactor=dilation, dilationHFactor=1,
            fusedActivationFunction=schema.ActivationFunctionType.RELU,
        )  # fmt: skip
        channels = filters
    axes = given("axes", np.array([1, 2], dtype=np.int32))
    z = operator("MEAN", 1, [z, axes], tensor("mean", (1, channels)), "ReducerOptions", keepDims=False)
    read = [z, given("dense_w", case["dense_w"]), given("dense_b", case["dense_b"])]
    out = tensor("logits", (1, len(case["dense_b"])))
    operator("FULLY_CONNECTED", 1, read, out, "FullyConnectedOptions")

    model, graph = schema.ModelT(), schema.SubGraphT()
    graph.name, graph.tensors, graph.operators = "main", tensors, operators
    graph.inputs, graph.outputs = [start], [out]
    model.version, model.subgraphs, model.buffers, model.description = 3, [graph], buffers, "bench"
    model.operatorCodes = []
    for builtin, version in codes:
        code = schema.OperatorCodeT()
        code.builtinCode = code.deprecatedBuiltinCode = builtin
        code.version = version
        model.operatorCodes.append(code)
    signature = schema.SignatureDefT()
    signature.signatureKey, signature.subgraphIndex = "serving_default", 0
    signature.inputs, signature.outputs = [schema.TensorMapT()], [schema.TensorMapT()]
    signature.inputs[0].name, signature.inputs[0].tensorIndex = "window", start
    signature.outputs[0].name, signature.outputs[0].tensorIndex = "logits", out
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
    rows = case["calibration"].transpose(0, 2, 1)[:, None]
    seen = calibrator.Calibrator(model, num_threads=1, qsv_update_func=qsv_utils.min_max_update)
    seen.calibrate({"serving_default": [{"window": np.ascontiguousarray(row[None])} for row in rows]}, recipes)
    tool = quantizer.Quantizer(model, how)
    return bytes(tool.quantize(seen.get_model_qsvs(), enable_progress_report=False).quantized_model)
