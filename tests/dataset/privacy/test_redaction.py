import pytest

from plushsense.dataset.privacy.redaction import NO_ADDRESS, NamePatterns, is_searchable, without_addresses


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        ("P01 was tired", "SAAAA was tired"),
        ("p_01, P-01 and p 01", "SAAAA, SAAAA and SAAAA"),
        ("ana maria laughed; ANA_MARIA; AnaMaria", "SBBBB laughed; SBBBB; SBBBB"),
        ("P011 xP01 P01x Tail tap 01", "P011 xP01 P01x Tail tap 01"),
        ("José", "SCCCC"),
        ("José", "SCCCC"),
        ("it's 1 o'clock, s1 and S_1", "it's 1 o'clock, SDDDD and SDDDD"),
    ],
)
def test_names_are_found_in_any_spelling(text: str, clean: str) -> None:
    names = NamePatterns({"P01": "SAAAA", "Ana_Maria": "SBBBB", "José": "SCCCC", "S1": "SDDDD"})
    assert names.replace(text)[0] == clean
    assert bool(names.find_in(text)) == (clean != text)


def test_what_is_too_short_is_said_and_not_looked_for() -> None:
    names = NamePatterns({"7": "SAAAA", "a": "SBBBB", "P1": "SCCCC"})
    assert names.too_short == ["7", "a"]
    assert names.replace("a 7 P1") == ("a 7 SCCCC", ["SCCCC"])
    assert [is_searchable(w) for w in ("12345", "1234", "bo", "_")] == [True, False, True, False]
    assert NamePatterns({}).replace("P1") == ("P1", [])


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        ("serial:///dev/ttyUSB0?baud=115200", "serial://"),
        ("ble://AA:BB:CC:DD:EE:FF", "ble://"),
        ("toy AA:BB:CC:DD:EE:0f here", f"toy {NO_ADDRESS} here"),
        ("/dev/ttyACM0", NO_ADDRESS),
        (r"C:\Users\ana\x and COM3", f"{NO_ADDRESS} and {NO_ADDRESS}"),
        ("/home/ana/rec", NO_ADDRESS),
        ("m/s and 10:15:00 and https://x.org/tmp", "m/s and 10:15:00 and https://x.org/tmp"),
    ],
)
def test_addresses_go(text: str, clean: str) -> None:
    assert without_addresses(text) == clean
