"""A data set under pseudonyms: the sensors' numbers as they were, and no name, code or date left."""

import csv
import json
import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS, Mark, append_marks, read_marks
from plushsense.dataset.privacy.pseudonymise import PseudonymisationResult, pseudonymise
from plushsense.dataset.store import Dataset, RecordingInfo, read_people
from plushsense.recording.session_files import SessionHead, read_events
from plushsense.recording.simulate import simulate
from plushsense.windows.cut import WindowSpec, cut_windows

WHEN = 1_760_000_123_456
PLUSH = load_layout("plush-15")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sim") / "rec"
    simulate(out, people=2, repetitions=2, at_rest=1, gestures=["Tail pull", "Back stroke 1"])
    (out / "P01").rename(out / "Ana Maria")
    return out


@pytest.fixture
def folder(recordings: Path, tmp_path: Path) -> Path:
    """A data set with everything in it that could tell who somebody is."""
    ds = import_recordings(recordings, tmp_path / "DS", layout="plush-15", name="Toys of Ana Maria").dataset
    mine = [r for r in ds.recordings if r.subject == "Ana Maria"]
    place = ds.path / "recordings" / "Ana Maria"
    head = SessionHead(
        subject="Ana Maria",
        session="20251009-101500",
        started_ms=WHEN,
        layout=PLUSH.to_dict(),
        protocol={"name": "17 gestures", "say": "Ana Maria, press now"},
        consent="form 17",
        device="ble://AA:BB:CC:DD:EE:FF",
        software="plushsense 0.1.0",
        simulated=True,
    )
    head.write(place)
    (place / "session.jsonl").write_text(
        json.dumps({"what": "take", "at_ms": WHEN, "file": Path(mine[0].file).name, "gesture": "Tail pull"})
        + "\n"
        + json.dumps(
            {"what": "note", "at_ms": WHEN + 1, "text": "ana_maria cried on 2025-10-09; p02 helped", "who": "jdoe"}
        )
        + "\n"
        + json.dumps({"what": "mended", "at_ms": WHEN, "how": "torn last line cut off", "text": str(WHEN)[:9]})
        + '\n{"what": "note", "te'
    )
    sidecar = place / (Path(mine[0].file).stem + ".json")
    sidecar.write_text(json.dumps({"host_ms": [WHEN, WHEN + 5.5], "epoch_s": WHEN / 1000, "lost": 3, "ok": True}))
    (ds.path / "subjects.csv").write_text(
        "subject,age_group,gender,consent,remark\nP02,adult,female,form 18,sister of Ana Maria\n"
        "Ana Maria,child,female,form 17,\nP09,,,,never came\n"
    )
    append_marks(
        ds.path,
        [
            Mark(mine[1].id, "exclude", "jdoe", "Ana-Maria pulled the cable", when="2025-10-09T10:15:00+00:00"),
            Mark(mine[2].id, "trim", "plushsense trim", start=3, stop=90, when="2025-10-10T10:15:00+00:00"),
            Mark("", "accept", "JDoe", "as jdoe said", check="rate", when="2025-10-11T10:15:00+00:00"),
            Mark("P02", "accept", "jdoe", check="missing", when="2025-10-12T10:15:00+00:00"),
        ],
    )
    (ds.path / "streams" / "P02" / "origin.json").write_text('{"file": "my daughter.xdf"}')
    (ds.path / "photo of Ana.txt").write_text("x")
    (ds.path / "cache").mkdir()
    (ds.path / "cache" / "a.npz").write_text("Ana Maria")
    open_dataset(ds.path)
    return ds.path


def made(folder: Path, tmp_path: Path, **more: object) -> PseudonymisationResult:
    return pseudonymise(folder, tmp_path / "OUT", key=tmp_path / "secret" / "key.csv", **more)  # type: ignore[arg-type]


def key_of(path: Path) -> dict[str, tuple[str, int]]:
    with path.open(newline="") as file:
        return {row["original"]: (row["code"], int(row["shift_s"])) for row in csv.DictReader(file)}


def pairs(old: Dataset, new: Dataset, key: dict[str, tuple[str, int]]) -> list[tuple[RecordingInfo, RecordingInfo]]:
    """Each recording with the one that it became."""
    by_time = {(r.subject, r.gesture, r.epoch_ms): r for r in new.recordings}
    folders = [r.file.split("/")[1] for r in old.recordings]
    return [
        (r, by_time[key[r.subject][0], r.gesture, r.epoch_ms + 1000 * key[f][1]])
        for r, f in zip(old.recordings, folders, strict=True)
    ]


