"""Run one Python runtime in the interpreter in which it is installed.

This needs NumPy and the runtime, but not PlushSense.

    python worker.py make PEER ALGORITHM FOLDER   writes the runtime's model from FOLDER/ALGORITHM.npz; prints facts
    python worker.py run PEER ALGORITHM FOLDER    decides on request, with the requests of loop.c

ALGORITHM is "window" or "stream". The graph of the stream reads the samples of one step and, as further inputs, each
layer's history and the means of earlier steps; it returns the new ones beside the logits. Inputs are set once, so that
only the runtime's own call is timed and counted: not handing the state back, which only a check does.
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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

Case = Mapping[str, NDArray[Any]]
Facts = dict[str, Any]


@dataclass
class Model:
    """A loaded network: ``put`` sets samples (C, T), ``decide`` is the runtime's own call, ``logits`` reads (K,), and
    ``carry`` gives the new states back as inputs.
    """

    put: Callable[[NDArray[np.float32]], object]
    decide: Callable[[], Any]
    logits: Callable[[], NDArray[np.float64]]
    carry: Callable[[], None]


def states_of(case: Case) -> dict[str, tuple[int, int]]:
    """Return the shapes (C, T) of the states, in the order of the inputs; empty for a window."""
    names = [name.removeprefix("calibration.") for name in case if name.startswith("calibration.")]
    return {name: case[f"calibration.{name}"].shape[1:] for name in names if name != "x"}


def int8_of(details: Mapping[str, Any], x: NDArray[Any]) -> NDArray[np.int8]:
    """Return floats as the codes of a quantized tensor."""
    scale, zero = _scale(details)
    return np.clip(np.rint(x / scale) + zero, -128, 127).astype(np.int8)


def floats_of(details: Mapping[str, Any], x: NDArray[Any]) -> NDArray[np.float64]:
    """Return the codes of a quantized tensor as floats."""
    scale, zero = _scale(details)
    return (x.astype(np.float64) - zero) * scale


def _scale(details: Mapping[str, Any]) -> tuple[float, int]:
    q = details["quantization_parameters"]
    return float(np.ravel(q["scales"])[0]), int(np.ravel(q["zero_points"])[0])


# ---- onnxruntime ------------------------------------------------------------------------------------------------


def onnx_float(case: Case, path: Path) -> None:
    """Build ``x`` (1, C, T) → ``logits`` (1, K), for a window with the padding in the convolutions."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, held, states, z = [], [], states_of(case), "x"

    def constant(name: str, values: NDArray[Any]) -> str:
        held.append(numpy_helper.from_array(values, name))
        return name

    def with_state(name: str, z: str, new: int) -> str:
        """Put a state before new samples, and let the newest ones be the next state."""
        nodes.append(helper.make_node("Concat", [name, z], [f"{name}_whole"], name=f"{name}_whole", axis=2))
        bounds = (("from", new), ("to", new + states[name][1]), ("axis", 2))
        read = [constant(f"{name}_{what}", np.array([value], dtype=np.int64)) for what, value in bounds]
        nodes.append(helper.make_node("Slice", [f"{name}_whole", *read], [f"{name}_next"], name=f"{name}_next"))
        return f"{name}_whole"

    def pooled(name: str, z: str) -> str:
        nodes.append(helper.make_node("GlobalAveragePool", [z], [name], name=name))
        return name

    _, channels, length = case["x"].shape
    for i in range(int(case["layers"])):
        w, dilation = case[f"w{i}"], int(case[f"dilation{i}"])
        if f"history{i}" in states:
            z = with_state(f"history{i}", z, length)
        pads = [(w.shape[2] - 1) * dilation if case["padded"] else 0, 0]
        shape = {"kernel_shape": [w.shape[2]], "dilations": [dilation], "pads": pads}
        read = [z, *(constant(f"{n}{i}", case[f"{n}{i}"]) for n in ("w", "b"))]
        nodes.append(helper.make_node("Conv", read, [f"conv{i}"], name=f"conv{i}", **shape))
        nodes.append(helper.make_node("Relu", [f"conv{i}"], [f"relu{i}"], name=f"relu{i}"))
        z = f"relu{i}"
    if "blocks" in states:
        z = with_state("blocks", pooled("block", z), 1)
    nodes.append(helper.make_node("Flatten", [pooled("pooled", z)], ["mean"], name="flat"))
    dense = [constant(n, case[n]) for n in ("dense_w", "dense_b")]
    nodes.append(helper.make_node("Gemm", ["mean", *dense], ["logits"], name="dense", transB=1))

    def port(name: str, *shape: int) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, *shape])

    starts = [port("x", channels, length), *(port(name, *shape) for name, shape in states.items())]
    ends = [port("logits", len(case["dense_b"])), *(port(f"{name}_next", *shape) for name, shape in states.items())]
    graph = helper.make_graph(nodes, "bench", starts, ends, held)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def make_onnx(case: Case, path: Path) -> Facts:
    onnx_float(case, path)
    return {}


