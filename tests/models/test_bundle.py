"""The model file: everything comes back, and no damaged file passes for a model."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from plushsense.core.errors import BundleError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.models import bundle as room
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle, known_people
from plushsense.models.reference import random_weights
from plushsense.windows.features import Scaler
from support.bundles import contents, signed


def make(**changes: Any) -> Bundle:
    gestures = load_gestures("plush-18")
    arch = Arch.parse("3d1_2d2", (3, 4), channels=3, classes=5, window=20)
    parts: dict[str, Any] = {
        "arch": arch,
        "weights": random_weights(arch, 1),
        "layout": load_layout("accel-3"),
        "scaler": Scaler(np.array([1.0, 2.0, 3.0]), np.array([0.1, 1 / 3, 1e-7])),
        "gestures": gestures.subset(gestures.labels[:5]),
        "windowing": {"window_s": 2.5, "step_s": 0.5, "context": "stream"},
        "decision": {"smoothing_s": 0.3},
        "provenance": {"subjects": ("p1", "pä"), "scores": {"macro_f1": np.float64(0.5)}, "data": "ab12"},
    }
    return Bundle(**(parts | changes))


def test_everything_comes_back(tmp_path: Path) -> None:
    made = make()
    path = made.save(tmp_path / "new folder" / "m.plush")
    read = Bundle.load(path)
    assert read.arch == made.arch
    assert read.layout == made.layout
    assert read.gestures == made.gestures
    assert read.scaler.offset.tolist() == made.scaler.offset.tolist()
    assert read.scaler.scale.tolist() == made.scaler.scale.tolist()
    assert read.windowing == made.windowing and read.decision == made.decision
    assert read.provenance == {"subjects": ["p1", "pä"], "scores": {"macro_f1": 0.5}, "data": "ab12"}
    x = np.random.default_rng(0).normal(size=(2, 3, 40))
    np.testing.assert_array_equal(read.network().forward(x), made.network().forward(x))
    assert [p.name for p in path.parent.iterdir()] == ["m.plush"], "a temporary file stayed behind"
    assert len(repr(read)) < 120


def test_a_layout_that_calibrates_itself_comes_back(tmp_path: Path) -> None:
    plush = load_layout("plush-15")
    layout = dataclasses.replace(plush, self_calibration=plush.names)
    arch = Arch.parse("3d1_2d2", (3, 4), channels=layout.n_inputs, classes=5, window=20)
    scaler = Scaler(np.zeros(arch.channels), np.ones(arch.channels))
    made = make(arch=arch, weights=random_weights(arch, 1), layout=layout, scaler=scaler)
    read = Bundle.load(made.save(tmp_path / "m.plush"))
    assert read.layout == layout and len(read.layout.calibrated_sensors) == 11


def test_the_same_bundle_gives_the_same_bytes(tmp_path: Path) -> None:
    one = make().save(tmp_path / "a.plush").read_bytes()
    assert make().save(tmp_path / "b.plush").read_bytes() == one
    assert Bundle.load(tmp_path / "a.plush").save(tmp_path / "c.plush").read_bytes() == one


def test_a_calibration_comes_back_and_a_bundle_without_one_is_written_as_before(tmp_path: Path) -> None:
    before = make().save(tmp_path / "before.plush")
    assert b"calibration" not in before.read_bytes(), "bundles of before have no such key"
    assert Bundle.load(before).calibration == {}
    kept = {"low": [0.1 + 0.2, -1e-300], "tops": [[1 / 3]]}
    made = make(calibration=kept).save(tmp_path / "m.plush")
    assert Bundle.load(made).calibration == kept, "to the last bit"
    assert Bundle.load(made).save(tmp_path / "again.plush").read_bytes() == made.read_bytes()


@pytest.mark.slow
def test_every_flipped_byte_is_noticed(tmp_path: Path) -> None:
    path = make().save(tmp_path / "m.plush")
    good = path.read_bytes()
    rng = np.random.default_rng(1)
    header = 8 + int.from_bytes(good[:8], "little")
    for at in [*range(0, header, 7), *rng.integers(header, len(good), 200)]:
        bad = bytearray(good)
        bad[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(bad))
        with pytest.raises(BundleError) as caught:
            Bundle.load(path)
        assert str(path) in str(caught.value)
    path.write_bytes(good)
    Bundle.load(path)


@pytest.mark.parametrize("part", [0.0, 0.0005, 0.02, 0.5, 0.99, 0.9999])
def test_a_cut_file_is_noticed(tmp_path: Path, part: float) -> None:
    path = make().save(tmp_path / "m.plush")
    good = path.read_bytes()
    path.write_bytes(good[: int(part * len(good))])
    with pytest.raises(BundleError, match=r"damaged|is empty|not a PlushSense bundle"):
        Bundle.load(path)
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(BundleError, match="damaged"):
        Bundle.load(path)


@pytest.mark.parametrize(
    "content",
    [
        b"PK\x03\x04 a zip of some length that is not ours",
        b"cap;1;2\n" * 50,
        b"\x80\x04\x95pickle" * 9,
        b"{}" * 30,
    ],
)
def test_a_file_of_another_kind_is_not_a_bundle(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.plush"
    path.write_bytes(content)
    with pytest.raises(BundleError, match="is not a PlushSense bundle"):
        Bundle.load(path)


def test_safetensors_of_something_else_is_not_a_bundle(tmp_path: Path) -> None:
    path = tmp_path / "x.plush"
    path.write_bytes(save({"a": np.zeros(3)}))
    with pytest.raises(BundleError, match="is not a PlushSense bundle"):
        Bundle.load(path)


def test_missing_and_unreadable_and_unwritable(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="There is no bundle"):
        Bundle.load(tmp_path / "none.plush")
    with pytest.raises(BundleError, match="is a folder: give"):
        Bundle.load(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BundleError, match="cannot be written"):
        make().save(tmp_path / "file" / "m.plush")


def test_another_version_says_which(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.plush"
    with monkeypatch.context() as future:
        future.setattr(room, "VERSION", 2)
        make().save(path)
    with pytest.raises(BundleError, match="version 2; this PlushSense reads 1"):
        Bundle.load(path)


def test_a_bundle_of_other_rules_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.plush"
    with monkeypatch.context() as past:
        past.setattr(Bundle, "_implied", lambda self: {"span": 7})
        make().save(path)
    with pytest.raises(BundleError, match="written under other rules"):
        Bundle.load(path)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make().save(tmp_path / "m.plush")
    before = path.read_bytes()

    for failure, seen in ((OSError("no space left"), BundleError), (KeyboardInterrupt(), KeyboardInterrupt)):

        def fails(*_: object, failure: BaseException = failure) -> None:
            raise failure

        monkeypatch.setattr(os, "replace", fails)
        with pytest.raises(seen):
            make(provenance={"other": 1}).save(path)
        assert path.read_bytes() == before
        assert [p.name for p in tmp_path.iterdir()] == ["m.plush"]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"layout": load_layout("plush-15")}, "11 inputs in the layout, the network needs 3"),
        ({"scaler": Scaler(np.zeros(2), np.ones(3))}, "2 offsets"),
        ({"scaler": Scaler(np.zeros(3), np.array([1.0, np.inf, 1.0]))}, "not finite"),
        ({"gestures": load_gestures("plush-18")}, "18 gestures in the set, the network needs 5"),
        ({"weights": {}}, "weights lack 'conv0.weight'"),
    ],
)
def test_parts_that_do_not_fit_each_other(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(BundleError, match=why):
        make(**changes)


def test_provenance_is_plain_values(tmp_path: Path) -> None:
    odd = {"f1": float("nan"), 3: np.int64(4), "where": Path("x"), "set": {"b", "a"}, "a": np.arange(2)}
    read = Bundle.load(make(provenance=odd).save(tmp_path / "m.plush"))
    assert read.provenance == {"f1": None, "3": 4, "where": "x", "set": ["a", "b"], "a": [0, 1]}
    json.dumps(read.provenance)
    with pytest.raises(BundleError, match="plain values only"):
        make(provenance={"x": object()}).save(tmp_path / "n.plush")
    with pytest.raises(dataclasses.FrozenInstanceError):
        make().arch = None  # type: ignore[misc, assignment]


def deep(levels: int) -> list[Any]:
    return [deep(levels - 1)] if levels else []


DENSE = {"dense.weight": np.zeros((5, 4)).tolist(), "dense.bias": [0.0] * 5}


@pytest.mark.parametrize(
    ("where", "value"),
    [
        *(
            (name, value)
            for name in ("decision", "provenance", "windowing", "layout", "personal")
            for value in (1.5, [])
        ),
        ("provenance.scores", [0.5]),
        ("provenance.scores.accuracy", "high"),
        ("provenance.subjects", {"P1": 1}),
        ("provenance.training", "loso"),
        ("windowing.window_s", "2.5"),
        ("windowing.anywhere", {"every_s": []}),
        ("layout.name", "half \ud800"),
        ("layout.gap_ms", 0),
        ("layout.gap_ms", 10**9),
        ("scaling.scale", [0.0, 0.1, 0.1]),
        ("scaling.scale", [-1.0, 0.1, 0.1]),
        ("scaling.scale", [1e300, 0.1, 0.1]),
        ("scaling.offset", [1e300, 0.0, 0.0]),
        ("scaling.offset", [10**400, 0.0, 0.0]),
        ("personal", {"original": {"dense.weight": [[1.0]], "dense.bias": [1.0]}}),
        ("personal", {"original": {"dense.bias": [0.0] * 5}}),
        ("personal", {"subject": 7, "original": DENSE}),
        ("provenance.seed", 1 << 64),
        ("provenance.deep", deep(40)),
        ("windowing.span_s", 1e300),
        ("calibration", {"low": [1e308] * 3}),
        ("arch", {**make().arch.to_dict(), "arch": "4096d4096_2d2"}),
    ],
)
@pytest.mark.slow
def test_values_out_of_range_are_refused_at_load(where: str, value: object) -> None:
    content, weights = contents(make().to_bytes())
    table, *more = where.split(".")
    inner = content
    for step in (table, *more)[:-1]:
        inner = inner[step]
    inner[(table, *more)[-1]] = value
    content["clock"]["gap_ms"] = content["layout"]["gap_ms"] if isinstance(content["layout"], dict) else 100
    with pytest.raises(BundleError):
        Bundle.from_bytes(signed(content, weights))


def test_an_earlier_layer_that_fits_is_accepted() -> None:
    content, weights = contents(make().to_bytes())
    content["personal"] = {"subject": "S1", "original": DENSE}
    assert Bundle.from_bytes(signed(content, weights)).adapted_to == "S1"


def test_a_text_that_json_cannot_hold_twice_is_no_bundle() -> None:
    """Numbers that are not finite, and tables nested nearly as deep as Python reads, with any checksum."""
    _, weights = contents(make().to_bytes())
    nested = "[" * 900 + "]" * 900
    for content in ('{"a":NaN}', '{"a":1e999}', f'{{"a":{nested}}}', "[]", "3"):
        text = f'{{"format":"{room.FORMAT}","version":1,"sha256":"0","content":{content}}}'
        with pytest.raises(BundleError, match="damaged"):
            Bundle.from_bytes(bytes(save(weights, metadata={"plushsense": text})))


@pytest.mark.parametrize(
    ("weight", "why"),
    [
        (np.zeros((5, 4)), "are of float64: accepted is float32"),
        (np.full((5, 4), 1e30, np.float32), "beyond ±1e"),
    ],
)
def test_tensors_are_of_one_type_and_size(weight: Any, why: str) -> None:
    content, weights = contents(make().to_bytes())
    with pytest.raises(BundleError, match=why):
        Bundle.from_bytes(signed(content, {**weights, "dense.weight": weight}))


def test_a_network_that_takes_too_much_to_run_is_refused() -> None:
    layout = load_layout("accel-3")
    for symbol, settings, why in (
        ("4096d4096", {}, "numbers at once"),
        ("4096", {"padding": "mirror", "window": 60_000}, "numbers at once"),
        ("3d1", {"pool": 1_000_000, "step": 1}, None),
        ("300", {"padding": "mirror", "window": 20_000}, None),
        ("300", {"padding": "mirror", "window": 20_000, "gap_ms": 60_000, "step": 1}, "of a gap"),
    ):
        toy = dataclasses.replace(layout, gap_ms=settings.pop("gap_ms", layout.gap_ms))
        arch = Arch.parse(symbol, (1,), channels=3, classes=5, **settings)
        weights = {name: np.zeros(shape, np.float32) for name, shape in arch.weight_shapes.items()}
        if why is None:
            make(arch=arch, weights=weights, layout=toy)
            continue
        with pytest.raises(BundleError, match=why):
            make(arch=arch, weights=weights, layout=toy)


def test_people_are_codes_or_a_number() -> None:
    assert known_people({"subjects": ["a", "none"], "validation_subjects": ["b"]}) == {"a", "b"}
    assert known_people({"subjects": ["a"], "validation_subjects": ["b"]}, ["validation_subjects"]) == {"b"}
    assert known_people({"subjects": 3, "validation_subjects": 2}) == set()
