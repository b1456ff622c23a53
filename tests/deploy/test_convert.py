"""Files for other runtimes give the network's answers, in the runtimes they are for."""

from __future__ import annotations

import importlib
import itertools
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import ArchError, BadInput, BundleError, ConfigError, MissingExtraError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import Derived, load_layout
from plushsense.core.recorder_csv import read_stream
from plushsense.dataset.importing.matfile import read_mat, texts_of
from plushsense.deploy.convert import ConversionJob, compared, convert, describe, made_up_windows
from plushsense.deploy.convert import onnx as as_onnx
from plushsense.deploy.convert import tflite as as_tflite
from plushsense.deploy.package import emit
from plushsense.deploy.quantize import calibrated, integer_model, integer_network
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.integer import deployable
from plushsense.windows.features import InputUnits, Scaler, network_inputs
from support.exports import bundle_of
from support.requirements import installed

# symbol, filters, layout, settings: every padding and normalisation, one layer to four, one reflection and several.
NETS: list[tuple[str, tuple[int, ...], str, dict[str, Any]]] = [
    ("14d1_39d2_41d4", (8, 12, 16), "plush-15", {}),
    ("5", (3,), "accel-3", {"window": 40}),
    ("4d1_3d2_3d2_2d8", (4, 6, 8, 8), "phone-6", {"window": 60}),
    ("9d1_5d3", (5, 7), "accel-3", {"window": 60, "norm": "layer"}),
    ("9d1_5d3", (5, 7), "phone-6", {"window": 60, "padding": "mirror"}),
    ("1d1_26d2", (5, 6), "accel-3", {"window": 40, "padding": "mirror", "norm": "layer"}),
    ("1d1_26d4", (5, 6), "accel-3", {"window": 40, "padding": "mirror"}),
    ("9d1_5d3", (5, 7), "accel-3", {"window": 60, "padding": "causal", "norm": "layer"}),
    ("9d1_5d3", (5, 7), "plush-15", {"window": 60, "padding": "causal"}),
    ("9d1_5d3", (5, 7), "accel-3", {"window": 60, "norm": "none"}),
]
DEPLOYABLE = [net for net in NETS if net[3].get("padding") != "causal" and net[3].get("norm") != "layer"]


def made(net: tuple[str, tuple[int, ...], str, dict[str, Any]], seed: int = 1, **parts: Any) -> Bundle:
    symbol, filters, layout_name, settings = net
    layout, gestures = load_layout(layout_name), load_gestures("plush-18")
    arch = Arch.parse(symbol, filters, channels=layout.n_inputs, classes=7, **settings)
    rng = np.random.default_rng(seed)
    # Offsets of thousands and fractions, as real z-scores have.
    scaler = Scaler(rng.normal(size=arch.channels) * 5000, np.exp(-rng.uniform(1, 8, arch.channels)))
    parts = {"provenance": {"simulated": True}} | parts
    bundle = Bundle(arch, random_weights(arch, seed), layout, scaler, gestures.subset(gestures.labels[:7]), **parts)
    return calibrated(bundle, made_up_windows(bundle, 64)) if deployable(arch) else bundle


def others(bundle: Bundle, n: int = 20, seed: int = 5) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Windows that the converter did not try itself; the last is far outside anything seen."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.normal(size=(n, bundle.arch.channels, bundle.arch.span)), axis=2) / 4
    raw = np.rint(bundle.scaler.offset[:, None] + x / bundle.scaler.scale[:, None]).astype(np.int64)
    raw[-1] = np.where(rng.random(raw[-1].shape) < 0.5, -30000, 30000)
    return raw


def values(bundle: Bundle, raw: Any) -> Any:
    """Whole numbers as the values that a file reads, in the units of the layout."""
    return InputUnits.of(bundle.layout).values(raw)


