"""``plushsense export`` and `plushsense.export`: from a bundle to a folder, and every refusal in one sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plushsense as ps
from plushsense.cli.main import main
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.deploy.quantize import calibrated
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.windows.features import Scaler


def bundle_of(**changes: str) -> Bundle:
    arch = Arch.parse("5d1_4d3", "4,6", channels=3, classes=18, window=48, **changes)
    scaler = Scaler(np.array([0.0, 5.0, 10.0]), np.array([0.01, 0.02, 0.03]))
    return Bundle(arch, random_weights(arch, 1), load_layout("accel-3"), scaler, load_gestures("plush-18"))


@pytest.fixture()
def bundle() -> Bundle:
    x = np.random.default_rng(1).normal(scale=80, size=(9, 3, 60)).round().astype(np.int64)
    return calibrated(bundle_of(), x)


def test_the_verb(tmp_path: Path, bundle: Bundle, capsys: pytest.CaptureFixture[str]) -> None:
    bundle.save(tmp_path / "m.plush")
    assert main(["export", str(tmp_path / "m.plush"), str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {"files", "flash_bytes", "ram_bytes"} <= set(told)
    assert all((tmp_path / "out" / name).is_file() for name in told["files"])
    assert main(["export", str(tmp_path / "m.plush"), str(tmp_path / "out")]) == 2
    assert "already holds something" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "m.plush"), str(tmp_path / "two")]) == 0
    assert "plushsense verify" in capsys.readouterr().out


def test_a_name_and_a_version_from_the_command_line(
    tmp_path: Path, bundle: Bundle, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle.save(tmp_path / "m.plush")
    words = ["export", str(tmp_path / "m.plush"), str(tmp_path / "out")]
    own = ["--name", "ears", "--model-version", "1.2.0", "--url", "https://example.org/toy"]
    assert main([*words, *own, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["name"], told["model_version"], told["url"]) == ("ears", "1.2.0", "https://example.org/toy")
    assert {"ears_plushsense.c", "arduino/ears_plush/library.properties"} <= set(told["files"])
    for option, value in zip(own[::2], own[1::2], strict=True):
        assert main([*words, "--patch-for", str(tmp_path / "out"), option, value]) == 2
        assert f"{option} is for a whole export" in capsys.readouterr().err


def test_it_tells_how_many_people_also_when_it_is_exported_again(tmp_path: Path, bundle: Bundle) -> None:
    who = {"subjects": ["Anna", "P02"], "validation_subjects": ["Bo"], "split": "validation-subjects"}
    ps.export(replace(bundle, provenance=who), tmp_path / "one")
    ps.export(tmp_path / "one" / "model.plush", tmp_path / "two")
    for name in ("one", "two"):
        facts = json.loads((tmp_path / name / "export.json").read_text(encoding="utf-8"))
        for told in (facts["provenance"], ps.load(tmp_path / name / "model.plush").provenance):
            assert (told["subjects"], told["validation_subjects"]) == (2, 1)


def test_the_same_bundle_gives_the_same_files(tmp_path: Path, bundle: Bundle) -> None:
    one, two = ps.export(bundle, tmp_path / "one"), ps.export(bundle, tmp_path / "two")
    assert one.files == two.files
    for name in one.files:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"padding": "causal"}, "train --arch 5d1_4d3 --filters 4,6 --padding stream, and export that"),
        ({"padding": "mirror"}, "train --arch 5d1_4d3 --filters 4,6 --padding stream, and export that"),
        ({"padding": "mirror", "norm": "layer"}, "--padding stream --norm batch, and export that"),
        ({"norm": "layer"}, "train 5d1_4d3 with --norm batch"),
    ],
)
def test_what_cannot_be_deployed(
    changes: dict[str, str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle_of(**changes).save(tmp_path / "m.plush")
    assert main(["export", str(tmp_path / "m.plush"), str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_export_says_of_how_many_people(tmp_path: Path, bundle: Bundle) -> None:
    origin = {"subjects": ["Anna", "Bo"], "validation_subjects": ["Cleo"], "scores": {"accuracy": 0.5, "macro_f1": 0.4}}
    done = ps.export(replace(bundle, provenance=origin), tmp_path / "out")
    assert (done.facts.provenance["subjects"], done.facts.provenance["validation_subjects"]) == (2, 1)
    said = (tmp_path / "out" / "README.md").read_text(encoding="utf-8")
    assert "| trained on | 2 people |" in said and "of 1 other people" in said and "Anna" not in said


def test_without_calibration(tmp_path: Path, bundle: Bundle, capsys: pytest.CaptureFixture[str]) -> None:
    replace(bundle, calibration={}).save(tmp_path / "m.plush")
    assert main(["export", str(tmp_path / "m.plush"), str(tmp_path / "out")]) == 2
    assert "--dataset" in capsys.readouterr().err


def test_other_formats(tmp_path: Path, bundle: Bundle, onnx_here: None, capsys: pytest.CaptureFixture[str]) -> None:
    bundle.save(tmp_path / "m.plush")
    assert main(["export", str(tmp_path / "m.plush"), str(tmp_path / "out"), "--also", "onnx, onnx-int8"]) == 0
    assert "model.onnx" in capsys.readouterr().out
    facts = json.loads((tmp_path / "out" / "export.json").read_text())
    assert facts["conversions"]["onnx"]["largest_difference"] < 1e-3
    assert {"model.onnx", "model.int8.onnx"} <= set(facts["files"])
    said = (tmp_path / "out" / "README.md").read_text(encoding="utf-8")
    assert "`model.onnx`" in said and "`--also onnx-int8`" in said
    assert said.count("Input 'raw', float32 (N, ") == 2
    assert main(["export", str(tmp_path / "m.plush"), str(tmp_path / "two"), "--also", "onx"]) == 2
    assert "Did you mean 'onnx'" in capsys.readouterr().err
    assert not (tmp_path / "two").exists()


def adapted(bundle: Bundle) -> Bundle:
    weights = {**bundle.weights, "dense.bias": bundle.weights["dense.bias"] + np.float32(0.5)}
    return replace(bundle, weights=weights, personal={"subject": "Anna", "original": {}})


def test_a_patch(tmp_path: Path, bundle: Bundle, capsys: pytest.CaptureFixture[str]) -> None:
    ps.export(bundle, tmp_path / "out")
    adapted(bundle).save(tmp_path / "mine.plush")
    words = [
        "export",
        str(tmp_path / "mine.plush"),
        str(tmp_path / "new" / "p.bin"),
        "--patch-for",
        str(tmp_path / "out"),
    ]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    patch, image = Path(told["patch"]).read_bytes(), (tmp_path / "out" / "plush_model.bin").read_bytes()
    assert len(patch) == told["bytes"] == 20 + 18 * (8 + 6) and b"Anna" not in patch
    assert told["image_check"] == int.from_bytes(image[12:16], "little")
    ps.export(adapted(bundle), tmp_path / "two")
    assert patch[20:] in (tmp_path / "two" / "plush_model.bin").read_bytes()
    assert main(words) == 2
    assert "nothing is overwritten" in capsys.readouterr().err
    assert Path(told["patch"]).read_bytes() == patch
    words[2] = str(tmp_path / "q.bin")
    assert main(words) == 0
    assert capsys.readouterr().out == f"{words[2]}: 272 bytes, for plush_patch on a toy with {words[4]}\n"


def test_what_cannot_be_a_patch(tmp_path: Path, bundle: Bundle, capsys: pytest.CaptureFixture[str]) -> None:
    out, bad, none = (tmp_path / name for name in ("out", "bad", "none"))
    ps.export(bundle, out)
    ps.export(bundle, bad)
    (bad / "plush_model.bin").write_bytes(b"PLSH")
    ps.export(bundle, none)
    (none / "plush_model.bin").unlink()
    (tmp_path / "file").touch()
    other = replace(bundle, calibration=calibrated(bundle, np.arange(9 * 3 * 60).reshape(9, 3, 60)).calibration)
    cases = [
        (adapted(bundle), tmp_path, "p.bin", "is no export"),
        (adapted(bundle), tmp_path / "nowhere", "p.bin", "There is no export"),
        (adapted(bundle), bad, "p.bin", "damaged, or of another version"),
        (adapted(bundle), none, "p.bin", "cannot be read"),
        (adapted(bundle), out, "out", "is already there"),
        (adapted(bundle), out, "file/p.bin", "cannot be written"),
        (bundle, out, "p.bin", "was not adapted to anybody"),
        (adapted(other), out, "p.bin", "in more than the dense layer"),
        (adapted(bundle_of()), out, "p.bin", "holds no calibration"),
    ]
    for given, folder, name, said in cases:
        given.save(tmp_path / "m.plush")
        words = ["export", str(tmp_path / "m.plush"), str(tmp_path / name), "--patch-for", str(folder)]
        assert main(words) == 2
        told = capsys.readouterr().err
        assert said in told and told.count("\n") == 1, told
        assert not (tmp_path / "p.bin").exists()
    assert main([*words, "--also", "onnx"]) == 2
    assert "leave out --patch-for" in capsys.readouterr().err
