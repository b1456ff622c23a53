"""XDF files: the stream that fits, cut by its markers, with the clock of the file or of the toy."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import FileFormatError, MissingExtraError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.dataset.importing import xdf
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.importing.xdf import Marker, complete_chunks, person_and_session, segments_of

ACCEL = load_layout("accel-3")
PLUSH = load_layout("plush-15")
Writer = Callable[..., Path]


def accel(kind: Any, rows: int = 300, **more: Any) -> Any:
    values = np.random.default_rng(0).integers(-900, 900, (rows, 3))
    return kind("toy", [50.0 + i / 100 for i in range(rows)], values.tolist(), **more)


def markers(kind: Any, *said: tuple[float, str]) -> Any:
    return kind("prompts", [t for t, _ in said], [s for _, s in said], format="string", rate=0.0)


@pytest.mark.parametrize("labels", [("z", "X", " y"), ()])
def test_markers_cut_the_stream_into_recordings(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any, labels: tuple[str, ...]
) -> None:
    toy = accel(xdf_stream, labels=labels, offset=2.0)
    said = markers(xdf_stream, (52.5, "Shake"), (53.2, "Wave"), (53.8, "end"), (54.5, "Wave"))
    path = xdf_writer(tmp_path / "in" / "sub-P03_ses-S002_task-touch_run-001_eeg.xdf", [toy, said])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    # The markers came on a clock that stands 2 s before the toy's.
    got = [(r.gesture, r.stream_row, r.rows, r.subject, r.session) for r in done.dataset.recordings]
    assert got == [
        ("Shake", 50, 70, "P03", "S002-001"),
        ("Wave", 120, 60, "P03", "S002-001"),
        ("Wave", 250, 50, "P03", "S002-001"),
    ]
    order = [labels.index(n) for n in ("X", " y", "z")] if labels else [0, 1, 2]
    wave = done.dataset.read(done.dataset.recordings[1])
    assert np.array_equal(wave.values, np.array(toy.samples)[120:180][:, order])
    assert wave.device_ms.tolist() == [53_200 + 10 * i for i in range(60)]
    origin = json.loads((tmp_path / "DS/streams/P03/S002-001/origin.json").read_text())
    assert (origin["source"], origin["stream"]) == (path.name, "toy")
    assert done.rejected == []
    assert done.warnings == []
    assert not list((tmp_path / "DS").rglob("*.xdf"))


def test_the_toys_own_clock_is_taken_where_it_is_sent(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    rows = [[7 + 11 * i, i, 2 * i, 3 * i] for i in range(100)]
    toy = xdf_stream("toy", [i / 100 for i in range(100)], rows, labels=("device_ms", "x", "y", "z"), format="int32")
    path = xdf_writer(tmp_path / "sub-A.xdf", [toy, markers(xdf_stream, (0.2, "Shake"))])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    (recording,) = done.dataset.recordings
    assert done.dataset.read(recording).device_ms[0] == 7 + 11 * 20
    assert recording.epoch_ms == 200


def test_a_label_on_every_row_where_the_layout_has_one(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    rows = (np.arange(200)[:, None] * np.ones(6) / 1000).tolist()
    toy = xdf_stream("phone", [i / 100 for i in range(200)], rows, format="double64")
    path = xdf_writer(tmp_path / "sub-A.xdf", [toy, markers(xdf_stream, (0.5, "Walk, fast"), (1.0, "stop"))])
    done = import_recordings(path, tmp_path / "DS", layout="phone-6")
    (recording,) = done.dataset.recordings
    assert (recording.gesture, recording.first_row, recording.rows) == ("Walk_ fast", 50, 50)
    assert done.dataset.read(recording).values[0].tolist() == [50] * 6


def test_other_streams_are_named_and_two_that_fit_must_be_chosen(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any
) -> None:
    said = markers(xdf_stream, (50.5, "Shake"))
    eeg = xdf_stream("EEG", [50.0, 50.1], [[0.0] * 32] * 2)
    path = xdf_writer(tmp_path / "sub-A.xdf", [accel(xdf_stream), eeg, said])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert [e["file"] for e in done.left_out] == ["sub-A.xdf: stream 'EEG'"]
    twin = accel(xdf_stream)
    twin.name = "other"
    xdf_writer(path, [accel(xdf_stream), twin, said])
    with pytest.raises(FileFormatError, match="2 streams fit.*'toy', 'other'.*--column stream=NAME"):
        import_recordings(path, tmp_path / "DS2", layout="accel-3")
    assert import_recordings(path, tmp_path / "DS2", layout="accel-3", columns={"stream": "other"}).recordings == 1
    with pytest.raises(FileFormatError, match="no stream fits layout 'plush-15': 'toy': it has 3 channels"):
        import_recordings(path, tmp_path / "DS3", layout="plush-15")


def test_files_in_folders_have_the_folders_person(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    streams = [accel(xdf_stream), markers(xdf_stream, (50.5, "Shake"))]
    xdf_writer(tmp_path / "src" / "ana" / "one.xdf", streams)
    xdf_writer(tmp_path / "src" / "ana" / "two.XDF", streams)
    xdf_writer(tmp_path / "src" / "sub-ben" / "ses-1" / "eeg" / "sub-ben_ses-1_eeg.xdf", streams)
    (tmp_path / "src" / "ana" / "bad.xdf").write_bytes(b"XDF?")
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    assert [(r.subject, r.session) for r in done.dataset.recordings] == [("ana", "one"), ("ana", "two"), ("ben", "1")]
    assert [e["file"] for e in done.rejected] == ["ana/bad.xdf"]
    alone = tmp_path / "src" / "ana" / "one.xdf"
    with pytest.raises(FileFormatError, match="the person of 'one.xdf' is not known"):
        import_recordings(alone, tmp_path / "DS2", layout="accel-3")
    (tmp_path / "map.csv").write_text("file,subject\none.xdf,S1\n")
    done = import_recordings(alone, tmp_path / "DS2", layout="accel-3", subjects=tmp_path / "map.csv")
    assert done.dataset.subjects == ["S1"]


def test_what_is_odd_is_said(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    toy = accel(xdf_stream, format="double64")
    toy.samples = [[v / 1000 for v in row] for row in toy.samples]
    toy.samples[7][1] = float("nan")
    said = markers(xdf_stream, (50.5, "Tail pull"), (51.0, "sneezed"), (51.5, "Hold_strong"), (52, "Stop"))
    path = xdf_writer(tmp_path / "sub-A.xdf", [said, toy])
    whole = path.read_bytes()
    done = import_recordings(path, tmp_path / "DS", layout="accel-3", gestures="plush-18")
    text = "\n".join(done.notes)
    assert "1 samples without a number" in text
    assert "'x', 'y', 'z': the values are small fractions of the step of layout 'accel-3'" in text
    assert "1 markers name no gesture and begin no recording: 'sneezed'" in text
    assert done.gestures == ["Hold strong", "Tail pull"]
    path.write_bytes(whole[:-120])
    done = import_recordings(path, tmp_path / "DS2", layout="accel-3")
    assert "cut off or damaged from byte" in "\n".join(done.notes)


def test_a_count_of_samples_that_the_bytes_do_not_hold_is_damage(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any
) -> None:
    path = xdf_writer(tmp_path / "sub-A.xdf", [accel(xdf_stream), markers(xdf_stream, (50.5, "Shake"))])
    data = path.read_bytes()
    good, size = complete_chunks(path)
    assert good == size == len(data)
    path.write_bytes(data.replace(b"\x04\x40\x00\x00\x00", b"\x04\xff\xff\xff\x7f", 1))
    assert complete_chunks(path)[0] < size
    path.write_bytes(data[:-1])
    assert complete_chunks(path)[0] < size - 1


def test_without_the_extra_the_command_is_named(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = xdf_writer(tmp_path / "sub-A.xdf", [accel(xdf_stream)])

    def need(module: str, extra: str) -> None:
        raise MissingExtraError(f"{module} {extra}")

    monkeypatch.setattr(xdf, "need", need)
    with pytest.raises(MissingExtraError, match="pyxdf lsl"):
        import_recordings(path, tmp_path / "DS", layout="accel-3")


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["Tail pull", "x"], [("Tail pull", 10, 20)]),
        (["tail_pull", "Tail  pull"], [("Tail pull", 10, 20), ("Tail pull", 20, 50)]),
        (["start Tail pull", "end Tail pull"], [("Tail pull", 10, 20)]),
        (["Tail pull/begin", "Tail pull/stop"], [("Tail pull", 10, 20)]),
        (["begin:Tail pull"], [("Tail pull", 10, 50)]),
        (["END", "stop"], []),
        (["sneeze"], []),
    ],
)
def test_what_markers_mean(texts: list[str], expected: list[tuple[str, int, int]]) -> None:
    said = [Marker(0.1 * (i + 1), text) for i, text in enumerate(texts)]
    cuts, _ = segments_of(said, np.arange(50) / 100.0 + 1e-9, load_gestures("plush-18"))
    assert [(c.label, c.start, c.stop) for c in cuts] == expected


def test_who_is_in_the_name_or_the_folder() -> None:
    assert person_and_session(Path("sub-P1_ses-S2_task-a_run-3_eeg.xdf"), "x") == ("P1", "S2-3")
    assert person_and_session(Path("monday.xdf"), "ana") == ("ana", "monday")
    assert person_and_session(Path("monday.xdf"), None) == (None, "monday")


def test_the_reader_stays_quiet(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    logging.getLogger("pyxdf").handlers.clear()
    path = xdf_writer(tmp_path / "sub-A.xdf", [accel(xdf_stream), markers(xdf_stream, (50.5, "Shake"))])
    path.write_bytes(
        path.read_bytes().replace(b"<?xml version='1.0'?><info></info>", b"<?xml version='1.0'?><inf></info>>")
    )
    assert import_recordings(path, tmp_path / "DS", layout="accel-3").recordings == 1
    assert capfd.readouterr().err == ""