def assert_floats(found: Any, bundle: Bundle, raw: Any) -> None:
    expected = bundle.network().forward(bundle.scaler.apply(raw))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * max(1.0, np.abs(expected).max()))
    assert np.abs(expected).max() > 0.1, "this network says nothing, so that anything would agree with it"


@pytest.mark.parametrize("net", NETS, ids=str)
def test_onnx_answers_as_the_network(net: Any, tmp_path: Path, onnx_here: None) -> None:
    bundle = made(net)
    done = convert(bundle, tmp_path / "new" / "model.onnx", "onnx")
    assert done.bytes == done.path.stat().st_size and done.path.name == "model.onnx"
    assert done.largest_difference is not None and done.largest_difference < 1e-3
    raw = others(bundle)
    assert_floats(as_onnx.run_model(done.path.read_bytes(), values(bundle, raw)), bundle, raw)
    assert [p.name for p in done.path.parent.iterdir()] == ["model.onnx"], "something was left behind"


@pytest.mark.parametrize("net", NETS, ids=str)
def test_litert_answers_as_the_network(net: Any, tmp_path: Path, litert_here: None) -> None:
    bundle = made(net)
    done = convert(bundle, tmp_path / "model.tflite", "tflite")
    assert done.largest_difference is not None and done.largest_difference < 1e-3
    raw = others(bundle)
    assert_floats(as_tflite.run_model(done.path.read_bytes(), values(bundle, raw)), bundle, raw)


