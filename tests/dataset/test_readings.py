"""What the sensors of a data set read: statistics of its channels, and gravity at rest, known or estimated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.readings import Readings
from plushsense.dataset.store import Dataset
from support.accelerometers import analogue

PEOPLE = ("P0", "P1", "P2")


def held(tmp_path: Path, zero: float, one_g: float, *, turned: bool = True) -> Dataset:
    analogue(tmp_path / "raw", zero, one_g, turned=turned)
    return import_recordings(tmp_path / "raw", tmp_path / "DS", layout="accel-3").dataset


def test_mean_and_spread_are_those_of_the_valid_readings_of_the_people(tmp_path: Path) -> None:
    dataset = held(tmp_path, 340.0, 70.0)
    values = np.concatenate([dataset.read(r).values for r in dataset.used if r.subject != "P2"])
    found = Readings.of(dataset, ["P0", "P1"])
    assert found.mean == pytest.approx(values.mean(axis=0)) and found.spread == pytest.approx(values.std(axis=0))
    # Readings out of range are none.
    high = float(np.median(values[:, 0]))
    channels = (replace(dataset.layout.channels[0], valid_max=high), *dataset.layout.channels[1:])
    dataset.head = replace(dataset.head, layout=replace(dataset.layout, channels=channels))
    narrow, inside = Readings.of(dataset, ["P0", "P1"]), values[values[:, 0] <= high, 0]
    assert (narrow.mean[0], narrow.spread[0]) == pytest.approx((inside.mean(), inside.std()))
    assert narrow.mean[1:] == found.mean[1:]
    assert Readings.of(dataset, ["nobody else"]) == Readings((0.0,) * 3, (0.0,) * 3)


def test_a_sensor_that_was_turned_tells_its_zero_and_scale(tmp_path: Path) -> None:
    (rest,) = Readings.of(held(tmp_path, 340.0, 70.0), PEOPLE).rest
    assert rest.axes == ("x", "y", "z") and not rest.is_estimated
    assert rest.one_g == pytest.approx(70.0, rel=0.03) and rest.zero == pytest.approx((340.0,) * 3, abs=3)


def test_a_sensor_that_was_not_turned_is_estimated_and_one_without_gravity_left_out(tmp_path: Path) -> None:
    dataset = held(tmp_path, 0.0, 70.0, turned=False)
    (rest,) = Readings.of(dataset, PEOPLE).rest
    assert rest.is_estimated and rest.one_g == pytest.approx(70.0, rel=0.03) and rest.zero == (0.0,) * 3
    upright = replace(dataset.layout.channels[2], offset=70.0)
    dataset.head = replace(
        dataset.head, layout=replace(dataset.layout, channels=(*dataset.layout.channels[:2], upright))
    )
    assert Readings.of(dataset, PEOPLE).rest == ()


def test_readings_of_another_layout_are_recognised() -> None:
    layout = load_layout("accel-3")
    good = Readings((0.0,) * 3, (1.0,) * 3)
    assert good.problem(layout) == "" and "13 channels" in good.problem(load_layout("plush-15"))
    assert "out of range" in replace(good, spread=(-1.0, 0.0, 0.0)).problem(layout)
    assert "out of range" in replace(good, mean=(1e12, 0.0, 0.0)).problem(layout)
