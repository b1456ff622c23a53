import pytest

from plushsense.dataset.privacy.searching import NamePatterns, is_searchable


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("P01 was tired", ["P01"]),
        ("p_01, P-01 and p 01", ["p_01", "P-01", "p 01"]),
        ("ana maria laughed; ANA_MARIA; AnaMaria", ["ana maria", "ANA_MARIA", "AnaMaria"]),
        ("P011 xP01 P01x Tail tap 01", []),
        ("José", ["José"]),
        ("Jose\u0301", ["José"]),
        ("it's 1 o'clock, s1 and S_1", ["s1", "S_1"]),
        ("a 7", []),
    ],
)
def test_names_are_found_in_any_spelling(text: str, found: list[str]) -> None:
    assert NamePatterns(["P01", "Ana_Maria", "José", "S1", "7", "a"]).find_in(text) == found


def test_what_is_too_short_is_not_looked_for() -> None:
    assert [is_searchable(w) for w in ("12345", "1234", "bo", "_")] == [True, False, True, False]
    assert NamePatterns([]).find_in("P1") == []
