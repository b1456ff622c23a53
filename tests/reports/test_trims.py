from pathlib import Path

import numpy as np
import pytest

from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from plushsense.dataset.trimming import accept_suggestions, refresh_trims, suggest_trims
from plushsense.recording.simulate import SimulationSpec, simulate
from plushsense.reports.quality_figures import PER_PAGE, save_trims, trim_page

pytestmark = pytest.mark.slow


def _dataset(folder: Path) -> Dataset:
    simulate(
        folder / "raw", SimulationSpec(people=1, repetitions=2, at_rest=0, gestures=("Head stroke 1", "Hold strong"))
    )
    return import_recordings(folder / "raw", folder / "DS", layout="plush-15").dataset


def test_dotted_where_suggested_and_solid_where_marked(tmp_path: Path) -> None:
    dataset = _dataset(tmp_path)
    found = suggest_trims(dataset)
    seen = next(t for t in found if t.suggestion.onset_visible)
    accept_suggestions(dataset, [seen], "K")
    (marked,) = refresh_trims(dataset, [seen])
    for trim, expected in ((seen, {":"}), (marked, {":", "-"})):
        axes = trim_page(dataset, [trim], offset=False).axes[0]
        upright = [line for line in axes.lines if len(line.get_xdata()) == 2]
        assert {line.get_linestyle() for line in upright} == expected
        assert all(np.ptp(np.asarray(line.get_xdata())) == 0 for line in upright)
        assert upright[0].get_xdata()[0] == trim.seconds[trim.suggestion.start]
        assert len(axes.lines) - len(upright) == 13, "every channel"


def test_garbage_is_a_hole_and_squeezes_nothing(tmp_path: Path) -> None:
    dataset = _dataset(tmp_path)
    path = dataset.path / dataset.recordings[0].file
    lines = path.read_text().splitlines()
    cells = lines[20].split("; ")
    path.write_text("\n".join([*lines[:20], "; ".join(["-30000", *cells[1:]]), *lines[21:], ""]))
    (dataset.path / "index.json").unlink()
    dataset = open_dataset(dataset.path)
    axes = trim_page(dataset, suggest_trims(dataset)[:1]).axes[0]
    drawn = np.asarray(axes.lines[0].get_ydata())
    assert np.flatnonzero(np.isnan(drawn)).tolist() == [19]
    lane = [np.asarray(line.get_ydata()) for line in axes.lines if line.get_label() in dataset.layout.names[:5]]
    assert max(np.nanmax(np.abs(y)) for y in lane) == 1.0


def test_pages(tmp_path: Path) -> None:
    dataset = _dataset(tmp_path)
    found = suggest_trims(dataset) * 4
    assert len(found) > PER_PAGE
    assert [p.name for p in save_trims(dataset, found, tmp_path / "pages")] == ["trim-001.png", "trim-002.png"]
    (one,) = save_trims(dataset, found, tmp_path / "deep" / "one.png")
    assert one.read_bytes().startswith(b"\x89PNG")
