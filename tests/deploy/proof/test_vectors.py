"""Opening an export to check it, and comparing what a toy wrote: the first number that differs is named."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError, PlushSenseError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.deploy.proof.vectors import Export, compare, recorded_frames
from support.exports import bundle_of, exported


def test_comparing_names_the_first_number_that_differs() -> None:
    labels = ("a", "b")
    expected = np.arange(60, dtype=np.int32).reshape(3, 20)
    expected[:, 0] = 0, 1, 2

    def seen(rows: np.ndarray, words: bytes = b"") -> tuple[int, int, str | None]:
        found = compare(expected, rows.astype("<i4").tobytes() + words, labels)
        assert found.vectors == 3
        return found.mismatches, found.max_abs_diff, found.first

    assert seen(expected) == (0, 0, None)
    one = expected.copy()
    one[1, 19] += 5
    one[2, 4] -= 9
    message = "row 1 (event, frame 21): the smoothed probability of 'b' should be 39 and is 44"
    assert seen(one) == (2, 9, message)
    logit = expected.copy()
    logit[0, 16] = -1
    assert seen(logit) == (1, 17, "row 0 (answer, frame 1): the logit of 'a' should be 16 and is -1")
    for row, column, name in ((0, 8, "answer"), (1, 8, "since"), (2, 5, "suspect"), (2, 2, "ms")):
        field, was = expected.copy(), int(expected[row, column])
        field[row, column] += 7
        kind = ("answer", "event", "health")[row]
        message = f"row {row} ({kind}, frame {20 * row + 1}): '{name}' should be {was} and is {was + 7}"
        assert seen(field) == (1, 7, message)
    assert seen(expected[:2]) == (1, 0, "row 2 (health, frame 41) is missing")
    assert seen(np.concatenate([expected, expected[:1]])) == (1, 0, "row 3 (answer, frame 1) is one too many")
    assert seen(expected, b"Something.") == (1, 0, "Something")
    assert seen(expected[:0], b"Nothing.") == (3, 0, "Nothing; row 0 (answer, frame 1) is missing")
    far = expected.copy()
    far[0, 16], high = -(1 << 31), (1 << 31) - 1
    assert compare(np.full_like(far, high), far.astype("<i4").tobytes(), labels).max_abs_diff == 2**32 - 1


BAD = [
    (lambda o: (o / "plushsense.c").unlink(), "lacks plushsense.c"),
    (lambda o: (o / "plush_model.bin").unlink(), "lacks plush_model.bin"),
    (lambda o: (o / "model.plush").unlink(), "lacks model.plush"),
    (lambda o: (o / "export.json").unlink(), "is no export"),
    (lambda o: (o / "export.json").write_text("{"), "cannot be read"),
    (lambda o: (o / "golden" / "frames.bin").unlink(), "cannot be read"),
    (lambda o: (o / "golden" / "frames.bin").write_bytes(b"abc"), "no whole rows of 14 numbers"),
    (lambda o: (o / "golden" / "answers.bin").write_bytes(bytes(4)), "no whole rows of 52 numbers"),
    (lambda o: (o / "model.plush").write_bytes(b"abc"), "model.plush"),
]


@pytest.mark.parametrize(("how", "words"), BAD, ids=[words for _, words in BAD])
def test_an_export_that_is_none(own: Path, how: Callable[[Path], object], words: str) -> None:
    how(own)
    with pytest.raises(PlushSenseError, match=re.escape(words)) as refusal:
        Export(own)
    assert "\n" not in str(refusal.value)


def test_golden_vectors_of_another_model_or_damaged(own: Path, tmp_path: Path) -> None:
    other = exported(tmp_path / "other", bundle_of("plush-15", seed=4))
    shutil.copyfile(other / "golden" / "answers.bin", own / "golden" / "answers.bin")
    with pytest.raises(BadInput, match="are not those of model.plush"):
        Export(own)
    shutil.rmtree(own / "golden")
    shutil.copytree(other / "golden", own / "golden")
    frames = bytearray((other / "golden" / "frames.bin").read_bytes())
    for at in range(9000, 9400, 4):  # some of them garbage already
        frames[at] ^= 16
    (other / "golden" / "frames.bin").write_bytes(bytes(frames))
    for folder in (own, other):
        with pytest.raises(BadInput, match=r"they are damaged, or of another model \(row "):
            Export(folder)


def test_recordings_give_as_many_rows_each_with_pauses_between_them(tmp_path: Path) -> None:
    layout = load_layout("accel-3")
    for n, (person, rows) in enumerate((("ana", 200), ("ben", 30), ("cleo", 100))):
        (tmp_path / "src" / person).mkdir(parents=True)
        row = np.arange(rows)
        frames = Frames(np.stack([row, row * 0 + n, row * 0], axis=1), 7000 + row * 10, 1_000_000 + row * 10)
        write_recording(tmp_path / "src" / person / f"Wave_{n}_{rows}.csv", frames, layout)
    dataset = import_recordings(tmp_path / "src", tmp_path / "DS", layout=layout).dataset

    def taken(rows: int, *people: str) -> tuple[list[int], np.ndarray]:
        frames = recorded_frames(dataset, layout, subjects=people, rows=rows)
        return [int((frames[:, 2] == n).sum()) for n in range(3)], frames

    assert taken(90)[0] == [30, 30, 30] and taken(1000)[0] == [200, 30, 100]
    assert taken(150)[0] == [60, 30, 60], "what one lacks, the others give"
    assert sum(taken(2)[0]) == 2 and max(taken(2)[0]) == 1 and taken(0)[1].shape == (0, 4)
    found, frames = taken(40, "ana", "cleo")
    assert found == [20, 0, 20] and frames[:20, 1].tolist() == [*range(20)]
    steps = np.diff(frames[:, 0])
    assert frames[0, 0] == 1000 and steps[19] == layout.gap_ms + 1000 and set(np.delete(steps, 19)) == {10}
    with pytest.raises(ConfigError, match="has nobody 'anna': accepted are ana, ben, cleo.*Did you mean 'ana'"):
        taken(1, "anna")
    with pytest.raises(ConfigError, match=r"holds layout 'accel-3' \(x, y, z\), but the model reads 'phone-6'"):
        recorded_frames(dataset, load_layout("phone-6"), rows=1)
