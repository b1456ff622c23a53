"""``plushsense report`` on a sweep's folder, as a user meets it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from support.made_sweep import make_sweep

ONE: dict[str, Any] = {"archs": ("250",), "filter_sets": ((4, 6, 8, 8),), "epochs": (5,), "batches": ("64",)}


def test_a_sweeps_folder_makes_its_page(cli: Callable[..., Any], tmp_path: Path) -> None:
    folder = make_sweep(tmp_path / "S", **ONE)
    done = cli("report", folder, "--json").json
    assert (done["trials"], done["done"], done["mlflow"]) == (1, 1, None)
    assert Path(done["report"]) == folder / "report.html" and Path(done["files"], "table-4.csv").is_file()
    page = tmp_path / "other.html"
    ran = cli("report", folder, "--page", page, "--title", "Mine")
    assert ran.status == 0 and f"{page}: 1 of 1 trial" in ran.out
    assert "<h1>Mine</h1>" in page.read_text(encoding="utf-8")
    assert (tmp_path / "other-files" / "table-4.csv").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{none}"], "not a folder written by sweep, and --dataset is missing"),
        (["{tmp}/x.html", "--dataset", "{none}", "--mlflow", "{none}"], "--page and --mlflow are for a sweep"),
        (["{sweep}", "--dataset", "{none}"], "is a sweep"),
        (["{sweep}", "--page", "{tmp}/x.docx"], "does not end in .html"),
    ],
)
def test_what_does_not_fit_is_refused(cli: Callable[..., Any], tmp_path: Path, words: list[str], said: str) -> None:
    places = {"none": tmp_path / "none", "tmp": tmp_path, "sweep": make_sweep(tmp_path / "S", **ONE)}
    ran = cli("report", *(w.format(**places) for w in words))
    assert ran.status == 2 and said in ran.err and ran.out == ""
    assert not (tmp_path / "x.html").exists()