def test_what_the_sensors_said_is_the_same(folder: Path, tmp_path: Path) -> None:
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    done = made(folder, tmp_path)
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before, "the original is untouched"
    old, new = open_dataset(folder), open_dataset(tmp_path / "OUT")
    assert done.to_dict() | {"findings": []} == {
        "subjects": 2,
        "recordings": 9,
        "streams": 3,
        "files": len([p for p in new.path.rglob("*") if p.is_file()]),
        "findings": [],
        "key": str(tmp_path / "secret" / "key.csv"),
        "out": str(new.path),
    }
    key = key_of(done.key)
    together = pairs(old, new, key)
    assert len(together) == 9
    for a, b in together:
        x, y = old.read(a), new.read(b)
        assert np.array_equal(x.values, y.values)
        assert np.array_equal(x.device_ms, y.device_ms)
        assert (a.stream_row, a.start, a.stop, a.excluded, a.rate_hz) == (
            b.stream_row,
            b.start,
            b.stop,
            b.excluded,
            b.rate_hz,
        )
        assert b.stream_row >= 0
    assert sum(b.excluded for _, b in together) == 1
    assert sum(b.start == 3 for _, b in together) == 1


def test_windows_are_the_same(folder: Path, tmp_path: Path) -> None:
    done = made(folder, tmp_path)
    old, new = open_dataset(folder), done.dataset
    a, b = cut_windows(old, WindowSpec()), cut_windows(new, WindowSpec())
    now = {x.id: y.id for x, y in pairs(old, new, key_of(done.key))}
    order = {r: i for i, r in enumerate(b.recording_ids)}
    for at, identity in enumerate(a.recording_ids):
        theirs = b.recording == order[now[identity]]
        assert np.array_equal(a.x[a.recording == at], b.x[theirs])
    assert len(a) == len(b) > 0


def test_no_name_code_address_or_date_is_left(folder: Path, tmp_path: Path) -> None:
    done = made(folder, tmp_path, words=["sister"])
    out = tmp_path / "OUT"
    for path in out.rglob("*"):
        text = path.relative_to(out).as_posix() + (path.read_text() if path.is_file() else "")
        assert not re.search(r"ana[ _-]?maria|p[ _-]?0[29]|jdoe|sister|AA:BB|form 1[78]", text, re.I), path
        # A whole date: four digits alone come by chance, in sizes, times and checksums.
        assert not re.search(r"(?<!\d)2025-?10-?(?:09|10|11)(?!\d)", text), path
        if path.name != "index.json":
            assert not re.search(r"(?<!\d)17[56]\d{10}(?!\d)", text), path
    assert not (out / "cache").exists()
    assert not list(out.rglob("photo*"))
    assert not list(out.rglob("origin.json"))
    said = "\n".join(f["message"] for f in done.findings)
    assert "photo of Ana.txt" in said
    assert "torn" in said
    assert re.search(r"replaced by 'S\w{4}' \(1×\)", said)
    assert "notes in free text were kept" in said
    assert "Ana" not in said.replace("photo of Ana.txt", "")


def test_session_files_people_and_marks_go_along(folder: Path, tmp_path: Path) -> None:
    done = made(folder, tmp_path)
    out, key = tmp_path / "OUT", key_of(done.key)
    code, shift = key["Ana Maria"]
    assert re.fullmatch(r"S[2-9A-HJ-NP-Z]{4}", code)
    place = out / "recordings" / code
    head = SessionHead.read(place)
    assert head is not None
    assert (head.subject, head.started_ms, head.consent, head.device) == (
        code,
        WHEN + 1000 * shift,
        "on file",
        "ble://",
    )
    assert head.protocol["say"] == f"{code}, press now"
    assert head.layout == json.loads(json.dumps(PLUSH.to_dict()))
    assert re.fullmatch(r"2\d{7}-\d{6}", head.session)
    take, note, mended = read_events(place)
    assert (place / take.details["file"]).is_file()
    assert (place / Path(take.details["file"]).with_suffix(".json")).is_file()
    assert mended.details == {"how": "torn last line cut off"}
    assert note.details["who"] == "person-1"
    assert note.details["text"].startswith(f"{code} cried on 2")
    assert key["P02"][0] in note.details["text"]
    sidecar = json.loads((place / Path(take.details["file"]).with_suffix(".json")).read_text())
    assert sidecar == {
        "host_ms": [WHEN + 1000 * shift, WHEN + 5.5 + 1000 * shift],
        "epoch_s": WHEN / 1000 + shift,
        "lost": 3,
        "ok": True,
    }
    people = read_people(out)
    assert set(people) == {key[p][0] for p in ("Ana Maria", "P02", "P09")}
    assert (people[code].age_group, people[code].consent) == ("child", "on file")
    standing = read_marks(out)
    assert set(standing) - {"", key["P02"][0]} < {r.id for r in done.dataset.recordings}
    assert key["P02"][0] in standing, "a mark of a person"
    lines = [json.loads(line) for line in (out / "marks.jsonl").read_text().splitlines()]
    assert {m["who"] for m in lines} == {"person-1", "plushsense trim"}
    assert f"{code} pulled the cable" in {m["why"] for m in lines}
    quiet = pseudonymise(folder, tmp_path / "OUT2", key=done.key, drop_notes=True)
    assert {json.loads(m)["why"] for m in (tmp_path / "OUT2" / "marks.jsonl").read_text().splitlines()} == {""}
    assert not any("free text" in f["message"] for f in quiet.findings)


