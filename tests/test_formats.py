"""Files of every format version open for ever, and a network's answers to known frames do not change.

``formats`` holds what version 0.1.0 wrote: a session of the virtual toy (format 1), the backup (1) of the data set (1)
that was imported from it, and a bundle (1) of a small network; backup and bundle are in base64. A new version of a
format gets files of its own beside these. ``answers.json`` has its answers to the frames of that session:
it may only change together with a line in the CHANGELOG (``PLUSHSENSE_ANSWERS=write`` writes it again).
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

import plushsense as ps
from plushsense.core.errors import BadInput
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import read_stream
from plushsense.dataset.backup import restore
from plushsense.deploy.quantize import integer_model
from plushsense.devices.base import Frame
from plushsense.models.bundle import Bundle
from plushsense.runtime.classifier import IntegerClassifier, StreamClassifier, StreamReader

FORMATS = Path(__file__).parent / "formats"
ANSWERS = FORMATS / "answers.json"
STREAM = "fulldatastream.csv"


def decoded(name: str, path: Path) -> Path:
    path.write_bytes(base64.b64decode((FORMATS / name).read_text("ascii")))
    return path


@pytest.fixture
def bundle(tmp_path: Path) -> Bundle:
    return ps.load(decoded("bundle-1.txt", tmp_path / "model.plush"))


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """The frames of the session's stream."""
    read = read_stream(FORMATS / "session-1" / "S01" / "1" / STREAM, load_layout("plush-15")).frames
    return [Frame(0, int(t), tuple(map(int, row))) for t, row in zip(read.device_ms, read.values, strict=True)]


def answers(reader: StreamReader, frames: list[Frame], digits: int) -> list[list[Any]]:
    """The label and the probabilities of each decision of the network."""
    decisions = [d for frame in frames for d in reader.push(frame) if d.probabilities is not None]
    return [[d.gesture, [round(p, digits) for p in d.probabilities or ()]] for d in decisions]


def test_a_session_of_format_1_is_imported(tmp_path: Path) -> None:
    ps.import_recordings(FORMATS / "session-1", tmp_path / "DS", layout="plush-15")
    dataset = ps.open_dataset(tmp_path / "DS")
    assert [r.gesture for r in dataset.recordings] == ["Back stroke 1", "Tail hit 1"]
    assert {r.subject for r in dataset.recordings} == {"S01"}


def test_a_backup_of_a_data_set_of_format_1_is_restored(tmp_path: Path) -> None:
    restore(decoded("backup-1.txt", tmp_path / "backup.zip"), tmp_path / "DS")
    dataset = ps.open_dataset(tmp_path / "DS")
    for recording in dataset.recordings:
        here = next((FORMATS / "session-1" / "S01" / "1").glob(f"{recording.gesture}_*.csv"))
        assert (tmp_path / "DS" / recording.file).read_bytes() == here.read_bytes()


def test_a_bundle_of_format_1_answers_as_it_did(bundle: Bundle, frames: list[Frame]) -> None:
    model = integer_model(bundle)
    found = {
        "image_sha256": hashlib.sha256(model.to_bytes()).hexdigest(),
        "float": answers(StreamClassifier(bundle), frames, 3),
        "int8": answers(IntegerClassifier(model), frames, 5),
    }
    if os.environ.get("PLUSHSENSE_ANSWERS") == "write":
        ANSWERS.write_text(json.dumps(found).replace("[[", "[\n[").replace("]], ", "]],\n") + "\n", "utf-8")
    known = json.loads(ANSWERS.read_text("utf-8"))
    assert len(known["int8"]) > 50 and len({label for label, _ in known["int8"]}) > 1
    assert found["int8"] == known["int8"]
    assert found["image_sha256"] == known["image_sha256"]
    for (label, found_p), (known_label, known_p) in zip(found["float"], known["float"], strict=True):
        assert found_p == pytest.approx(known_p, abs=2e-3)
        assert label == known_label or sorted(known_p)[-1] - sorted(known_p)[-2] < 4e-3


@pytest.mark.parametrize(
    ("name", "key", "read"),
    [
        ("session-1/S01/1/session.json", '"format": 1', "session"),
        ("data set", "format = 1", "data set"),
        ("bundle-1.txt", '\\"version\\":1', "bundle"),
    ],
)
def test_a_later_version_is_refused_with_what_to_do(name: str, key: str, read: str, tmp_path: Path) -> None:
    later = key.replace("1", "9")
    with pytest.raises(BadInput, match=r"update|the PlushSense that wrote it"):
        if read == "bundle":
            path = decoded(name, tmp_path / "later.plush")
            data = path.read_bytes()
            assert data.count(key.encode()) == 1
            path.write_bytes(data.replace(key.encode(), later.encode()))
            ps.load(path)
        elif read == "session":
            folder = shutil.copytree(FORMATS / "session-1", tmp_path / "later")
            head = folder / "S01" / "1" / "session.json"
            head.write_text(head.read_text("utf-8").replace(key, later, 1), "utf-8")
            ps.import_recordings(folder, tmp_path / "DS", layout="plush-15")
        else:
            restore(decoded("backup-1.txt", tmp_path / "backup.zip"), tmp_path / "DS")
            about = tmp_path / "DS" / "dataset.toml"
            about.write_text(about.read_text("utf-8").replace(key, later, 1), "utf-8")
            ps.open_dataset(tmp_path / "DS")
