"""XDF files: the stream that fits, cut by its markers, with the clock of the file or of the toy."""

from __future__ import annotations

import gzip
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError, FileFormatError, MissingExtraError
from plushsense.core.layouts import load_layout
from plushsense.dataset.importing import xdf
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.importing.xdf import complete_chunks, person_and_session
from plushsense.devices.lsl import MARKERS

pytestmark = pytest.mark.slow

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
    assert done.rejected == ()
    unnamed = (
        f"{path.name}: stream 'toy' (#1): its channels have no names: its 3 values are taken for x, y, z, in this order"
    )
    assert done.notes == (() if labels else (unnamed,))
    assert done.warnings == ()
    assert not list((tmp_path / "DS").rglob("*.xdf"))


@pytest.mark.parametrize(
    ("layout", "named"), [("accel-3", "accel-3"), ("plush-14", "plush-15"), ("phone-6", "phone-6")]
)
def test_the_layout_is_that_whose_channels_a_stream_names(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any, layout: str, named: str
) -> None:
    labels = load_layout(layout).names
    rows = [[k % 50] * len(labels) for k in range(100)]
    toy = xdf_stream("toy", [k / 100 for k in range(100)], rows, labels=labels)
    gaze = xdf_stream("gaze", [k / 50 for k in range(50)], [[k] for k in range(50)], labels=("pupil",))
    path = xdf_writer(tmp_path / "in" / "sub-A.xdf", [gaze, toy, markers(xdf_stream, (0.2, "Tail pull"))])
    done = import_recordings(tmp_path / "in", tmp_path / "DS", adopt_proposals=False)
    assert done.dataset.head.layout.name == named
    assert f"the layout is '{named}', as a stream of the files has its channels" in done.notes
    packed = tmp_path / "sub-B.xdfz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert import_recordings(packed, tmp_path / "DS2", adopt_proposals=False).dataset.head.layout.name == named


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
    assert [e.file for e in done.left_out] == ["sub-A.xdf: stream 'EEG'"]
    twin = accel(xdf_stream)
    twin.name = "other"
    xdf_writer(path, [accel(xdf_stream), twin, said])
    with pytest.raises(FileFormatError, match=r"2 streams fit.*'toy' \(#1\), 'other' \(#2\); choose one with --column"):
        import_recordings(path, tmp_path / "DS2", layout="accel-3")
    assert import_recordings(path, tmp_path / "DS2", layout="accel-3", columns={"stream": "other"}).recordings == 1
    with pytest.raises(FileFormatError, match=r"no stream fits layout 'plush-15': 'toy' \(#1\): it has 3 channels"):
        import_recordings(path, tmp_path / "DS3", layout="plush-15")