def test_a_session_named_in_words_is_said_and_like_findings_are_one(folder: Path, tmp_path: Path) -> None:
    """What the recorder did is nobody's, and its name is no name that texts are searched for."""
    for kind in ("recordings", "streams"):
        for place in ("monday-anna", "2"):
            (folder / kind / "P02" / place).mkdir()
    for at, path in enumerate(sorted((folder / "recordings" / "P02").glob("*.csv"))):
        path.rename(path.parent / ("monday-anna", "2")[at % 2] / path.name)
    (folder / "index.json").unlink()
    ids = [r.id for r in open_dataset(folder).recordings if "anna" in r.id]
    append_marks(folder, [Mark(i, "exclude", "recorder", "Ana Maria moved") for i in ids])
    done = made(folder, tmp_path)
    messages = [f["message"] for f in done.findings]
    assert any("names of sessions" in m and "'monday-anna';" in m for m in messages)
    assert len(messages) == len({(f["file"], f["line"], f["message"]) for f in done.findings})
    assert any(m.startswith(f"{len(ids) + 1} times: a name or code") for m in messages)
    assert "recorder" in (tmp_path / "OUT" / "dataset.toml").read_text()
    assert '"who": "recorder"' in (tmp_path / "OUT" / MARKS).read_text()
    words = pseudonymise(folder, tmp_path / "OUT2", key=done.key, words=["anna"])
    assert not any("monday-anna" in f["message"] for f in words.findings)
    assert not list((tmp_path / "OUT2").rglob("*anna*"))


def test_the_key_is_added_to_and_a_person_keeps_the_code(folder: Path, tmp_path: Path) -> None:
    done = made(folder, tmp_path)
    first = key_of(done.key)
    if os.name == "posix":
        assert done.key.stat().st_mode & 0o777 == 0o600
    shutil.copytree(folder / "recordings" / "P02", folder / "recordings" / "P77")
    again = pseudonymise(folder, tmp_path / "OUT2", key=done.key)
    second = key_of(done.key)
    assert {k: second[k] for k in first} == first
    assert set(second) - set(first) == {"P77"}
    assert {r.id for r in done.dataset.recordings} < {r.id for r in again.dataset.recordings}
    assert any("same content" in f["message"] for f in again.findings)
    assert len({code for code, _ in second.values()}) == len({shift for _, shift in second.values()}) == len(second)


def test_a_key_beside_the_data_or_of_something_else_is_refused(folder: Path, tmp_path: Path) -> None:
    for place in (folder / "key.csv", tmp_path / "OUT" / "key.csv", folder / "cache" / "k" / "key.csv"):
        with pytest.raises(DatasetError, match="choose a place outside"):
            pseudonymise(folder, tmp_path / "OUT", key=place)
    with pytest.raises(DatasetError, match="outside of it"):
        pseudonymise(folder, folder / "OUT", key=tmp_path / "k.csv")
    other = tmp_path / "thesis.csv"
    for text in ("a,b\n1,2\n", "original,code,shift_s\nP01,SAAAA\n", "original,code,shift_s\nP01,SA,1\nP02,sa,1\n"):
        other.write_text(text)
        with pytest.raises(DatasetError, match=r"no key file|is no |twice"):
            pseudonymise(folder, tmp_path / "OUT", key=other)
        assert other.read_text() == text
    (tmp_path / "OUT").mkdir()
    (tmp_path / "OUT" / "mine.txt").write_text("x")
    with pytest.raises(DatasetError, match="already holds something"):
        pseudonymise(folder, tmp_path / "OUT", key=tmp_path / "k.csv")
    assert not (tmp_path / "k.csv").exists()


def test_a_name_in_a_label_stops_it_and_nothing_is_left(folder: Path, tmp_path: Path) -> None:
    source = open_dataset(folder)
    frames = source.read(source.recordings[0])
    write_recording(folder / "recordings" / "P02" / f"Wave of Ana Maria_{WHEN}_{len(frames)}.csv", frames, PLUSH)
    with pytest.raises(DatasetError, match="would still hold"):
        made(folder, tmp_path)
    assert not (tmp_path / "OUT").exists()
    assert not (tmp_path / "secret" / "key.csv").exists()
    assert [p.name for p in tmp_path.iterdir() if "unfinished" in p.name] == []


