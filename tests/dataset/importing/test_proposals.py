"""What an import finds out by itself: layout, rate, gap, zero of an accelerometer, window."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.importing.proposals import readable_layouts
from plushsense.dataset.index import open_dataset

ACCEL = load_layout("accel-3")


def analogue(folder: Path, zero: float, one_g: float, period_ms: int = 10, turned: bool = True) -> Path:
    """Recordings of an accelerometer of 10 bits, held in many directions for a while and moved in between."""
    rng = np.random.default_rng(0)
    for p in range(3):
        (folder / f"P{p}").mkdir(parents=True)
        for take in range(6):
            up = rng.normal(size=3) if turned else np.array([0.0, 0.0, 1.0])
            up /= np.linalg.norm(up)
            rows = 3000 // period_ms
            moves = np.where(np.arange(rows) > rows // 2, 0.8, 0.0) * np.sin(np.arange(rows) * period_ms / 70)
            values = zero + one_g * (up + moves[:, None] * [0.3, 0.5, 0.2]) + rng.normal(0, 0.6, (rows, 3))
            clock = np.arange(rows, dtype=np.int64) * period_ms
            frames = Frames(np.round(values).astype(np.int64), clock, clock + 1_700_000_000_000)
            write_recording(folder / f"P{p}" / f"Wave_{1_700_000_000_000 + take}_{rows}.csv", frames, ACCEL)
    return folder


@pytest.mark.parametrize(("zero", "one_g"), [(330.0, 68.0), (511.0, 102.0)])
def test_the_zero_of_an_analogue_accelerometer_is_found_and_adopted(tmp_path: Path, zero: float, one_g: float) -> None:
    source = analogue(tmp_path / "R", zero, one_g)
    done = import_recordings(source, tmp_path / "DS", layout="accel-3")
    offset = next(p for p in done.proposals if p["key"] == "offset")
    assert all(abs(value - zero) < 0.05 * one_g for value in offset["value"].values())
    assert "--adopt" in offset["advice"]
    assert [c.offset for c in done.dataset.layout.channels] == [0, 0, 0]
    adopted = import_recordings(source, tmp_path / "ADOPTED", layout="accel-3", adopt_proposals=True)
    assert "adopted" in adopted.proposals[0]["advice"]
    for dataset in (adopted.dataset, open_dataset(tmp_path / "ADOPTED")):
        assert [c.offset for c in dataset.layout.channels] == list(offset["value"].values())
    assert not [p for p in import_recordings(source, tmp_path / "AGAIN", layout=adopted.dataset.layout).proposals
                if p["key"] == "offset"]  # fmt: skip


def test_a_zero_that_cannot_be_known_is_not_proposed(tmp_path: Path) -> None:
    flat = import_recordings(analogue(tmp_path / "R", 330, 68, turned=False), tmp_path / "DS", layout="accel-3")
    assert "offset" not in {p["key"] for p in flat.proposals}
    right = import_recordings(analogue(tmp_path / "Q", 0, 8000), tmp_path / "DS2", layout="accel-3")
    assert "offset" not in {p["key"] for p in right.proposals}


def test_rate_gap_and_window_are_measured(tmp_path: Path) -> None:
    done = import_recordings(analogue(tmp_path / "R", 0, 8000, period_ms=80), tmp_path / "DS", layout="accel-3")
    found = {p["key"]: p["value"] for p in done.proposals}
    assert found["rate_hz"] == 12.0 and found["gap_ms"] == pytest.approx(320, abs=8)
    assert "window_s" not in found  # the recordings last 3 s
    adopted = import_recordings(tmp_path / "R", tmp_path / "DS2", layout="accel-3", adopt_proposals=True).dataset.layout
    assert (adopted.rate_hz, adopted.gap_ms) == (12.0, found["gap_ms"])


def test_the_real_recordings_need_nothing_but_a_window(real_data: Path, tmp_path: Path) -> None:
    for source, layout in (("makeability-gestures", "accel-3"), ("har-phone", "phone-6")):
        done = import_recordings(real_data / source, tmp_path / layout)
        assert done.dataset.layout.name == layout and f"'{layout}'" in done.notes[0]
        assert [p["key"] for p in done.proposals] == ["window_s"]


def test_headers_that_fit_no_layout_or_several(tmp_path: Path, cli: Callable[..., Any]) -> None:
    folder = tmp_path / "R" / "P1"
    folder.mkdir(parents=True)
    path = folder / "Wave_1700000000000_3.csv"
    path.write_text("a, b\n1, 2\n")
    with pytest.raises(ConfigError, match="--layout is needed: accepted are accel-3"):
        import_recordings(tmp_path / "R", tmp_path / "DS")
    layouts = [load_layout(name) for name in ("plush-14", "plush-15")]
    path.write_text("; ".join(layouts[0].csv.header) + "\n")
    assert layouts[0].csv.header == layouts[1].csv.header
    with pytest.raises(ConfigError, match="fits plush-14 and plush-15"):
        import_recordings(tmp_path / "R", tmp_path / "DS")
    ran = cli("import", tmp_path / "R", tmp_path / "DS", "--add", "--adopt")
    assert ran.status == 2


def test_the_layout_is_guessed_by_what_the_files_hold(tmp_path: Path) -> None:
    header = load_layout("plush-15").csv.header
    clock = [[*list(range(13)), 1700000000000 + 10 * i, 5000 + 10 * i] for i in range(40)]
    delays = [[*row[:-1], 9 + i % 3] for i, row in enumerate(clock)]
    for name, rows, first in (("clock", clock, "plush-15"), ("delays", delays, "plush-14")):
        lines = ["; ".join(header), *("; ".join(map(str, row)) for row in rows)]
        for number, text in enumerate((lines, lines[1:])):
            path = tmp_path / name / f"Tail pull_170000000000{number}_40.csv"
            path.parent.mkdir(exist_ok=True)
            path.write_text("\n".join(text) + "\n")
            assert readable_layouts([path])[0].name == first
    assert readable_layouts([tmp_path / "other.txt"]) == []
