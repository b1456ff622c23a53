"""Explanations of networks whose reasons are known, and the verb as a user types it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import Layout, load_layout
from plushsense.dataset.store import Dataset
from plushsense.experiments.people.occlusion import Blocks, attributions, explain_gesture, quiet_windows
from plushsense.models.arch import Arch, ConvLayer
from plushsense.models.bundle import Bundle, trained_people
from plushsense.windows.features import Scaler

Cli = Callable[..., Any]
# The network reads the 5 samples from TAP on, of channel 1 alone.
TAP, CHANNEL, SPAN = 110, 1, 204


def plain_layout() -> Layout:
    """Three channels that are neither accelerations nor axes of a vector."""
    accel = load_layout("accel-3")
    return replace(accel, vectors=(), channels=tuple(replace(c, kind="pressure") for c in accel.channels))


def network_of_one_channel(layout: Layout) -> Bundle:
    arch = Arch((ConvLayer(200, 1, 2),), channels=3, classes=2, window=205, step=5, pool=5)
    weights = {name: np.zeros(shape, dtype=np.float32) for name, shape in arch.weight_shapes.items()}
    weights["norm0.gain"] += 1
    weights["norm0.var"] += 1
    weights["conv0.weight"][0, CHANNEL, TAP] = 1
    weights["dense.weight"][0, 0] = 2
    gestures = GestureSet("two", tuple(Gesture(label, "neutral", label) for label in ("Press", "Other")))
    return Bundle(arch, weights, layout, Scaler(np.zeros(3), np.ones(3)), gestures)


def test_a_network_that_reads_one_channel_at_one_moment_is_explained_by_it() -> None:
    bundle = network_of_one_channel(plain_layout())
    assert bundle.arch.span == SPAN
    x = np.random.default_rng(0).integers(1, 4, (6, 3, SPAN)).astype(np.int32)
    row = explain_gesture(bundle.network(), x, bundle, 0, seed=0).row
    assert row["shares"] == {"x": 0.0, "y": 1.0, "z": 0.0}
    blocks = Blocks.of(bundle.layout, SPAN)
    assert blocks.shape == (3, 9) and blocks.starts[:2].tolist() == [0, 4]
    lost = np.array(row["attribution"])
    reads = blocks.block_of[[TAP, TAP + 4]]
    assert lost[CHANNEL, reads].min() > 0.3
    lost[CHANNEL, reads] = 0
    assert not lost.any()
    assert row["decided_s"] == [-1.0, -0.75]
    curve = row["deletion"]["attributed"]
    # The two blocks that are read are among the first 2 of 20 steps; nothing else changes anything.
    assert curve[2] == curve[-1] == pytest.approx(0.5) and row["area"] < row["area_random"] - 0.1


def test_acceleration_keeps_its_gravity_and_axes_are_replaced_together() -> None:
    layout = load_layout("accel-3")
    scaler = Scaler(np.zeros(3), np.ones(3))
    assert Blocks.of(layout, SPAN).names == ("x, y, z",)
    still = np.broadcast_to(np.array([100, -50, 900], dtype=np.int32)[:, None], (1, 3, SPAN))
    assert quiet_windows(still, layout, scaler) == pytest.approx(still.astype(float))
    shaken = still + 500 * (np.arange(SPAN) % 10 < 5)
    assert np.ptp(quiet_windows(shaken, layout, scaler), axis=2).max() < 50
    # Another vector is replaced by zero, whatever the scaling.
    phone = load_layout("phone-6")
    turned = quiet_windows(np.full((1, 6, SPAN), 7, dtype=np.int32), phone, Scaler(np.full(6, 5.0), np.ones(6)))
    kinds = np.array(phone.input_kinds)
    assert (turned[:, kinds != "acceleration"] == 0).all() and turned[:, kinds == "acceleration"] == pytest.approx(7)
    # A network with a vector layer reads gravity, which is not replaced and stands for what is.
    read = layout.for_vectors()
    blocks = Blocks.of(read, SPAN)
    assert blocks.names == ("x, y, z",) and blocks.source_of.tolist() == [0, 0, 0, 1, 1, 1]
    x = np.concatenate([shaken, 16 * still], axis=1)
    quiet = quiet_windows(x, read, Scaler(np.zeros(6), np.ones(6)))
    assert (quiet[:, :3] == still).all() and (quiet[:, 3:] == x[:, 3:]).all()
    replaced = blocks.replace(x.astype(float), quiet, np.ones((1, *blocks.shape), dtype=np.bool_))
    assert (replaced == quiet).all()


def test_where_nothing_moves_nothing_decides() -> None:
    bundle = network_of_one_channel(load_layout("accel-3"))
    x = np.full((2, 3, SPAN), 2.0)
    quiet = quiet_windows(x.astype(np.int32), bundle.layout, bundle.scaler)
    lost = attributions(bundle.network(), x, quiet, Blocks.of(bundle.layout, SPAN), 0)
    assert lost == pytest.approx(np.zeros((2, 1, 9)))


def test_a_trained_network_is_explained_on_people_it_was_not_trained_on(
    cli: Cli, bundle: Path, dataset: Dataset, tmp_path: Path
) -> None:
    ran = cli("explain", bundle, dataset.path, "--json")
    assert ran.status == 0, ran.err
    found = ran.json
    assert found["area"] < found["area_random"]
    assert found["sources"] == ["x, y, z"] and len(found["edges_s"]) == len(found["gestures"][0]["attribution"][0]) + 1
    people = {person for row in found["gestures"] for person in row["people"]}
    own = Bundle.load(bundle)
    assert people and people <= set(own.provenance["validation_subjects"]) and "validation people" in ran.err
    assert not found["trained_on"]
    assert Path(found["out"]).parent == dataset.path / "evaluations" and Path(found["out"]).name[:8] == "explain_"
    assert json.loads((Path(found["out"]) / "explain.json").read_text())["id"] == found["id"]
    page = Path(found["report"]).read_text(encoding="utf-8")
    assert page.count("data:image/svg") == len(found["gestures"]) + 1

    words = ("explain", bundle, dataset.path, "--out", tmp_path / "E")
    text = cli(*words, "--gestures", "Fast")
    assert text.status == 0 and "Fast" in text.out and "Slow" not in text.out and "area at random" in text.out
    other = cli(*words)
    assert other.status == 2 and "holds an explanation of other settings" in other.err
    assert cli(*words, "--force").status == 0

    everybody = replace(own, provenance={**own.provenance, "subjects": dataset.subjects, "validation_subjects": []})
    assert trained_people(everybody, dataset) == set(dataset.subjects)
    path = everybody.save(tmp_path / "everybody.plush")
    met = cli("explain", path, dataset.path, "--gestures", "Fast", "--json")
    assert met.status == 0 and met.json["trained_on"] and "TRAINED ON" in met.err


def test_what_cannot_be_explained_is_refused_in_one_sentence(
    cli: Cli, bundle: Path, dataset: Dataset, tmp_path: Path
) -> None:
    unknown = cli("explain", bundle, dataset.path, "--gestures", "Fasr")
    assert unknown.status == 2 and "Unknown gesture of the bundle 'Fasr'" in unknown.err and "Fast" in unknown.err
    none = cli("explain", bundle, dataset.path, "--gestures", ",")
    assert none.status == 2 and "No gesture is chosen" in none.err
    own = Bundle.load(bundle)
    more = GestureSet("more", tuple(replace(g, label=f"New {g.label}") for g in own.gestures.gestures))
    absent = replace(own, gestures=more).save(tmp_path / "absent.plush")
    refused = cli("explain", absent, dataset.path, "--gestures", "New Fast")
    assert refused.status == 2 and "no recording of 'New Fast'" in refused.err
    assert "no recording of a gesture of the bundle" in cli("explain", absent, dataset.path).err
    plain = network_of_one_channel(plain_layout()).save(tmp_path / "plain.plush")
    layout = cli("explain", plain, dataset.path)
    assert layout.status == 2 and "The bundle reads the layout" in layout.err
    assert not list(dataset.path.glob("evaluations/explain_*"))
