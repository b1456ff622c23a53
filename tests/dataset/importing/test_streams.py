"""People of anonymised recordings, found in the streams that the authors' scripts leave in the people's folders."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset.importing.importers import import_recordings, preview_import
from plushsense.dataset.importing.results import ImportResult
from plushsense.scoring.splits import make_folds, parse_split
from plushsense.windows.cut import WindowSpec, cut_windows
from support import paper_scripts as scripts

pytestmark = pytest.mark.slow

Places = dict[tuple[str, int], tuple[str, str, int]]
"""Person, stream and row of each recording, by its gesture and the time of its first row."""


def places(done: ImportResult) -> Places:
    return {(r.gesture, r.epoch_ms): (r.subject, r.stream, r.stream_row + r.start) for r in done.dataset.recordings}


@pytest.fixture
def study(tmp_path: Path) -> tuple[Path, Places]:
    """A study after the first script, and what its recordings are."""
    root = tmp_path / "study"
    scripts.record(root, at_rest=2)
    known = places(import_recordings(root / scripts.SESSIONS, tmp_path / "KNOWN"))
    scripts.move_by_label(root)
    return root, known


@pytest.mark.parametrize("truncated", [False, True])
def test_every_recording_is_found(
    study: tuple[Path, Places], tmp_path: Path, cli: Callable[..., Any], truncated: bool
) -> None:
    root, known = study
    labelled, streams = root / scripts.LABELLED, root / scripts.SESSIONS
    if truncated:
        # 40 rows are cut off, and the header with them.
        scripts.truncate(root, {p.name: (0, 40) for p in labelled.rglob("*.csv")})
    ran = cli("import", labelled, tmp_path / "DS", "--streams", streams)
    assert ran.status == 0
    assert (
        "20 of 20 recordings are found in the streams of 'Training Data', and have their people from there: this "
        "undoes the anonymisation of the recordings"
    ) in ran.err
    assert "people are not known" not in ran.err and "rejected" not in ran.err
    done = import_recordings(labelled, tmp_path / "AGAIN", streams=streams)
    assert {r.id.partition("/")[0] for r in done.dataset.recordings} == {"P01", "P02", "P03", "none"}
    assert done.dataset.subjects == ["P01", "P02", "P03"] and done.streams == 4
    found = sorted((subject, stream, row) for subject, stream, row in places(done).values())
    assert found == sorted((who, stream, row + 40 * truncated) for who, stream, row in known.values())
    windows = cut_windows(done.dataset, WindowSpec(context="stream"))
    folds = make_folds(parse_split("leave-one-subject-out"), windows.subject, windows.y)
    assert [f.name for f in folds] == ["P01", "P02", "P03"]
    assert preview_import(labelled, streams=streams).subjects == ["P01", "P02", "P03", "none"]


def test_what_is_in_no_stream_or_in_two_has_no_person(study: tuple[Path, Places], tmp_path: Path) -> None:
    root, known = study
    streams = root / scripts.SESSIONS
    shutil.rmtree(streams / "P02")
    shutil.copytree(streams / "P03", streams / "copy of P03")
    done = import_recordings(root, tmp_path / "DS", streams=streams)
    people = {key: who for key, (who, _, _) in places(done).items()}
    assert people == {key: "unknown" if who in ("P02", "P03") else who for key, (who, _, _) in known.items()}
    assert any(note.startswith("8 of 20 recordings are found") for note in done.notes)
    assert any(note.startswith("in none of the streams, so without a person (6): ") for note in done.notes)
    (two,) = (note for note in done.notes if note.startswith("in the streams of several people"))
    assert "without a person (6)" in two and "(P03, copy of P03)" in two
    assert not [e for e in done.rejected if "fulldatastream" in e.file], "the streams of the study are imported"
    assert done.streams == 4 and done.dataset.head.simulated


def test_streams_that_cannot_be_used(study: tuple[Path, Places], tmp_path: Path) -> None:
    root, _ = study
    labelled, streams = root / scripts.LABELLED, root / scripts.SESSIONS
    import_recordings(labelled, tmp_path / "DS")
    with pytest.raises(ConfigError, match="leave .* --streams out"):
        import_recordings(labelled, tmp_path / "DS", streams=streams, add_to=True)
    with pytest.raises(ConfigError, match="leave --subjects, --pattern and a person out"):
        import_recordings(labelled, tmp_path / "X", streams=streams, person="P01")
    with pytest.raises(DatasetError, match=r"no fulldatastream.csv: --streams names"):
        import_recordings(labelled, tmp_path / "X", streams=labelled)
    with pytest.raises(DatasetError, match="There is no folder"):
        import_recordings(labelled, tmp_path / "X", streams=root / "other")
    scripts.record(tmp_path / "named", people=1)
    with pytest.raises(DatasetError, match="the source has none: leave it out"):
        import_recordings(tmp_path / "named", tmp_path / "X", streams=streams)
    scripts.record(tmp_path / "others", people=1, seed=9)
    with pytest.raises(DatasetError, match="None of 20 recordings is in a stream of '.*others.*': give --streams"):
        import_recordings(labelled, tmp_path / "X", streams=tmp_path / "others" / scripts.SESSIONS)
    assert not (tmp_path / "X").exists()


def test_some_recordings_whose_people_are_not_known_are_counted(study: tuple[Path, Places], tmp_path: Path) -> None:
    root, _ = study
    moved = next(p for p in (root / scripts.LABELLED).rglob("*.csv") if "At rest" not in p.name)
    scripts.record(tmp_path / "named", people=2)
    (tmp_path / "named" / scripts.SESSIONS / moved.parent.name).mkdir()
    shutil.copy(moved, tmp_path / "named" / scripts.SESSIONS / moved.parent.name / moved.name)
    done = import_recordings(tmp_path / "named" / scripts.SESSIONS, tmp_path / "DS")
    n = done.recordings
    assert any(note.startswith(f"the people of 1 of {n} recordings are not known") for note in done.notes)