@pytest.mark.parametrize("net", DEPLOYABLE, ids=str)
@pytest.mark.parametrize("name", ["onnx-int8", "tflite-int8"])
def test_int8_comes_close_to_the_integers(name: str, net: Any, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    request.getfixturevalue("onnx_here" if name == "onnx-int8" else "litert_here")
    bundle = made(net)
    if name == "tflite-int8" and bundle.arch.padding == "mirror":
        with pytest.raises(ArchError, match="take onnx, onnx-int8 or tflite"):
            convert(bundle, tmp_path / "m", name)
        return
    integer = integer_network(bundle)
    done = convert(bundle, tmp_path / "m", name)
    raw = others(bundle, 60)
    room = as_onnx if name == "onnx-int8" else as_tflite
    found, expected = room.run_model(done.path.read_bytes(), values(bundle, raw)), integer.forward(raw) / 256
    assert found is not None
    # A code that rounds the other way moves a logit by little; a wrong scale or shift by much.
    assert np.abs(found - expected).max() < 0.01 * max(1.0, np.abs(expected).max())
    assert (found.argmax(axis=1) == expected.argmax(axis=1)).mean() >= 0.95
    float_ones = bundle.network().forward(bundle.scaler.apply(raw))
    assert np.abs(found - expected).mean() < 0.2 * np.abs(float_ones - expected).mean(), "as far off as the floats are"
    assert done.bytes < len(bundle.to_bytes()) + 6000


@pytest.mark.parametrize("level", ["ORT_DISABLE_ALL", "ORT_ENABLE_BASIC", "ORT_ENABLE_EXTENDED", "ORT_ENABLE_ALL"])
def test_int8_answers_alike_in_the_sessions_that_others_open(level: str, onnx_here: None) -> None:
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.graph_optimization_level = getattr(onnxruntime.GraphOptimizationLevel, level)
    for bundle in (*map(made, DEPLOYABLE), bundle_of("plush-15", "v9_5d2", "4,6")):
        network, raw = integer_network(bundle), others(bundle, 60)[:-1]
        model = as_onnx.integer_model(bundle, network)
        session = onnxruntime.InferenceSession(model, settings, providers=["CPUExecutionProvider"])
        (found,) = session.run(["logits"], {"raw": values(bundle, raw)})
        expected = network.forward(raw) / 256
        assert np.abs(found - expected).max() < 0.01 * max(1.0, np.abs(expected).max()), bundle.arch.title


@pytest.mark.parametrize("symbol", ["9d1_5d2", "v9_5d2"])
def test_8_bit_weights_of_onnx_are_unsigned(symbol: str, onnx_here: None) -> None:
    """Pairs of uint8 times int8 saturate in 16 bits without VNNI, which a test sees on such processors only."""
    import onnx

    bundle = bundle_of("plush-15", symbol, "4,6")
    network = integer_network(bundle)
    graph = onnx.load_model_from_string(as_onnx.integer_model(bundle, network)).graph
    constants = {each.name: onnx.numpy_helper.to_array(each) for each in graph.initializer}
    read = {n.output[0]: [constants.get(name) for name in n.input] for n in graph.node if n.op_type[:3] == "Deq"}
    layers = [node for node in graph.node if node.op_type in ("Conv", "Gemm") and node.input[1] in read]
    for node, part in zip(layers, [*network.layers, network.dense], strict=True):
        codes, _, zeros = read[node.input[1]]
        assert codes is not None and codes.dtype == np.uint8 and set(zeros.tolist()) == {128}
        np.testing.assert_array_equal(codes.astype(int) - 128, part.weights)


@pytest.mark.parametrize("name", ["onnx", "onnx-int8"])
@pytest.mark.parametrize("symbol", ["9d1_5d2", "v9_5d2"])
def test_small_compilers_and_other_evaluators_can_read_the_graph(symbol: str, name: str, onnx_here: None) -> None:
    import onnx

    bundle = bundle_of("plush-15", symbol, "4,6")
    job = ConversionJob.of(bundle, None)
    model = onnx.load_model_from_string((as_onnx.to_onnx if name == "onnx" else as_onnx.to_integer_onnx)(job).data)
    assert model.opset_import[0].version == 13 and model.ir_version == 7
    kinds = [node.op_type for node in model.graph.node]
    assert kinds[kinds.index("Flatten") - 1] in ("GlobalAveragePool", "Concat")
    assert not {"ReduceMean", "ReduceSumSquare", "BatchNormalization"} & set(kinds)
    # Of 8-bit codes (N, F, T), OpenVINO 2026.4 has the mean of the first F windows only.
    before = {node.output[0]: node.op_type for node in model.graph.node}
    assert before[model.graph.node[kinds.index("GlobalAveragePool")].input[0]] != "DequantizeLinear"
    # Clip and the scales and zeros of QuantizeLinear take scalars: a shape (1,) is an axis of its own to some readers.
    rank = {each.name: len(each.dims) for each in model.graph.initializer}
    scalars = [n.input[1:] for n in model.graph.node if n.op_type in ("Clip", "QuantizeLinear")]
    assert {rank[part] for parts in scalars for part in parts} <= {0}


@pytest.mark.parametrize("net", [n for n in NETS if n[3]], ids=str)
def test_the_evaluator_of_onnx_gives_the_same_answers(net: Any, onnx_here: None) -> None:
    from onnx.reference import ReferenceEvaluator

    bundle = made(net)
    raw = others(bundle, 3)
    (found,) = ReferenceEvaluator(as_onnx.float_model(bundle)).run(["logits"], {"raw": values(bundle, raw)})
    assert_floats(found, bundle, raw)


def _reader(module: str) -> Any:
    installed(module, "readers")
    return importlib.import_module(module)


def _by_openvino(path: Path, x: Any) -> Any:
    openvino = _reader("openvino")
    # By itself it computes in bfloat16 on processors that can (docs/deploy.md).
    compiled = openvino.Core().compile_model(path, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return compiled({"raw": x})["logits"]


def _by_opencv(path: Path, x: Any) -> Any:
    cv2 = _reader("cv2")
    # Its new engine gives arbitrary numbers for a kernel of 9 taps (docs/deploy.md).
    net = cv2.dnn.readNetFromONNX(str(path), cv2.dnn.ENGINE_CLASSIC)
    rows = []
    for window in x:  # of a vector layer it refuses several at once
        net.setInput(window[None])
        rows.append(net.forward("logits")[0].copy())
    return np.stack(rows)


@pytest.mark.parametrize("reader", [_by_openvino, _by_opencv])
@pytest.mark.parametrize("symbol", ["9d1_5d2", "v9_5d2"])
def test_readers_of_others_give_the_answers_of_the_network(
    symbol: str, reader: Callable[[Path, Any], Any], tmp_path: Path, onnx_here: None
) -> None:
    """Of the files of an export."""
    bundle = bundle_of("plush-15", symbol, "4,6", window=60)
    out = emit(integer_model(bundle), bundle, tmp_path / "out", also=("onnx", "onnx-int8")).folder
    raw = others(bundle)[:-1]
    assert_floats(reader(out / "model.onnx", values(bundle, raw)), bundle, raw)
    expected = integer_network(bundle).forward(raw) / 256
    found = reader(out / "model.int8.onnx", values(bundle, raw))
    assert np.abs(found - expected).max() < 0.01 * max(1.0, np.abs(expected).max())


def test_onnxruntime_infers_the_shapes_of_vector_networks(onnx_here: None) -> None:
    """As the first step of its quantization, `quant_pre_process`, does."""
    pytest.importorskip("sympy")
    import onnx
    from onnxruntime.tools.symbolic_shape_infer import SymbolicShapeInference

    bundle = bundle_of("plush-15", "v9_5d2", "4,6")
    model = onnx.load_model_from_string(as_onnx.float_model(bundle))
    inferred = SymbolicShapeInference.infer_shapes(model, auto_merge=True)
    shapes = {each.name: each.type.tensor_type.shape.dim for each in inferred.graph.value_info}
    assert [d.dim_param or d.dim_value for d in shapes["pooled"]] == ["N", 2 * 6]


@pytest.mark.parametrize("layout", ["plush-15", "phone-6"])
def test_a_vector_layer_is_written_to_onnx_only(layout: str, tmp_path: Path, onnx_here: None) -> None:
    bundle = bundle_of(layout, "v9_5d2", "4,6")
    raw = others(bundle)[:-1]
    assert_floats(
        as_onnx.run_model(convert(bundle, tmp_path / "m", "onnx").path.read_bytes(), values(bundle, raw)), bundle, raw
    )
    found = as_onnx.run_model(convert(bundle, tmp_path / "n", "onnx-int8").path.read_bytes(), values(bundle, raw))
    expected = integer_network(bundle).forward(raw) / 256
    assert found is not None and np.abs(found - expected).max() < 0.01 * max(1.0, np.abs(expected).max())
    for name in ("tflite", "tflite-int8", "matlab"):
        with pytest.raises(ArchError, match="begins with a vector layer, which PlushSense does not write to"):
            convert(bundle, tmp_path / "o", name)


def test_deviations_are_written_to_onnx_only(tmp_path: Path, onnx_here: None) -> None:
    bundle = made(("9d1_5d3", (5, 7), "accel-3", {"window": 60, "pooling": "mean+deviation"}))
    raw = made_up_windows(bundle, 20)
    assert_floats(as_onnx.run_model(as_onnx.float_model(bundle), values(bundle, raw)), bundle, raw)
    network = integer_network(bundle)
    found, expected = (
        as_onnx.run_model(as_onnx.integer_model(bundle, network), values(bundle, raw)),
        network.forward(raw),
    )
    assert found is not None and np.abs(found - expected / 256).max() < 0.01 * max(1.0, np.abs(expected).max() / 256)
    for name in ("tflite", "tflite-int8", "matlab"):
        with pytest.raises(ArchError, match="has the pooling 'mean.deviation', which .* train it with --pooling mean"):
            convert(bundle, tmp_path / "o", name)


def test_real_windows(real_data: Path, onnx_here: None, litert_here: None) -> None:
    bundle = made(("14d1_19d2_19d4", (8, 12, 16), "accel-3", {}))
    stream = real_data / "makeability-gestures" / "P07" / "fulldatastream.csv"
    rows = network_inputs(read_stream(stream, bundle.layout).frames.values, bundle.layout)
    raw = np.stack([rows[at : at + bundle.arch.span].T for at in range(0, len(rows) - bundle.arch.span, 400)])
    assert len(raw) > 10
    fitted = Bundle(bundle.arch, bundle.weights, bundle.layout, Scaler.fit(raw), bundle.gestures)
    assert_floats(as_onnx.run_model(as_onnx.float_model(fitted), values(fitted, raw)), fitted, raw)
    assert_floats(as_tflite.run_model(as_tflite.float_model(fitted), values(fitted, raw)), fitted, raw)


# A force of which 512 is none and 4 are a newton, an acceleration in m/s² with an offset, and its magnitude.
UNITS = """
name = "units-4"
rate_hz = 50
channels = [
    { name = "force", unit = "N", kind = "force", offset = 512, scale = 0.25 },
    { name = "x", unit = "m/s²", kind = "acceleration", offset = 0.5, step = 0.01, valid_min = -99, valid_max = 99 },
    { name = "y", unit = "m/s²", kind = "acceleration", step = 0.01, valid_min = -99, valid_max = 99 },
]
wire = ["device_ms", "force", "x", "y"]
derived = [{ name = "size", kind = "magnitude", of = ["x", "y"] }]
inputs = ["force", "x", "size"]
"""


@pytest.mark.parametrize("name", ["onnx", "onnx-int8", "tflite", "tflite-int8"])
def test_a_file_reads_values_as_the_toy_sends_them(
    name: str, tmp_path: Path, onnx_here: None, litert_here: None
) -> None:
    (tmp_path / "units.toml").write_text(UNITS, encoding="utf-8")
    layout = load_layout(tmp_path / "units.toml")
    rng = np.random.default_rng(2)
    sent = np.cumsum(rng.normal(size=(20, 60, 3)), axis=1) * (20, 0.3, 0.3) + (600, 1, 9)
    sent = np.round(sent * (1, 100, 100)) / (1, 100, 100)
    raw = np.stack([network_inputs(np.rint(w * (1, 100, 100)).astype(np.int64), layout) for w in sent])
    raw = raw.transpose(0, 2, 1)
    arch = Arch.parse("5d1_3d2", (4, 5), channels=3, classes=5, window=40)
    gestures = load_gestures("plush-18")
    bundle = Bundle(arch, random_weights(arch, 3), layout, Scaler.fit(raw), gestures.subset(gestures.labels[:5]))
    bundle = calibrated(bundle, raw)
    size = np.sqrt((sent[:, :, 1] - 0.5) ** 2 + sent[:, :, 2] ** 2)
    given = np.stack([sent[:, :, 0], sent[:, :, 1], size], axis=1)[:, :, -arch.span :].astype(np.float32)
    data = convert(bundle, tmp_path / "m", name).path.read_bytes()
    found = (as_onnx if "onnx" in name else as_tflite).run_model(data, given)
    exact = (
        integer_network(bundle).forward(raw) / 256
        if "int8" in name
        else bundle.network().forward(bundle.scaler.apply(raw[:, :, -arch.span :]))
    )
    assert found is not None and np.abs(found - exact).max() < 0.02 * np.abs(exact).max()
    facts = describe(bundle, "")
    assert json.loads(facts["units"]) == ["raw: (value - 512) * 0.25 is in N", "m/s²", "m/s²"]
    assert "size is sqrt((x - 0.5)^2 + y^2)" in facts["input"]


def test_the_input_of_self_calibrated_and_vector_networks_is_named() -> None:
    calibrated_layout = replace(load_layout("phone-6").for_vectors(), self_calibration=("x_acc", "y_acc", "z_acc"))
    units = InputUnits.of(calibrated_layout)
    assert units.names == ("g",) * 3 + ("rad/s",) * 3 + ("g",) * 3
    assert units.steps.tolist() == [2048.0] * 3 + [1000.0] * 3 + [16 * 2048.0] * 3
    mixed = load_layout("phone-6")
    channels = (replace(mixed.channels[0], step=0.01), *mixed.channels[1:])
    derived = (Derived("size", "magnitude", ("x_acc", "y_acc")),)
    units = InputUnits.of(replace(mixed, channels=channels, derived=derived, inputs=("size", "x_gyro")))
    assert units.names == ("steps", "rad/s") and units.steps.tolist() == [16.0, 1000.0]


def test_a_converted_network_reads_calibrated_values() -> None:
    bundle = made(NETS[0])
    layout = replace(bundle.layout, self_calibration=bundle.layout.names)
    assert "self-calibrated values" in describe(replace(bundle, layout=layout), "")["input"]
    assert "self-calibration" not in describe(bundle, "")["input"]


def test_onnx_says_what_it_is(tmp_path: Path, onnx_here: None) -> None:
    import onnx

    bundle = made(NETS[0])
    model = onnx.load(convert(bundle, tmp_path / "m.onnx", "onnx").path)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert json.loads(metadata["channels"]) == list(bundle.layout.inputs)
    assert json.loads(metadata["gestures"]) == list(bundle.gestures.labels)
    assert metadata["layout"] == "plush-15" and metadata["title"] == bundle.arch.title
    assert json.loads(metadata["span"]) == bundle.arch.span and json.loads(metadata["simulated"]) is True
    shape = model.graph.input[0].type.tensor_type.shape.dim
    assert model.graph.input[0].name == "raw"
    assert metadata["input"] == model.graph.input[0].doc_string
    assert f"'raw', float32 (N, 11, {bundle.arch.span}), also for whole numbers" in metadata["input"]
    assert "acc_magnitude is sqrt(acc_x^2 + acc_y^2 + acc_z^2)" in metadata["input"]
    assert json.loads(metadata["units"]) == ["count"] * 11
    assert [d.dim_param or d.dim_value for d in shape] == ["N", 11, bundle.arch.span]


@pytest.mark.parametrize("name", ["tflite", "tflite-int8"])
def test_litert_says_what_it_is(name: str, tmp_path: Path, litert_here: None) -> None:
    from ai_edge_litert.interpreter import Interpreter
    from ai_edge_litert.schema_py_generated import Model, ModelT

    bundle = made(NETS[0])
    data = convert(bundle, tmp_path / "m", name).path.read_bytes()
    run = Interpreter(model_content=data, num_threads=1).get_signature_runner("serving_default")
    shapes = {n: part["shape"].tolist() for n, part in run.get_input_details().items()}
    assert shapes == {"raw": [1, bundle.arch.span, 11]}
    shapes = {n: part["shape"].tolist() for n, part in run.get_output_details().items()}
    assert shapes == {"logits": [1, 7], "probabilities": [1, 7]}
    model = ModelT.InitFromObj(Model.GetRootAs(data))
    assert data[4:8] == b"TFL3" and bundle.arch.title in model.description.decode()
    (entry,) = model.metadata
    facts = json.loads(bytes(model.buffers[entry.buffer].data))
    assert entry.name == b"plushsense" and facts["title"] == bundle.arch.title
    assert json.loads(facts["gestures"]) == list(bundle.gestures.labels)
    assert f"'raw', float32 (1, {bundle.arch.span}, 11), also for whole numbers" in facts["input"]
    assert facts["input"] in model.description.decode()
    # The schema has force_align: 16 for the data of buffers.
    read = Model.GetRootAs(data)
    starts = [read.Buffers(n)._tab.Vector(4) for n in range(1, read.BuffersLength())]
    assert len(starts) > 10 and {start % 16 for start in starts} == {0}


@pytest.mark.parametrize("name", ["tflite", "tflite-int8"])
def test_the_compiled_model_of_litert_gives_the_same_answers(name: str, tmp_path: Path, litert_here: None) -> None:
    from ai_edge_litert.compiled_model import CompiledModel

    bundle = made(NETS[1])
    done = convert(bundle, tmp_path / "m.tflite", name)
    given = values(bundle, others(bundle, 4))
    model = CompiledModel.from_file(str(done.path))
    inputs, outputs = model.create_input_buffers(0), model.create_output_buffers(0)
    found = []
    for window in given:
        inputs[0].write(np.ascontiguousarray(window.T[None]))
        model.run_by_index(0, inputs, outputs)
        found.append(outputs[0].read(7, np.float32))
    expected = as_tflite.run_model(done.path.read_bytes(), given)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=0.01 * np.abs(expected).max())


def softmax(logits: Any) -> Any:
    e = np.exp(logits - logits.max(axis=1, keepdims=True))
    return e / e.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("integers", [False, True])
def test_probabilities_are_the_softmax(integers: bool, onnx_here: None, litert_here: None) -> None:
    import onnxruntime
    from ai_edge_litert.interpreter import Interpreter

    bundle = made(NETS[1])
    raw = others(bundle, 4)
    parts = (bundle, integer_network(bundle)) if integers else (bundle,)
    to_onnx, to_tflite = (
        getattr(room, "integer_model" if integers else "float_model") for room in (as_onnx, as_tflite)
    )
    session = onnxruntime.InferenceSession(to_onnx(*parts), providers=["CPUExecutionProvider"])
    logits, found = session.run(["logits", "probabilities"], {"raw": values(bundle, raw)})
    np.testing.assert_allclose(found, softmax(logits), atol=1e-6)
    if not integers:
        np.testing.assert_allclose(found, bundle.network().probabilities(bundle.scaler.apply(raw)), atol=1e-5)
    run = Interpreter(model_content=to_tflite(*parts), num_threads=1).get_signature_runner("serving_default")
    answers = [run(raw=np.ascontiguousarray(row.T[None])) for row in values(bundle, raw)]
    logits, found = (np.concatenate([answer[name] for answer in answers]) for name in ("logits", "probabilities"))
    np.testing.assert_allclose(found, softmax(logits), atol=1e-5)


@pytest.mark.parametrize("name", ["onnx", "tflite"])
def test_the_same_bundle_gives_the_same_bytes(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    request.getfixturevalue("onnx_here" if name == "onnx" else "litert_here")
    one, two = (convert(made(NETS[2]), tmp_path / n, name).path.read_bytes() for n in "ab")
    assert one == two


def test_a_file_that_answers_otherwise_is_refused(tmp_path: Path, onnx_here: None) -> None:
    bundle = made(NETS[1])
    changed = dict(bundle.weights)
    changed["conv0.weight"] = changed["conv0.weight"].copy()
    changed["conv0.weight"][0, 0, 0] += 0.05
    other = Bundle(bundle.arch, changed, bundle.layout, bundle.scaler, bundle.gestures)
    job = ConversionJob.of(bundle, None)
    with pytest.raises(BundleError, match="gives other answers"):
        data = as_onnx.float_model(other)
        compared(job, data, as_onnx.run_model(data, job.values), "ONNX", ())


def test_given_windows_are_tried_too(tmp_path: Path, onnx_here: None) -> None:
    bundle = made(NETS[1])
    given = others(bundle, 6)
    longer = np.concatenate([given[:, :, :3], given], axis=2)
    done = convert(bundle, tmp_path / "m", "onnx", windows=longer)
    assert "6 given and 24 made-up windows" in done.notes[0]
    with pytest.raises(BadInput, match="do not fit"):
        convert(bundle, tmp_path / "n", "onnx", windows=given[:, :2])


def test_neither_pytorch_nor_tensorflow_is_loaded(tmp_path: Path, onnx_here: None, litert_here: None) -> None:
    path = made(NETS[1]).save(tmp_path / "m.plush")
    code = (
        "import sys; from plushsense.models.bundle import Bundle; from plushsense.deploy.convert import convert\n"
        f"b = Bundle.load({str(path)!r}); convert(b, {str(tmp_path / 'o')!r}, 'onnx')\n"
        f"convert(b, {str(tmp_path / 't')!r}, 'tflite')\n"
        "print([m for m in ('torch', 'tensorflow') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_unknown_format_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"Unknown format 'tflit'.*Did you mean 'tflite'\?"):
        convert(made(NETS[1]), tmp_path / "m", "tflit")


@pytest.mark.parametrize(("name", "module"), [("onnx", "onnx"), ("tflite", "ai_edge_litert.schema_py_generated")])
def test_a_missing_package_says_how_to_install_it(
    name: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'plushsense\[{name}\]'"):
        convert(made(NETS[1]), tmp_path / "m", name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["onnx-int8", "tflite-int8"])
def test_int8_refuses_what_has_no_whole_numbers(name: str, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="holds no calibration"):
        convert(replace(made(NETS[1]), calibration={}), tmp_path / "m", name)
    with pytest.raises(ArchError, match="padding 'causal'"):
        convert(made(NETS[-2]), tmp_path / "m", name)
    assert not list(tmp_path.iterdir())


def forward_in_matlab(file: Path, window: Any) -> Any:
    """The probabilities (K,) that layers of MATLAB with the properties in ``file`` give for a window (T, C)."""
    parts = read_mat(file, file.name)
    z = (window - parts["input"]["Mean"].T) / parts["input"]["StandardDeviation"].T
    for i in itertools.count(1):
        if f"convolution{i}" not in parts:
            break
        layer = parts[f"convolution{i}"]
        weights, dilation = layer["Weights"].astype(float), int(layer["DilationFactor"].item())
        past = (len(weights) - 1) * dilation
        if layer.get("Padding") == ["causal"]:
            mirrored = layer["PaddingValue"] == ["symmetric-exclude-edge"]
            z = np.pad(z, ((past, 0), (0, 0)), mode="reflect" if mirrored else "constant")
        taps = [z[k * dilation : len(z) - past + k * dilation] @ of for k, of in enumerate(weights)]
        z = np.maximum(np.sum(taps, axis=0) + layer["Bias"], 0)
        for kind in ("layer", "batch"):
            norm = parts.get(f"{kind}norm{i}")
            if norm is not None:
                mean = z.mean(axis=1, keepdims=True) if kind == "layer" else norm["TrainedMean"].T
                var = z.var(axis=1, keepdims=True) if kind == "layer" else norm["TrainedVariance"].T
                z = (z - mean) / np.sqrt(var + norm["Epsilon"]) * norm["Scale"].T + norm["Offset"].T
    logits = parts["fc"]["Weights"] @ z.mean(axis=0)[:, None] + parts["fc"]["Bias"]
    return softmax(logits.T)[0]


@pytest.mark.parametrize("net", NETS, ids=str)
def test_weights_for_matlab_give_the_answers_of_the_network(net: Any, tmp_path: Path) -> None:
    pytest.importorskip("scipy")
    bundle = made(net)
    done = convert(bundle, tmp_path / "model.mat", "matlab")
    raw = others(bundle, 4)
    found = [forward_in_matlab(done.path, window.T) for window in values(bundle, raw)]
    np.testing.assert_allclose(found, bundle.network().probabilities(bundle.scaler.apply(raw)), atol=1e-5)
    assert convert(bundle, tmp_path / "again.mat", "matlab").path.read_bytes() == done.path.read_bytes()
    assert texts_of(read_mat(done.path, "model.mat")["c"]) == list(bundle.gestures.labels)
