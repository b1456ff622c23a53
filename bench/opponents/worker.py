"""Run one Python runtime in the interpreter in which it is installed.

This needs NumPy and the runtime, but not PlushSense.

    python worker.py make PEER FOLDER     writes the runtime's model from FOLDER/case.npz; prints facts as JSON
    python worker.py run PEER FOLDER      decides on request, with the requests of loop.c

The model's input is set once, so that only the runtime's own call is timed and counted.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import json
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

Case = Mapping[str, NDArray[Any]]
Facts = dict[str, Any]
# Set a window (C, T); decide; return the logits (K,).
Answer = Callable[[NDArray[np.float32]], NDArray[np.float64]]


def int8_of(details: Mapping[str, Any], x: NDArray[Any]) -> NDArray[Any]:
    """Return floats as the codes of a quantized tensor, or unchanged."""
    if details["dtype"] == np.float32:
        return x.astype(np.float32)
    scale, zero = _scale(details)
    return np.clip(np.rint(x / scale) + zero, -128, 127).astype(np.int8)


def floats_of(details: Mapping[str, Any], x: NDArray[Any]) -> NDArray[np.float64]:
    """Return the codes of a quantized tensor as floats."""
    if details["dtype"] == np.float32:
        return x.astype(np.float64)
    scale, zero = _scale(details)
    return (x.astype(np.float64) - zero) * scale


def _scale(details: Mapping[str, Any]) -> tuple[float, int]:
    q = details["quantization_parameters"]
    return float(np.ravel(q["scales"])[0]), int(np.ravel(q["zero_points"])[0])


# ---- onnxruntime ------------------------------------------------------------------------------------------------


def onnx_float(case: Case, path: Path) -> None:
    """Build ``window`` (1, C, T) → ``logits`` (1, K), with the padding in the convolutions."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, held, z = [], [], "window"
    for i in range(int(case["layers"])):
        w, dilation = case[f"w{i}"], int(case[f"dilation{i}"])
        pads = [(w.shape[2] - 1) * dilation if case["padded"] else 0, 0]
        held += [numpy_helper.from_array(case[f"{n}{i}"], f"{n}{i}") for n in ("w", "b")]
        shape = {"kernel_shape": [w.shape[2]], "dilations": [dilation], "pads": pads}
        nodes.append(helper.make_node("Conv", [z, f"w{i}", f"b{i}"], [f"conv{i}"], name=f"conv{i}", **shape))
        nodes.append(helper.make_node("Relu", [f"conv{i}"], [f"relu{i}"], name=f"relu{i}"))
        z = f"relu{i}"
    held += [numpy_helper.from_array(case[n], n) for n in ("dense_w", "dense_b")]
    nodes.append(helper.make_node("GlobalAveragePool", [z], ["pooled"], name="pool"))
    nodes.append(helper.make_node("Flatten", ["pooled"], ["mean"], name="flat"))
    nodes.append(helper.make_node("Gemm", ["mean", "dense_w", "dense_b"], ["logits"], name="dense", transB=1))
    _, channels, length = case["windows"].shape
    graph = helper.make_graph(
        nodes,
        "bench",
        [helper.make_tensor_value_info("window", TensorProto.FLOAT, [1, channels, length])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, len(case["dense_b"])])],
        held,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def make_onnx(case: Case, folder: Path) -> Facts:
    onnx_float(case, folder / "float.onnx")
    return {"model": "float.onnx"}


