"""``plushsense protocol``: the files it writes, what they say, and what it refuses."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from plushsense.cli.main import main
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.experiments.protocol.score import NOTES
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.recording.simulate import SimulationSpec, simulate
from plushsense.windows.features import Scaler
from support.real_times import copied_as_if_real

pytestmark = pytest.mark.apart("trainings")


def bundle(**provenance):
    layout = load_layout("plush-15")
    arch = Arch.parse("5d1_4d2", (4, 4), channels=layout.n_inputs, classes=18, padding="stream", window=40, step=20)
    return Bundle(
        arch, random_weights(arch, 2), layout, Scaler(np.zeros(11), np.full(11, 1e-3)), load_gestures("plush-18"),
        provenance=provenance,
    )  # fmt: skip


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    made = bundle(simulated=True, dataset="sim", subjects=["P01", "P02"], validation_subjects=["P03"])
    return str(made.save(tmp_path_factory.mktemp("protocol") / "m.plush"))


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Two people's folders as a recorder leaves them, of a virtual toy."""
    folder = tmp_path_factory.mktemp("sessions") / "raw"
    simulate(
        folder, SimulationSpec(people=2, seed=9, repetitions=1, at_rest=0, gestures=("Back stroke 1", "Tail hit 1"))
    )
    return folder


def said(capsys, *words):
    status = main(["protocol", *map(str, words)])
    out, err = capsys.readouterr()
    return status, out, err


def test_five_strangers_three_systems_one_page(capsys, model, tmp_path):
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    words = ("--model", model, "--people", 2, "--repetitions", 1, "--no-rules", "--out", out)
    status, text, err = said(capsys, *words, "--json")
    assert status == 0, err
    result = json.loads(text)
    assert result["simulated"] is True
    assert (result["trials"], result["gestures"], len(result["people"])) == (34, 17, 2)
    assert {NOTES["no_gate"], NOTES["no_rules"]} <= set(result["said"])
    assert {row["system"] for row in result["rows"]} == {"cnn"}
    page = (out / "protocol.html").read_text(encoding="utf-8")
    assert "This is a simulation." in page
    assert "SIMULATED" in page.split("</h1>")[0]
    assert "≈ 0.83" in page
    assert NOTES["no_gate"] in page
    for name, rows in (("trials.csv", 34), ("table.csv", 7 + 17)):
        with (out / name).open(encoding="utf-8", newline="") as file:
            table = list(csv.DictReader(file))
        assert len(table) == rows
        assert {row["simulated"] for row in table} == {"yes"}
    assert json.loads((out / "protocol.json").read_text(encoding="utf-8"))["rows"] == result["rows"]
    # Again into the same folder; the same seed gives the same figures.
    status, text, err = said(capsys, *words)
    assert status == 0, err
    assert text.splitlines()[1].startswith("SIMULATION")
    assert json.loads((out / "protocol.json").read_text(encoding="utf-8"))["outcomes"] == result["outcomes"]
    # A row of the report and the text say the same.
    shown = next(row for row in result["rows"] if row["group"] == "fine")
    assert f"({shown['activated']}/{shown['trials']})" in next(x for x in text.splitlines() if x.startswith("Fine"))


def test_recorded_sessions_give_the_same_table_under_their_own_heading(capsys, sessions, tmp_path):
    stranger = str(bundle(simulated=False, dataset="elsewhere", subjects=["A"]).save(tmp_path / "m.plush"))
    status, text, err = said(capsys, "--model", stranger, "--session", sessions, "--json")
    assert status == 0, err
    result = json.loads(text)
    assert result["heading"].startswith("The paper's real-time protocol on recorded sessions of a simulation: raw")
    assert (result["trials"], result["people"]) == (4, ["P01", "P02"])
    assert any("nobody is left to tune the rule baseline on" in sentence for sentence in result["said"])
    real = copied_as_if_real(sessions, tmp_path / "real" / "raw")
    (real / "P02" / "fulldatastream.csv").unlink()
    status, text, err = said(capsys, "--model", stranger, "--session", real, "--json")
    result = json.loads(text)
    assert result["heading"] == "The paper's real-time protocol on recorded sessions: raw"
    assert result["simulated"] is False
    assert result["people"] == ["P01"]
    assert "P02 has no session stream, only single recordings, and was left out." in result["said"]


