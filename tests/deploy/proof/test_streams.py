"""Recordings as one stream for a toy: gaps and resets kept, some of each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.dataset.index import open_dataset
from plushsense.deploy.golden import FAULT, HEALTH, column
from plushsense.deploy.proof.vectors import Export, recorded_frames
from plushsense.devices.virtual.faults import Fault
from plushsense.devices.virtual.scenario import ScenarioPart, ToyScenario, load_scenario
from plushsense.devices.virtual.stream import ToySpec
from plushsense.windows.clock import SampleClock
from support.c_toy import seat
from support.exports import bundle_of, exported

SCENARIO = Path(__file__).resolve().parents[3] / "examples" / "files" / "scenario.toml"


def test_recorded_frames_recordings(recorded: Path) -> None:
    dataset, layout = open_dataset(recorded), load_layout("accel-3")
    frames = recorded_frames(dataset, layout, rows=10_000)
    assert len(frames) == 600 + 120 + 60 and frames[:, 0].min() >= 0 and frames[:, 0].max() < 1 << 32
    clock = SampleClock(layout)
    restarts = []
    for at, (ms, *values) in enumerate(frames.tolist()):
        clock.push(ms, values)
        if clock.restarted:
            restarts.append(at)
    assert restarts in ([301, 601, 721], [301, 601, 661]), "the stream's own, and in each recording"
    share = recorded_frames(dataset, layout, rows=240)
    assert len(share) == 240 and (np.diff(share[:, 0]) > 100).sum() == 2, "some of each"
    assert len(recorded_frames(dataset, layout, subjects=["B"], rows=10_000)) == 180
    with pytest.raises(ConfigError, match="has nobody 'C': accepted are A, B"):
        recorded_frames(dataset, layout, subjects=["C"], rows=1)
    with pytest.raises(ConfigError, match="holds layout 'accel-3'"):
        recorded_frames(dataset, load_layout("plush-15"), rows=1)


def test_the_c_reads_a_scenario_of_the_virtual_toy(c_library: Any, tmp_path: Path) -> None:
    """Through a wrap of the clock, a restart, a broken electrode and what else the example has."""
    toy = ToySpec.of(load_scenario(SCENARIO))
    export = Export(exported(tmp_path / "out", bundle_of("plush-15", "9d1_5d2", "4,6")))
    (played,) = export.played(toy)
    assert played.name == "virtual toy" and played.frames.min() < -2000 and played.frames[:, 0].max() > 2**32 - 20
    assert column(played.answers, "restarts").max() >= 3
    assert FAULT in column(played.answers, "state", HEALTH)
    rows = seat(c_library, export.model).push(played.frames)
    assert np.array_equal(rows, played.answers)
    silent = ToyScenario((ScenarioPart("idle", duration_s=1.0),), faults=(Fault("lost", 0.0, 9.0),))
    with pytest.raises(ConfigError, match="No frame of the scenario arrives"):
        export.played(ToySpec.of(silent))
    with pytest.raises(ConfigError, match="virtual toy has no sensor"):
        Export(exported(tmp_path / "phone", bundle_of("phone-6"))).played(toy)