def make_onnx_int8(case: Case, folder: Path) -> Facts:
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    class Windows(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._rows = iter(case["calibration"])

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            row = next(self._rows, None)
            return None if row is None else {"window": row[None]}

    onnx_float(case, folder / "before.onnx")
    quantize_static(
        str(folder / "before.onnx"), str(folder / "int8.onnx"), Windows(), quant_format=QuantFormat.QDQ,
        per_channel=True, activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
    )  # fmt: skip
    return {"model": "int8.onnx"}


def run_onnx(folder: Path, facts: Facts) -> tuple[Callable[[], Any], Answer]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    path = str(folder / facts["model"])
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    binding = session.io_binding()
    shape = session.get_inputs()[0].shape
    x = onnxruntime.OrtValue.ortvalue_from_numpy(np.zeros(shape, dtype=np.float32))
    binding.bind_ortvalue_input("window", x)
    classes = session.get_outputs()[0].shape
    out = onnxruntime.OrtValue.ortvalue_from_numpy(np.zeros(classes, dtype=np.float32))
    binding.bind_ortvalue_output("logits", out)
    inner, bound = session._sess.run_with_iobinding, binding._iobinding

    def decide() -> None:
        inner(bound, None)

    def answer(window: NDArray[np.float32]) -> NDArray[np.float64]:
        x.update_inplace(np.ascontiguousarray(window[None]))
        decide()
        return np.asarray(out.numpy()[0], dtype=np.float64)

    return decide, answer


# ---- LiteRT and TensorFlow Lite Micro ---------------------------------------------------------------------------


def make_tflite(case: Case, folder: Path) -> Facts:
    from opponents.tflite import float_model, quantized

    (folder / "int8.tflite").write_bytes(quantized(float_model(case), case))
    return {"model": "int8.tflite"}


def make_tflite_micro(case: Case, folder: Path) -> Facts:
    from tflite_micro.python.tflite_micro import runtime

    facts = make_tflite(case, folder)
    with tempfile.TemporaryFile() as said:
        before = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            interpreter = runtime.Interpreter.from_file(str(folder / facts["model"]), arena_size=1 << 20)
            interpreter.print_allocations()
            del interpreter
        finally:
            os.dup2(before, 2)
        said.seek(0)
        found = re.search(rb"Arena allocation total (\d+)", said.read())
    return {**facts, "memory_bytes": int(found[1]) if found else None}


def run_litert(folder: Path, facts: Facts) -> tuple[Callable[[], Any], Answer]:
    from ai_edge_litert import interpreter as litert

    interpreter = litert.Interpreter(model_path=str(folder / facts["model"]), num_threads=1)
    interpreter.allocate_tensors()
    read, given = interpreter.get_input_details()[0], interpreter.get_output_details()[0]
    decide = interpreter._interpreter.Invoke

    def answer(window: NDArray[np.float32]) -> NDArray[np.float64]:
        interpreter.set_tensor(read["index"], int8_of(read, window.T[None, None]))
        decide()
        return floats_of(given, interpreter.get_tensor(given["index"])[0])

    return decide, answer


def run_tflite_micro(folder: Path, facts: Facts) -> tuple[Callable[[], Any], Answer]:
    from tflite_micro.python.tflite_micro import runtime

    interpreter = runtime.Interpreter.from_file(str(folder / facts["model"]), arena_size=1 << 20)
    read, given = interpreter.get_input_details(0), interpreter.get_output_details(0)
    decide = interpreter._interpreter.Invoke

    def answer(window: NDArray[np.float32]) -> NDArray[np.float64]:
        interpreter.set_input(int8_of(read, window.T[None, None]), 0)
        decide()
        return floats_of(given, interpreter.get_output(0)[0])

    return decide, answer


# ---- ExecuTorch -------------------------------------------------------------------------------------------------


def make_executorch(case: Case, folder: Path) -> Facts:
    import torch
    from executorch.backends.xnnpack.partition.xnnpack_partitioner import XnnpackPartitioner
    from executorch.backends.xnnpack.quantizer.xnnpack_quantizer import (
        XNNPACKQuantizer,
        get_symmetric_quantization_config,
    )
    from executorch.exir import to_edge_transform_and_lower
    from torchao.quantization.pt2e.quantize_pt2e import convert_pt2e, prepare_pt2e

    class Window(torch.nn.Module):  # type: ignore[misc]
        """The network from (1, C, 1, T) to (1, K)."""

        def __init__(self) -> None:
            super().__init__()
            parts: list[torch.nn.Module] = []
            for i in range(int(case["layers"])):
                w, dilation = case[f"w{i}"], int(case[f"dilation{i}"])
                if case["padded"]:
                    parts.append(torch.nn.ZeroPad2d(((w.shape[2] - 1) * dilation, 0, 0, 0)))
                conv = torch.nn.Conv2d(w.shape[1], len(w), (1, w.shape[2]), dilation=(1, dilation))
                conv.weight.data = torch.tensor(w[:, :, None])
                conv.bias.data = torch.tensor(case[f"b{i}"])
                parts += [conv, torch.nn.ReLU()]
            self.layers = torch.nn.Sequential(*parts)
            self.dense = torch.nn.Linear(case["dense_w"].shape[1], len(case["dense_w"]))
            self.dense.weight.data = torch.tensor(case["dense_w"])
            self.dense.bias.data = torch.tensor(case["dense_b"])

        def forward(self, x: Any) -> Any:
            return self.dense(self.layers(x).mean((2, 3), keepdim=True).flatten(1))

    def given(row: NDArray[np.float32]) -> Any:
        return torch.tensor(row[None, :, None]).contiguous(memory_format=torch.channels_last)

    module, rows = Window().eval(), case["calibration"]
    example = (given(rows[0]),)
    quantizer = XNNPACKQuantizer().set_global(get_symmetric_quantization_config(is_per_channel=True))
    prepared = prepare_pt2e(torch.export.export(module, example).module(), quantizer)
    for row in rows:
        prepared(given(row))
    whole = torch.export.export(convert_pt2e(prepared), example)
    lowered = to_edge_transform_and_lower(whole, partitioner=[XnnpackPartitioner()])
    left = [str(n.target) for n in lowered.exported_program().graph.nodes if n.op == "call_function"]
    (folder / "int8.pte").write_bytes(lowered.to_executorch().buffer)
    outside = [name for name in left if "executorch_call_delegate" not in name and "getitem" not in name]
    return {"model": "int8.pte", "outside_xnnpack": outside}


def run_executorch(folder: Path, facts: Facts) -> tuple[Callable[[], Any], Answer]:
    import torch
    from executorch.runtime import Runtime

    torch.set_num_threads(1)
    with np.load(folder / "case.npz") as case:
        _, channels, length = case["windows"].shape
    method = Runtime.get().load_program(folder / facts["model"]).load_method("forward")
    x = torch.zeros(1, channels, 1, length).contiguous(memory_format=torch.channels_last)
    inputs = [x]

    def decide() -> Any:
        return method.execute(inputs)

    def answer(window: NDArray[np.float32]) -> NDArray[np.float64]:
        x.copy_(torch.tensor(window[None, :, None]))
        return np.asarray(decide()[0][0].numpy(), dtype=np.float64)

    return decide, answer


# ---- All runtimes -----------------------------------------------------------------------------------------------

Make = Callable[[Case, Path], Facts]
Run = Callable[[Path, Facts], tuple[Callable[[], Any], Answer]]
PEERS: dict[str, tuple[Make, Run]] = {
    "tflite-micro": (make_tflite_micro, run_tflite_micro),
    "litert": (make_tflite, run_litert),
    "executorch": (make_executorch, run_executorch),
    "onnxruntime": (make_onnx, run_onnx),
    "onnxruntime-int8": (make_onnx_int8, run_onnx),
}
PACKAGES = (
    "tflite-micro", "ai-edge-litert", "ai-edge-quantizer", "executorch", "torch", "torchao", "onnxruntime", "onnx",
    "numpy",
)  # fmt: skip


def make(peer: str, folder: Path) -> Facts:
    """Build the model file and describe it."""
    with np.load(folder / "case.npz") as case:
        facts = PEERS[peer][0](dict(case), folder)
    facts["model_bytes"] = (folder / facts["model"]).stat().st_size
    facts["versions"] = {}
    for package in PACKAGES:
        try:
            facts["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    (folder / f"{peer}.json").write_text(json.dumps(facts))
    return facts


def serve(peer: str, folder: Path, say: Callable[[str], None]) -> None:
    """Reply to requests until the input ends."""
    decide, answer = PEERS[peer][1](folder, json.loads((folder / f"{peer}.json").read_text()))
    marks = ctypes.CDLL(str(folder / "marks.so")) if (folder / "marks.so").exists() else None
    with np.load(folder / "case.npz") as case:
        windows = case["windows"]
    answer(windows[0])
    for line in sys.stdin:
        word, _, rest = line.strip().partition(" ")
        if word == "run":
            many = range(int(rest))
            began = time.perf_counter()
            for _ in many:
                decide()
            say(f"{time.perf_counter() - began:.9f}")
        elif word == "check":
            logits = np.stack([answer(window) for window in windows])
            Path(rest).write_bytes(logits.astype("<f8").tobytes())
            say(str(len(logits)))
        else:
            if marks is not None:
                marks.bench_mark()
            say("0")


def main() -> None:
    word, peer, folder = sys.argv[1:]
    # Runtimes print to standard output; keep it for the replies.
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(text: str) -> None:
        print(text, file=out, flush=True)

    if word == "make":
        say(json.dumps(make(peer, Path(folder))))
    else:
        serve(peer, Path(folder), say)


if __name__ == "__main__":
    main()