def test_malformed_lines_and_cut_streams_come_along(folder: Path, tmp_path: Path) -> None:
    path = next((folder / "streams" / "P02").glob("*.csv"))
    lines = path.read_text().splitlines()
    lines[5] = lines[5][: len(lines[5]) // 2]
    host = lines[9].split("; ")[13]
    lines[7] = "; ".join([*["0"] * 13, host[:8]])
    path.write_text("\n".join(lines) + "\n" + "; ".join([*["1"] * 13, host[:-4]]))
    (folder / "index.json").unlink()
    done = made(folder, tmp_path)
    code = key_of(done.key)["P02"][0]
    new = (tmp_path / "OUT" / "streams" / code / "fulldatastream.csv").read_text()
    assert len(new.splitlines()) == len(lines) + 1
    assert new.splitlines()[5] == lines[5]
    assert host[:8] not in new


def test_labelled_rows_move_their_clock(tmp_path: Path) -> None:
    layout = load_layout("phone-6")
    rng = np.random.default_rng(0)
    for person in ("s01", "s02"):
        (tmp_path / "src" / person).mkdir(parents=True)
        clock = WHEN + np.arange(200, dtype=np.int64) * 10
        labels = np.array(["SEATED"] * 100 + ["WALKING"] * 100)
        frames = Frames(rng.integers(-9000, 9000, (200, 6)), clock, None, labels)
        (tmp_path / "src" / person / f"{person}_01_sp.csv").write_text(format_rows(frames, layout))
    import_recordings(tmp_path / "src", tmp_path / "DS", layout="phone-6")
    done = made(tmp_path / "DS", tmp_path)
    old, new = open_dataset(tmp_path / "DS"), done.dataset
    code, shift = key_of(done.key)["s01"]
    assert (tmp_path / "OUT" / "streams" / code / f"{code}_01_sp.csv").is_file()
    a = next(r for r in old.recordings if r.subject == "s01" and r.gesture == "WALKING")
    b = next(r for r in new.recordings if r.subject == code and r.gesture == "WALKING")
    assert b.id == a.id.replace("s01", code)
    assert np.array_equal(old.read(a).device_ms + 1000 * shift, new.read(b).device_ms)
    assert np.array_equal(old.read(a).values, new.read(b).values)


@pytest.mark.skipif(sys.platform == "win32", reason="needs links")
def test_links_are_left_out_and_named(folder: Path, tmp_path: Path) -> None:
    (folder / "sessions").mkdir()
    (folder / "sessions" / "elsewhere").symlink_to(tmp_path, target_is_directory=True)
    assert any("sessions/elsewhere" in f["message"] for f in made(folder, tmp_path).findings)


def test_real_recordings_keep_their_numbers(real_data: Path, tmp_path: Path) -> None:
    for person in ("P05", "P11"):
        shutil.copytree(real_data / "makeability-gestures" / person, tmp_path / "src" / person)
    import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    done = made(tmp_path / "DS", tmp_path)
    old = open_dataset(tmp_path / "DS")
    for a, b in pairs(old, done.dataset, key_of(done.key)):
        assert np.array_equal(old.read(a).values, done.dataset.read(b).values)
        assert np.array_equal(old.read(a).device_ms, done.dataset.read(b).device_ms)
        assert (a.stream_row, a.flags) == (b.stream_row, b.flags)
    assert done.findings == []


def test_half_characters_in_session_files_stop_nothing(tmp_path: Path, session_writer: Callable[..., Path]) -> None:
    folder = session_writer(tmp_path / "src", redo=[0])
    log = folder / "session.jsonl"
    log.write_text(
        log.read_text().replace("sneezed", "\\ud800 sneezed") + '{"what": "note", "at_ms": 1, "text": "\\udc00"}\n'
    )
    ds = import_recordings(tmp_path / "src", tmp_path / "DS").dataset
    assert "\ufffd sneezed" in (ds.path / MARKS).read_text("utf-8")
    with (ds.path / MARKS).open("a") as file:
        file.write(
            json.dumps({"recording": ds.recordings[1].id, "action": "exclude", "who": "me", "why": "\ud800"}) + "\n"
        )
    done = pseudonymise(ds.path, tmp_path / "P", key=tmp_path / "key.csv")
    assert any("\ufffd" in p.read_text("utf-8") for p in done.dataset.path.rglob("session.jsonl"))
