"""Windows and data sets in the forms that other libraries read, which the importer reads again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import plushsense as ps
from plushsense.core.errors import DatasetError
from plushsense.dataset.store import Dataset
from plushsense.workflow.exchange import to_hugging_face, to_panel, to_torch, to_xdf
from support.requirements import installed

pytestmark = pytest.mark.apart("estimator")


@pytest.fixture
def tables() -> None:
    """Polars and pandas (extra tables)."""
    for module in ("polars", "pandas"):
        installed(module, "tables")


def contents(dataset: Dataset, located: bool = True) -> list[tuple[object, ...]]:
    """What is known of each recording, with its values, and with ``located`` where it lies in its stream."""
    return sorted(
        (r.subject, r.gesture, r.stream_row + r.start if located else 0, dataset.read(r).values.tolist())
        for r in dataset.used
    )


def test_windows_for_pytorch_and_aeon(dataset: Dataset) -> None:
    windows = ps.cut_windows(dataset)
    x, y = to_panel(windows)
    assert (x.shape, x.dtype) == (windows.x.shape, np.float64)
    assert [windows.labels.index(label) for label in y] == windows.y.tolist()
    torch = to_torch(windows)
    assert len(torch) == len(windows)
    assert np.array_equal(torch.tensors[0].numpy(), x.astype(np.float32))
    assert np.array_equal(torch.tensors[1].numpy(), windows.y)


def test_a_folder_for_hugging_face_is_imported_again(dataset: Dataset, tmp_path: Path, tables: None) -> None:
    files = to_hugging_face(dataset, tmp_path / "hf")
    assert [f.name for f in files] == ["README.md", "layout.toml", "recordings.parquet", "streams.parquet"]
    head = files[0].read_text().split("---\n")[1].splitlines()
    assert head[:3] == ["configs:", "- config_name: recordings", "  data_files: recordings.parquet"]
    layout = files[1]
    again = ps.import_recordings(files[2], tmp_path / "A", layout=layout)
    assert (again.streams, again.messages) == (0, ())
    assert contents(again.dataset, located=False) == contents(dataset, located=False)
    again = ps.import_recordings(files[3], tmp_path / "B", layout=layout)
    assert contents(again.dataset) == contents(dataset)
    assert [s.rows for s in again.dataset.streams] == [s.rows for s in dataset.streams]
    with pytest.raises(DatasetError, match="already holds something"):
        to_hugging_face(dataset, tmp_path / "hf")


def test_xdf_files_are_imported_again(dataset: Dataset, tmp_path: Path) -> None:
    installed("pyxdf", "lsl")
    files = to_xdf(dataset, tmp_path / "xdf")
    assert [f.relative_to(tmp_path / "xdf").as_posix() for f in files[:1]] == ["P1/fulldatastream.xdf"]
    again = ps.import_recordings(tmp_path / "xdf", tmp_path / "A", layout=dataset.layout)
    assert (len(files), again.messages) == (len(dataset.streams), ())
    assert contents(again.dataset) == contents(dataset)
    clock = again.dataset.read_stream(again.dataset.streams[0].id).device_ms
    assert np.array_equal(np.diff(clock), np.diff(dataset.read_stream(dataset.streams[0].id).device_ms))
    alone = Dataset(dataset.path, dataset.head, again.dataset.recordings[:0], [])
    assert to_xdf(alone, tmp_path / "nothing") == []


def test_readers_of_xdf_keep_the_times_across_lost_samples(tmp_path: Path) -> None:
    installed("pyxdf", "lsl")
    import pyxdf

    rows = [f"P1,{'Shake' if 400 <= i < 500 else ''},{10 * i},{i},1,2" for i in range(600) if not 100 < i < 300]
    (tmp_path / "t.csv").write_text("\n".join(["subject,label,time_ms,x,y,z", *rows]) + "\n")
    columns = {"time": "time_ms"}
    done = ps.import_recordings(tmp_path / "t.csv", tmp_path / "DS", layout="accel-3", columns=columns)
    (file,) = to_xdf(done.dataset, tmp_path / "xdf")
    toy, markers = pyxdf.load_xdf(file)[0]
    assert toy["time_stamps"] == pytest.approx(toy["time_series"][:, 3] / 1000.0, abs=1e-9)
    assert markers["time_stamps"].tolist() == [4.0, 5.0]
    assert toy["time_series"][np.searchsorted(toy["time_stamps"], 4.0), 0] == 400
