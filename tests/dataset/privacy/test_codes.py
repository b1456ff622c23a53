"""The code of a person is proposed, and questioned if it may be that of another person, or a name."""

from __future__ import annotations

from pathlib import Path

import pytest

from plushsense.dataset.privacy.codes import HomeCodes, looks_like_name
from plushsense.dataset.privacy.removed import RemovedCodes, remember_removed


@pytest.fixture
def codes(tmp_path: Path) -> HomeCodes:
    for code in ("S03", "S-5"):
        remember_removed(tmp_path, code)
    return HomeCodes(("P1", "Anna2015", "S01"), frozenset({"S02", "s4", "none"}), RemovedCodes.read(tmp_path))


def test_the_next_free_code_continues_those_of_the_sessions(codes: HomeCodes) -> None:
    assert codes.next_free() == "S06"
    for recorded, free in (((), "S01"), (("P009",), "P010"), (("S99",), "S100"), (("kid-7", "x"), "kid-8")):
        assert HomeCodes(recorded, frozenset(), RemovedCodes()).next_free() == free


def test_another_spelling_a_name_and_a_removed_code_are_questioned(codes: HomeCodes) -> None:
    for code, answers in {
        "s01": ["S01", "S06"], "S1": ["S01", "S06"], "S-02": ["S02", "S06"], "S04": ["s4", "S06"],
        "S03": ["S06", "S03"], "s05": ["S06", "s05"], "Peter7": ["S06", "Peter7"],
    }.items():  # fmt: skip
        doubt = codes.doubt(code)
        assert doubt is not None and [answer for _, answer in doubt.answers] == answers, code
    for fine in ("S01", "S06", "P2", "Anna2015", "none"):
        assert codes.doubt(fine) is None, fine
    assert all(map(looks_like_name, ("Anna2015", "anna-1", "xyz")))
    assert not any(map(looks_like_name, ("S01", "child12", "Participant-3", "Bērns1", "AB-12")))
