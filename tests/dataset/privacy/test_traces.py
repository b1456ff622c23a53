"""The last look finds whatever was overlooked, wherever it stands."""

from pathlib import Path

import numpy as np
import pytest

from plushsense.dataset.privacy.pseudonymise import find_traces
from plushsense.dataset.privacy.redaction import NamePatterns

WHEN = 1_759_999_999_123
CLEAN = f"host; device; x\n{WHEN + 4_000_000_000_000}; 10; 7\n"


def looked(folder: Path) -> list[tuple[str, str]]:
    return list(
        find_traces(folder, ["ana"], NamePatterns({"ana": "S2222", "Ben Bo": "S3333"}), np.array([WHEN, WHEN + 10]))
    )


@pytest.mark.parametrize(
    ("file", "text", "what"),
    [
        ("recordings/ana/Pat_1_1.csv", CLEAN, "ana"),
        ("recordings/S2222/ben-bo/Pat_1_1.csv", CLEAN, "ben-bo"),
        ("recordings/S2222/2025-10-09/Pat_1_1.csv", CLEAN, "2025-10-09"),
        (f"recordings/S2222/Pat_{WHEN}_1.csv", CLEAN, str(WHEN)),
        ("recordings/S2222/Pat_1_1.csv", f"1; 2; 3\n{WHEN}; 10; 7\n", str(WHEN)),
        ("recordings/S2222/Pat_1_1.csv", "host; ana; x\n1; 2; 3\n", "ana"),
        ("streams/S2222/session.jsonl", '{"text": "Ben Bo came"}\n', "Ben Bo"),
        ("streams/S2222/session.jsonl", '{"text": "on 9.10.2025"}\n', "9.10.2025"),
        ("subjects.csv", "subject\nANA\n", "ANA"),
    ],
)
def test_a_trace_is_found(tmp_path: Path, file: str, text: str, what: str) -> None:
    clean = tmp_path / "recordings" / "S2222" / "Rub_1_1.csv"
    clean.parent.mkdir(parents=True)
    clean.write_text(CLEAN)
    assert looked(tmp_path) == []
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text(text)
    assert (file, what) in looked(tmp_path)