def make_onnx_int8(case: Case, path: Path) -> Facts:
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    names = ["x", *states_of(case)]

    class Windows(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._rows = zip(*(case[f"calibration.{name}"] for name in names), strict=True)

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            row = next(self._rows, None)
            return None if row is None else {name: values[None] for name, values in zip(names, row, strict=True)}

    before = path.with_suffix(".before")
    onnx_float(case, before)
    quantize_static(
        str(before), str(path), Windows(), quant_format=QuantFormat.QDQ,
        per_channel=True, activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
    )  # fmt: skip
    return {}


def run_onnx(case: Case, path: Path) -> Model:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    binding = session.io_binding()

    def bound(bind: Callable[[str, Any], None], port: Any) -> Any:
        values = onnxruntime.OrtValue.ortvalue_from_numpy(np.zeros(port.shape, dtype=np.float32))
        bind(port.name, values)
        return values

    x, *states = (bound(binding.bind_ortvalue_input, port) for port in session.get_inputs())
    out, *after = (bound(binding.bind_ortvalue_output, port) for port in session.get_outputs())
    inner, io = session._sess.run_with_iobinding, binding._iobinding

    def carry() -> None:
        for state, values in zip(states, after, strict=True):
            state.update_inplace(values.numpy())

    return Model(
        lambda samples: x.update_inplace(np.ascontiguousarray(samples[None])), lambda: inner(io, None),
        lambda: np.asarray(out.numpy()[0], dtype=np.float64), carry,
    )  # fmt: skip


# ---- LiteRT and TensorFlow Lite Micro ---------------------------------------------------------------------------


def make_tflite(case: Case, path: Path) -> Facts:
    from opponents.tflite import float_model, quantized

    path.write_bytes(quantized(float_model(case), case))
    return {}


def make_cmsis_nn(case: Case, path: Path) -> Facts:
    from opponents.tflite import float_model, integers, quantized

    header, scales = integers(quantized(float_model(case), case), case)
    path.write_text(header)
    (scale, zero), x = scales["input"], case["x"].transpose(0, 2, 1)
    path.with_suffix(".bin").write_bytes(np.clip(np.rint(x / scale) + zero, -128, 127).astype(np.int8).tobytes())
    return {"logits": scales["logits"]}


def make_tflite_micro(case: Case, path: Path) -> Facts:
    from tflite_micro.python.tflite_micro import runtime

    make_tflite(case, path)
    with tempfile.TemporaryFile() as said:
        before = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            interpreter = runtime.Interpreter.from_file(str(path), arena_size=1 << 20)
            interpreter.print_allocations()
            del interpreter
        finally:
            os.dup2(before, 2)
        said.seek(0)
        found = re.search(rb"Arena allocation total (\d+)", said.read())
    return {"memory_bytes": int(found[1]) if found else None}


def run_litert(case: Case, path: Path) -> Model:
    from ai_edge_litert import interpreter as litert

    interpreter = litert.Interpreter(model_path=str(path), num_threads=1)
    interpreter.allocate_tensors()
    starts, ends = interpreter.get_input_details(), interpreter.get_output_details()
    return tflite_model(
        case, interpreter, starts, ends, lambda i, values: interpreter.set_tensor(starts[i]["index"], values),
        lambda i: interpreter.get_tensor(ends[i]["index"]),
    )  # fmt: skip


def run_tflite_micro(case: Case, path: Path) -> Model:
    from tflite_micro.python.tflite_micro import runtime

    interpreter = runtime.Interpreter.from_file(str(path), arena_size=1 << 20)
    ports = range(1 + len(states_of(case)))
    starts, ends = ([of(i) for i in ports] for of in (interpreter.get_input_details, interpreter.get_output_details))
    return tflite_model(
        case, interpreter, starts, ends, lambda i, values: interpreter.set_input(values, i), interpreter.get_output
    )


def tflite_model(
    case: Case,
    interpreter: Any,
    starts: Sequence[Mapping[str, Any]],
    ends: Sequence[Mapping[str, Any]],
    put: Callable[[int, NDArray[Any]], None],
    get: Callable[[int], NDArray[Any]],
) -> Model:
    """Return the model of an interpreter, whose states must have the same scale before and after a step."""
    for i in range(1, 1 + len(states_of(case))):
        if list(starts[i]["shape"]) != list(ends[i]["shape"]) or _scale(starts[i]) != _scale(ends[i]):
            raise SystemExit(f"state {i} goes in as {starts[i]} and comes out as {ends[i]}")
        put(i, int8_of(starts[i], np.zeros(starts[i]["shape"])))

    def carry() -> None:
        # All are read first: TensorFlow Lite Micro lets inputs and outputs share memory.
        for i, values in [(i, get(i).copy()) for i in range(1, len(starts))]:
            put(i, values)

    return Model(
        lambda samples: put(0, int8_of(starts[0], samples.T[None, None])), interpreter._interpreter.Invoke,
        lambda: floats_of(ends[0], get(0)[0]), carry,
    )  # fmt: skip


# ---- All runtimes -----------------------------------------------------------------------------------------------

Make = Callable[[Case, Path], Facts]
Run = Callable[[Case, Path], Model]
# The last only makes C, which programs.py builds.
PEERS: dict[str, tuple[Make, Run | None]] = {
    "tflite-micro": (make_tflite_micro, run_tflite_micro),
    "litert": (make_tflite, run_litert),
    "onnxruntime": (make_onnx, run_onnx),
    "onnxruntime-int8": (make_onnx_int8, run_onnx),
    "cmsis-nn": (make_cmsis_nn, None),
}
PACKAGES = ("tflite-micro", "ai-edge-litert", "ai-edge-quantizer", "onnxruntime", "onnx", "numpy")


def make(case: Case, peer: str, path: Path) -> Facts:
    """Build the model file and describe it."""
    facts = PEERS[peer][0](case, path)
    facts["model_bytes"] = path.stat().st_size
    facts["versions"] = {}
    for package in PACKAGES:
        try:
            facts["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return facts


def serve(case: Case, peer: str, path: Path, say: Callable[[str], None]) -> None:
    """Reply to requests until the input ends."""
    run = PEERS[peer][1]
    if run is None:
        raise SystemExit(f"{peer} does not run here")
    model = run(case, path)
    shared = path.with_name("marks.so")
    marks = ctypes.CDLL(str(shared)) if shared.exists() else None

    def answer(samples: NDArray[np.float32]) -> NDArray[np.float64]:
        model.put(samples)
        model.decide()
        logits = model.logits()
        model.carry()
        return logits

    answer(case["x"][0])
    decide = model.decide
    for line in sys.stdin:
        word, _, rest = line.strip().partition(" ")
        if word == "run":
            many = range(int(rest))
            began = time.perf_counter()
            for _ in many:
                decide()
            say(f"{time.perf_counter() - began:.9f}")
        elif word == "check":
            logits = np.stack([answer(samples) for samples in case["x"]])
            Path(rest).write_bytes(logits.astype("<f8").tobytes())
            say(str(len(logits)))
        else:
            if marks is not None:
                marks.bench_mark()
            say("0")


def main() -> None:
    word, peer, algorithm, folder = sys.argv[1:]
    # Runtimes print to standard output; keep it for the replies.
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(text: str) -> None:
        print(text, file=out, flush=True)

    with np.load(Path(folder) / f"{algorithm}.npz") as stored:
        case = dict(stored)
    path = Path(folder) / f"{peer}-{algorithm}.model"
    if word == "make":
        say(json.dumps(make(case, peer, path)))
    else:
        serve(case, peer, path, say)


if __name__ == "__main__":
    main()