def test_a_network_that_may_have_met_them_is_told(capsys, sessions, tmp_path):
    for more in ({"subjects": ["P01"]}, {"subjects": ["A"], "validation_subjects": ["P01"]}):
        path = bundle(simulated=False, dataset="elsewhere", **more).save(tmp_path / "m.plush")
        status, text, _ = said(capsys, "--model", path, "--session", sessions, "--no-rules", "--json")
        assert status == 0 and any("of the codes P01: if they are the same" in s for s in json.loads(text)["said"])
    own = replace(bundle(simulated=False, dataset="elsewhere", subjects=["A"]), personal={"subject": "P02"})
    status, text, _ = said(
        capsys, "--model", own.save(tmp_path / "p.plush"), "--session", sessions, "--no-rules", "--json"
    )
    result = json.loads(text)
    assert status == 0 and any("of the codes P02: if they are the same" in s for s in result["said"])
    assert "codes" not in result
    export = bundle(simulated=False, dataset="elsewhere", subjects=20, validation_subjects=4).save(tmp_path / "e.plush")
    status, text, err = said(capsys, "--model", export, "--session", sessions, "--no-rules", "--json")
    assert status == 0, err
    assert any("does not say on whom it was trained" in s for s in json.loads(text)["said"])
    assert ["Trained on", "elsewhere, 20 people"] in json.loads(text)["about"]


def test_the_old_rules_are_tuned_on_people_who_are_not_scored(capsys, sessions, tmp_path):
    stranger = str(bundle(simulated=False, dataset="elsewhere", subjects=["A"]).save(tmp_path / "m.plush"))
    status, text, err = said(capsys, "--model", stranger, "--session", sessions, "--subjects", "P02", "--json")
    assert status == 0, err
    result = json.loads(text)
    assert ["Rule baseline", "Tuned on people who are not scored here: 1."] in result["about"]
    rows = {(row["group"], row["system"]): row for row in result["rows"]}
    assert rows["energetic", "rules"]["activated"] == 1, "an abrupt blow is what they are for"
    assert rows["energetic", "rules"]["named"] == 0


def test_virtual_rules_are_tuned_on_another_population():
    from plushsense.experiments.protocol.run_protocol import virtual_rules
    from plushsense.experiments.protocol.sittings import virtual_sittings

    layout, gestures = load_layout("plush-15"), load_gestures("plush-18")
    ask, tuned = virtual_rules(1, layout, gestures, people=1)
    assert tuned == "Tuned on 1 other virtual people, of another population."
    sitting = virtual_sittings([1001], 1, 2, layout, gestures=("Tail hit 2",))[0].play()
    begun = [e for e in ask(sitting.frames) if e.kind == "begun" and e.affect == "negative"]
    for trial in sitting.trials:
        assert any(-0.02 <= e.t_s - trial.onset_s < 0.2 for e in begun)


def test_what_does_not_fit_is_one_sentence(capsys, model, sessions, tmp_path):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "thesis.txt").write_text("mine", encoding="utf-8")
    for words, expected in (
        (("--first", 2), "Virtual person 2 is one of the 3"),
        (("--people", 0), "people is 0"),
        (("--repetitions", 0), "repetitions is 0"),
        (("--seed", -1), "seed is -1"),
        (("--subjects", "P01"), "Subjects are people of a data set or session"),
        (("--dataset", tmp_path / "no"), "There is no folder"),
        (("--dataset", sessions, "--session", sessions), "give one of them"),
        (("--session", sessions, "--subjects", "P9"), "There is no 'P9'"),
        (("--session", tmp_path / "no"), "no"),
        (("--session", sessions, "--people", 3), "--people is for virtual people"),
        (("--out", taken), "something that is not a protocol"),
        (("--engine", "int4"), "invalid choice"),
        (("--engine", "int8"), "calibration"),
        (("--peeple", 3), "--people"),
    ):
        status, out, err = said(capsys, "--model", model, *words)
        assert status == 2, words
        assert out == "", words
        assert expected in err, (words, err)
        assert len(err.strip().splitlines()) == 1, (words, err)
    assert [p.name for p in taken.iterdir()] == ["thesis.txt"]


def test_another_toys_sessions_are_refused(capsys, model, sessions, tmp_path):
    from plushsense.dataset.importing.importers import import_recordings

    dataset = import_recordings(sessions, tmp_path / "ds", layout="plush-15", name="sessions").dataset
    layout = load_layout("accel-3")
    arch = Arch.parse("5d1_4d2", (4, 4), channels=layout.n_inputs, classes=18, padding="stream", window=40, step=20)
    n = layout.n_inputs
    other = replace(
        bundle(), arch=arch, weights=random_weights(arch, 1), layout=layout, scaler=Scaler(np.zeros(n), np.ones(n))
    )
    path = other.save(tmp_path / "accel.plush")
    status, _, err = said(capsys, "--model", path, "--dataset", dataset.path)
    assert status == 2
    assert "'plush-15'" in err
    assert "'accel-3'" in err
