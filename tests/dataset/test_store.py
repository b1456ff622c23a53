"""What a data set's files rest on."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest

from plushsense.dataset.store import write_atomically


@pytest.mark.skipif(sys.platform == "win32", reason="Windows refuses to replace a file that is being replaced")
def test_threads_that_write_one_file_at_once_leave_one_of_their_texts(tmp_path: Path) -> None:
    path = tmp_path / "index.csv"
    texts = [letter * 100_000 for letter in "abcd"]
    failed: list[OSError] = []

    def write(text: str) -> None:
        try:
            for _ in range(30):
                write_atomically(path, text)
        except OSError as cause:
            failed.append(cause)

    threads = [threading.Thread(target=write, args=(text,)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert path.read_text(encoding="utf-8") in texts
    assert [p.name for p in tmp_path.iterdir()] == ["index.csv"]
