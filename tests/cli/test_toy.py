"""``plushsense toy --scenario``: into a folder, and read by ``live`` with the truth beside it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from plushsense.deploy.quantize import classifier_of
from plushsense.devices.opening import open_device
from plushsense.experiments.streams.benchmark import stream_eval
from plushsense.live.loop import run_live
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import NO_GESTURE
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from support.exports import bundle_of

SCENARIOS = Path(__file__).resolve().parents[2] / "examples" / "scenarios"


def test_a_scenario_into_a_folder(cli: Any, tmp_path: Path) -> None:
    words = ("--scenario", SCENARIOS / "failing-link.toml")
    ran = cli("toy", *words, "--out", tmp_path / "one", "--json")
    assert ran.status == 0
    assert set(ran.json) == {"folder", "people", "gestures", "seconds", "counters"}
    assert ran.json["people"] == [11] and ran.json["counters"]["reconnects"] == 2
    truth = (tmp_path / "one" / "truth.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(truth) == ran.json["gestures"] > 5
    assert cli("toy", *words, "--out", tmp_path / "two", "--seed", 5).status == 0
    assert (tmp_path / "two" / "truth.jsonl").read_text(encoding="utf-8").splitlines() != truth


def test_live_on_a_scenario_reports_what_is_scored_with_its_truth(tmp_path: Path, cli: Any) -> None:
    """Through a wrap of the clock, a restart and a broken electrode: the same events, live and in the files."""
    scenario = SCENARIOS / "clock-wrap.toml"
    assert cli("toy", "--scenario", scenario, "--out", tmp_path / "played").status == 0
    gate = GateSettings((Signal(JERK, (10,), lag=2, floor=20),), (Rule((Term(0, 60),), 3, NO_GESTURE),))
    spec = DecideSpec(enter=0.1, leave=0.05, known_margin=0.0, gate=gate)
    bundle = replace(bundle_of("plush-15", "9d1_5d2", "4,6"), decision=spec.to_dict())
    with open_device(f"virtual://?scenario={scenario}&speed=0", bundle.layout) as toy:
        decisions = list(run_live(toy, classifier_of(bundle, spec, "float")))
    states = [decision.state for decision in decisions]
    assert [after for before, after in pairwise(states) if before != after] == [
        *("tracking", "no signal", "warming", "tracking"),  # the clock wraps
        *("no signal", "warming", "tracking"),  # the toy restarts
        *("sensor fault", "warming", "tracking", "no signal"),
    ]
    begun = [e for decision in decisions for e in decision.events if e.kind == "begun"]
    scores = stream_eval(
        tmp_path / "played" / "recordings", bundle.save(tmp_path / "m.plush"), events=tmp_path / "events.csv"
    ).to_json()
    assert scores["simulated"]
    assert scores["truths"] == 6 == scores["hits"] + scores["deletions"]
    with (tmp_path / "events.csv").open(encoding="utf-8") as file:
        written = [float(row["t"]) for row in csv.DictReader(file)]
    assert written == pytest.approx([event.since_s for event in begun], abs=0.001) and len(written) > 5


def test_settings_that_do_not_go_together_are_refused(cli: Any, tmp_path: Path) -> None:
    file = SCENARIOS / "clock-wrap.toml"
    for words, sentence in (
        (("--out", tmp_path / "x"), "--out needs a toy that ends: add --scenario FILE"),
        (("--scenario", file, "--out", tmp_path / "x", "--truth", "t"), "leave out --truth"),
        (("--scenario", file, "--out", tmp_path / "x", "--speed", 5), "leave out --speed"),
        (("--scenario", file, "--tcp", 0, "--person", 3), "The scenario says the person: leave out --person"),
        (("--scenario", tmp_path / "none.toml", "--tcp", 0), "There is no scenario file"),
    ):
        ran = cli("toy", *words)
        assert (ran.status, ran.out) == (2, "") and sentence in ran.err and ran.err.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_the_truth_is_written_while_a_scenario_is_read(tmp_path: Path, cli: Any) -> None:
    cli("toy", "--scenario", SCENARIOS / "clock-wrap.toml", "--out", tmp_path / "played")
    with open_device(f"virtual://?scenario={SCENARIOS / 'clock-wrap.toml'}&speed=0") as toy:
        list(toy)
        made = [json.dumps(gesture.to_dict(), ensure_ascii=False) for gesture in toy.performed]  # type: ignore[attr-defined]
    assert (tmp_path / "played" / "truth.jsonl").read_text(encoding="utf-8").splitlines() == made
