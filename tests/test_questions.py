"""The programs on the page of questions run one after the other, on a data set of the virtual toy."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from plushsense.workflow.api import simulate

pytestmark = pytest.mark.apart("pages")

PAGE = Path(__file__).parents[1] / "docs" / "questions.md"


@pytest.mark.slow
@pytest.mark.exhaustive
def test_every_program_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    simulate(tmp_path / "RECORDINGS", people=4, repetitions=1, dataset=tmp_path / "DS")
    names: dict[str, object] = {}
    programs = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.S)
    assert len(programs) == 5
    for program in programs:
        exec(compile(program.replace("epochs=4", "epochs=1"), str(PAGE), "exec"), names)
    printed = capsys.readouterr().out
    assert "33,520 multiply-accumulates" in printed
    assert re.search(r"[1-9][\d,]+ answers compared, 0 differ", printed)
    assert "windows:2 (leaky)" in printed