def test_files_in_folders_have_the_folders_person(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    streams = [accel(xdf_stream), markers(xdf_stream, (50.5, "Shake"))]
    xdf_writer(tmp_path / "src" / "ana" / "one.xdf", streams)
    xdf_writer(tmp_path / "src" / "ana" / "two.XDF", streams)
    xdf_writer(tmp_path / "src" / "sub-ben" / "ses-1" / "eeg" / "sub-ben_ses-1_eeg.xdf", streams)
    (tmp_path / "src" / "ana" / "bad.xdf").write_bytes(b"XDF?")
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    assert [(r.subject, r.session) for r in done.dataset.recordings] == [("ana", "one"), ("ana", "two"), ("ben", "1")]
    assert not any("files are the session" in note for note in done.notes)
    assert [e.file for e in done.rejected] == ["ana/bad.xdf"]
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
    good, size = complete_chunks(path, "x")
    assert good == size == len(data)
    path.write_bytes(data.replace(b"\x04\x40\x00\x00\x00", b"\x04\xff\xff\xff\x7f", 1))
    assert complete_chunks(path, "x")[0] < size
    path.write_bytes(data[:-1])
    assert complete_chunks(path, "x")[0] < size - 1


def test_without_the_extra_the_command_is_named(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = xdf_writer(tmp_path / "sub-A.xdf", [accel(xdf_stream)])

    def need(module: str, extra: str) -> None:
        raise MissingExtraError(f"{module} {extra}")

    monkeypatch.setattr(xdf, "need", need)
    with pytest.raises(MissingExtraError, match="pyxdf lsl"):
        import_recordings(path, tmp_path / "DS", layout="accel-3")


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


def places(done: Any) -> list[tuple[str, int, int]]:
    return sorted((r.gesture, r.stream_row, r.rows) for r in done.dataset.recordings)


def texts(kind: Any, name: str, *said: tuple[float, Any], format: str = "string") -> Any:
    return kind(name, [t for t, _ in said], [s for _, s in said], format=format, rate=0.0)


def test_the_markers_are_the_texts_that_name_gestures(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    toy = accel(xdf_stream, labels=("x", "y", "z"))
    keys = texts(xdf_stream, "Keyboard", (50.7, "A pressed"), (50.8, "A released"), (51.2, "A pressed"))
    prompts = texts(xdf_stream, "prompts", (50.5, "Tail pull"), (51.0, "end"), (51.5, "Hold strong"), (52.0, "end"))
    path = xdf_writer(tmp_path / "sub-A.xdf", [toy, keys, prompts])
    expected = [("Hold strong", 150, 50), ("Tail pull", 50, 50)]
    done = import_recordings(path, tmp_path / "DS", layout="accel-3", gestures="plush-18")
    assert (places(done), done.notes) == (expected, ())
    assert [(e.file, e.reason) for e in done.left_out] == [
        ("sub-A.xdf: stream 'Keyboard'", "it is not the stream of markers")
    ]
    # Without a gesture set, the keys could be gestures too.
    with pytest.raises(FileFormatError, match=r"2 streams have texts.*'Keyboard' \(#2\) of string: 'A pressed'"):
        import_recordings(path, tmp_path / "no", layout="accel-3")
    for number, choice in enumerate(("prompts", "#3")):
        folder = tmp_path / f"chosen-{number}"
        assert places(import_recordings(path, folder, layout="accel-3", columns={"markers": choice})) == expected
    with pytest.raises(FileFormatError, match="no stream 'prompt' has markers"):
        import_recordings(path, tmp_path / "no", layout="accel-3", columns={"markers": "prompt"})


def test_the_studios_markers_come_first_and_its_mark_for_a_video_is_none(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any
) -> None:
    studio = texts(xdf_stream, MARKERS, (50.2, "mark"), (50.5, "Shake"), (50.8, "mark"), (51.0, "end"))
    other = texts(xdf_stream, "PsychoPy", (50.6, "trial 1"), (50.9, "trial 2"))
    toy = accel(xdf_stream, labels=("x", "y", "z"))
    path = xdf_writer(tmp_path / "sub-A.xdf", [other, toy, studio])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert (places(done), done.notes) == ([("Shake", 50, 50)], ())


def test_numbers_are_gestures_only_if_they_are_chosen_or_named(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any
) -> None:
    toy = accel(xdf_stream, labels=("x", "y", "z"))
    codes = texts(xdf_stream, "codes", (50.5, [3]), (51.0, [0]), (51.5, [7]), (52.0, [0]), format="int32")
    path = xdf_writer(tmp_path / "sub-A.xdf", [toy, codes])
    with pytest.raises(
        DatasetError, match=r"'codes' \(#2\) of int32: '3', '0', '7': a gesture set .*--column markers=codes takes"
    ):
        import_recordings(path, tmp_path / "DS", layout="accel-3")
    done = import_recordings(path, tmp_path / "DS", layout="accel-3", columns={"markers": "codes"})
    assert places(done) == [("3", 50, 50), ("7", 150, 50)]
    assert (done.left_out, ["2 markers end a recording" in note for note in done.notes]) == ((), [True])
    (tmp_path / "set.toml").write_text(
        'name = "codes"\n[[gestures]]\nlabel = "Shake"\nlabels = ["3"]\n[[gestures]]\nlabel = "Wave"\nlabels = ["7"]\n'
    )
    done = import_recordings(path, tmp_path / "named", layout="accel-3", gestures=tmp_path / "set.toml")
    assert places(done) == [("Shake", 50, 50), ("Wave", 150, 50)]


def test_streams_with_other_labels_are_not_the_toy(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    said = markers(xdf_stream, (50.5, "Shake"))
    gyroscope = accel(xdf_stream, labels=("gx", "gy", "gz"))
    path = xdf_writer(tmp_path / "sub-A.xdf", [gyroscope, said])
    with pytest.raises(FileFormatError, match="its 3 channels are gx, gy, gz, and those of layout 'accel-3' x, y, z"):
        import_recordings(path, tmp_path / "no", layout="accel-3")
    renamed = {"x": "gx", "y": "gy", "z": "GZ "}
    assert import_recordings(path, tmp_path / "DS", layout="accel-3", columns=renamed).recordings == 1
    labels = (*"xyz", "gx", "gy", "gz")
    both = xdf_stream("six", gyroscope.times, [[7, 8, 9, *row] for row in gyroscope.samples], labels=labels)
    other = xdf_writer(tmp_path / "sub-B.xdf", [both, said])
    done = import_recordings(other, tmp_path / "six", layout="accel-3", columns=renamed)
    assert done.dataset.read(done.dataset.recordings[0]).values[0].tolist() == gyroscope.samples[50]
    with pytest.raises(
        ConfigError, match=r"--column label=…: in an XDF file, accepted are stream, markers, device_ms, x"
    ):
        import_recordings(path, tmp_path / "no", layout="accel-3", columns={"label": "a"})
    # Labels that match win against the mere number of channels.
    unnamed = accel(xdf_stream)
    unnamed.name = "unnamed"
    xdf_writer(path, [unnamed, accel(xdf_stream, labels=("x", "y", "z")), said])
    done = import_recordings(path, tmp_path / "two", layout="accel-3")
    assert [(e.file, e.reason) for e in done.left_out] == [
        ("sub-A.xdf: stream 'unnamed'", "its channels have no names, and those of another stream have")
    ]
    assert done.notes == ()


def test_streams_of_one_name(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    said = markers(xdf_stream, (50.5, "Shake"), (51.0, "end"), (51.2, "Shake"), (52.2, "end"))
    more: dict[str, Any] = {"labels": ("x", "y", "z"), "source": "toy-7"}
    whole = accel(xdf_stream, **more, uid="u1")

    def part(first: int, last: int, **changed: Any) -> Any:
        return xdf_stream("toy", whole.times[first:last], whole.samples[first:last], **more | changed)

    path = tmp_path / "sub-A.xdf"
    # The outlet was started again.
    xdf_writer(path, [part(0, 130, uid="u1"), part(160, 300, uid="u2"), said])
    done = import_recordings(path, tmp_path / "joined", layout="accel-3")
    assert places(done) == [("Shake", 50, 50), ("Shake", 120, 70)]
    assert "'toy' is in the file 2 times, one after another: joined, with gaps of 0.31 s" in done.notes[0]
    # Two queries of one recorder: equal rows, each without some at its beginning or end.
    late = part(3, 300, uid="u1", offset=2e-5)
    xdf_writer(path, [part(0, 290, uid="u1"), late, said, said])
    done = import_recordings(path, tmp_path / "once", layout="accel-3")
    assert places(done) == [("Shake", 50, 50), ("Shake", 120, 100)]
    assert done.dataset.streams[0].rows == 300
    assert "with equal rows: they are used once" in done.notes[0]
    # Two toys of one name.
    twin = part(0, 300, uid="u3", source="toy-8")
    xdf_writer(path, [whole, twin, said])
    for columns in ({}, {"stream": "toy"}):
        with pytest.raises(
            FileFormatError, match=r"'toy' \(#1\), source 'toy-7', 'toy' \(#2\), source 'toy-8'.*stream=#1"
        ):
            import_recordings(path, tmp_path / "no", layout="accel-3", columns=columns)
    assert import_recordings(path, tmp_path / "two", layout="accel-3", columns={"stream": "#2"}).recordings == 2


def test_a_reset_of_the_clock_loses_no_markers(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    toy = accel(xdf_stream, labels=("x", "y", "z"))
    toy.times = [*toy.times[:150], *(time - 48 for time in toy.times[150:])]
    said = markers(xdf_stream, (50.5, "Shake"), (51.0, "end"), (51.2, "Wave"), (4.0, "Shake"), (4.5, "end"))
    path = xdf_writer(tmp_path / "sub-A.xdf", [toy, said])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert places(done) == [("Shake", 50, 50), ("Shake", 200, 50), ("Wave", 120, 30)]


def test_markers_without_a_recording_and_shortened_recordings_are_counted(
    tmp_path: Path, xdf_writer: Writer, xdf_stream: Any
) -> None:
    toy = accel(xdf_stream, labels=("x", "y", "z"))
    said = markers(
        xdf_stream, (40.0, "Shake"), (41.0, "end"), (49.0, "Wave"), (51.0, "end"), (52.0, "Shake"), (60.0, "end")
    )
    path = xdf_writer(tmp_path / "sub-A.xdf", [toy, said])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert list(done.notes) == [
        "sub-A.xdf: 1 markers name a gesture where the stream has no samples, and give no recording: 'Shake'",
        "sub-A.xdf: 2 recordings are cut short by the stream or a marker that names no gesture: 'Wave', 'Shake'",
    ]


@pytest.mark.parametrize("ending", [".xdfz", ".xdf.gz", ".XDF"])
def test_compressed_files(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any, ending: str) -> None:
    toy = accel(xdf_stream, labels=("x", "y", "z"))
    whole = gzip.compress(xdf_writer(tmp_path / "plain", [markers(xdf_stream, (50.5, "Shake")), toy]).read_bytes())
    path = tmp_path / "in" / f"sub-A_ses-2{ending}"
    path.parent.mkdir()
    path.write_bytes(whole)
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert [(r.subject, r.session, r.rows) for r in done.dataset.recordings] == [("A", "2", 250)]
    path.write_bytes(whole[:-900])
    done = import_recordings(path.parent, tmp_path / "cut", layout="accel-3")
    assert done.recordings == 1
    assert f"{path.name}: cut off or damaged from byte" in done.notes[0]
    with pytest.raises(DatasetError, match=r"--max-gb"):
        import_recordings(path, tmp_path / "no", layout="accel-3", limits=UnpackLimits(total_bytes=1000))


def test_a_clock_of_float32_is_not_used(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    rows = [[2**24 + 11 * i, i, 2 * i, 3 * i] for i in range(100)]
    toy = xdf_stream("toy", [i / 100 for i in range(100)], rows, labels=("device_ms", "x", "y", "z"))
    path = xdf_writer(tmp_path / "sub-A.xdf", [toy, markers(xdf_stream, (0.2, "Shake"))])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert done.dataset.read(done.dataset.recordings[0]).device_ms[:2].tolist() == [200, 210]
    assert "its device_ms is float32" in done.notes[0]


def test_two_files_of_one_session_are_named(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> None:
    streams = [accel(xdf_stream, labels=("x", "y", "z")), markers(xdf_stream, (50.5, "Shake"))]
    # LabRecorder renames the earlier recording of a run.
    for name in ("sub-A_ses-1_task-touch_eeg.xdf", "sub-A_ses-1_task-touch_eeg_old1.xdf"):
        xdf_writer(tmp_path / "in" / name, streams)
    done = import_recordings(tmp_path / "in", tmp_path / "DS", layout="accel-3")
    assert (
        "2 files are the session '1' of 'A': sub-A_ses-1_task-touch_eeg.xdf, sub-A_ses-1_task-touch_eeg_old"
        in done.notes[0]
    )
