"""Whether the sensors can be believed: every rule of the room's docstring, each by frames that show it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any

import pytest

from plushsense.core.errors import BundleError, ConfigError
from plushsense.core.layouts import load_layout
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.health import MOST_MS, Health, HealthSettings

ACCEL = load_layout("accel-3")
LOW, HIGH = int(ACCEL.valid_min_int[0]), int(ACCEL.valid_max_int[0])
Timed = tuple[int, tuple[int, ...]]
SETTINGS = HealthSettings((-900, -900, -900), (900, 900, 900), fault_ms=200, still_ms=300, recover_ms=100)


def trembling(at: int, **fixed: int) -> tuple[int, int, int]:
    """A frame of a toy that lives: no two in a row are equal."""
    return fixed.get("x", at % 7), fixed.get("y", -(at % 5)), fixed.get("z", 250 + at % 3)


def followed(frames: Iterable[Timed], settings: HealthSettings = SETTINGS) -> list[tuple[int, str, bool, bool]]:
    """(ms, what was said, fault, suspect) of every frame."""
    health = Health(settings, ACCEL)
    return [(ms, health.push(ms, values), health.fault, health.suspect) for ms, values in frames]


def said(frames: Iterable[Timed], settings: HealthSettings = SETTINGS) -> list[tuple[int, str]]:
    return [(ms, word) for ms, word, _, _ in followed(frames, settings) if word]


def test_a_living_toy_is_believed() -> None:
    found = followed((10 * i, trembling(i)) for i in range(200))
    assert not any(word or fault or suspect for _, word, fault, suspect in found)


@pytest.mark.parametrize("wrong", [HIGH + 1, LOW - 1])
def test_a_value_out_of_its_valid_range_is_wrong_at_once_and_a_fault_after_fault_ms(wrong: int) -> None:
    # It need not repeat.
    found = followed((10 * i, trembling(i, y=wrong + (i % 2) * (1 if wrong > 0 else -1))) for i in range(30))
    assert [suspect for _, _, _, suspect in found] == [True] * 30
    assert [(ms, word) for ms, word, _, _ in found if word] == [(200, "fault")]
    assert [fault for _, _, fault, _ in found] == [False] * 20 + [True] * 10


def test_the_ends_of_the_valid_range_and_of_the_limits_are_inside() -> None:
    free = replace(SETTINGS, low=(), high=())
    assert not followed(((10 * i, trembling(i, x=HIGH, y=LOW)) for i in range(60)), free)[-1][3]
    assert not followed((10 * i, trembling(i, x=900, y=-900)) for i in range(60))[-1][3]


def test_a_value_beyond_the_limits_is_wrong_when_it_repeats_exactly() -> None:
    for stuck in (901, -901):
        found = followed((10 * i, trembling(i, x=stuck)) for i in range(30))
        assert [suspect for _, _, _, suspect in found] == [False] + [True] * 29, "the first time it may be a hard touch"
        assert [(ms, word) for ms, word, _, _ in found if word] == [(210, "fault")]
    moving = followed((10 * i, trembling(i, x=901 + i % 2)) for i in range(100))
    assert not any(suspect for *_, suspect in moving)
    unknown = followed(((10 * i, trembling(i, x=901)) for i in range(100)), replace(SETTINGS, low=(), high=()))
    assert not any(suspect for *_, suspect in unknown), "where the limits are not known it may stay"


def test_wrong_is_counted_without_a_break_but_not_always_of_the_same_channel() -> None:
    bad = HIGH + 1
    turns = ((10 * i, trembling(i, **{"xyz"[i % 3]: bad})) for i in range(30))
    assert said(turns) == [(200, "fault")]
    broken = ((10 * i, trembling(i, x=0 if i % 20 == 19 else bad)) for i in range(100))
    assert said(broken) == [], "180 ms, then a good frame, and so on"


def test_a_toy_that_is_still_is_suspect_after_half_the_time_and_then_a_fault() -> None:
    found = followed((10 * i, trembling(0) if i >= 10 else trembling(i)) for i in range(60))
    # The tenth frame is the last that repeats nothing: stillness counts from it.
    assert next(ms for ms, _, _, suspect in found if suspect) == 100 + 150
    assert [(ms, word) for ms, word, _, _ in found if word] == [(400, "fault")]
    one_moves = ((10 * i, trembling(0, z=i % 2)) for i in range(100))
    assert not any(word or suspect for _, word, _, suspect in followed(one_moves))
    short = ((10 * i, trembling(0) if i % 30 else trembling(1)) for i in range(200))
    assert said(short) == [], "every 300 ms it moves"


def test_a_time_of_0_switches_its_rule_off() -> None:
    bad = [(10 * i, trembling(i, x=HIGH + 1)) for i in range(300)]
    assert said(bad, replace(SETTINGS, fault_ms=0)) == []
    assert followed(bad, replace(SETTINGS, fault_ms=0))[-1][3], "it is suspect all the same"
    still = [(10 * i, trembling(0)) for i in range(300)]
    assert not any(word or suspect for _, word, _, suspect in followed(still, replace(SETTINGS, still_ms=0)))


def test_it_recovers_when_no_frame_was_suspect_for_recover_ms() -> None:
    bad = HIGH + 1

    def frames(until: int, breaks: tuple[int, ...] = ()) -> list[Timed]:
        return [(10 * i, trembling(i, x=bad if i < until or i in breaks else 1)) for i in range(120)]

    assert said(frames(40)) == [(200, "fault"), (500, "recovered")]
    assert said(frames(40, (45, 54))) == [(200, "fault"), (650, "recovered")]
    assert said(frames(40), replace(SETTINGS, recover_ms=0)) == [(200, "fault"), (400, "recovered")]
    # At rest a frame now and then repeats the one before: that keeps nobody away.
    rest = [(10 * i, trembling(i, x=bad) if i < 40 else trembling(i // 2)) for i in range(120)]
    assert said(rest) == [(200, "fault"), (500, "recovered")]


def test_a_fault_may_come_again_and_is_counted() -> None:
    health = Health(SETTINGS, ACCEL)
    words = [health.push(10 * i, trembling(i, x=HIGH + 1 if i % 80 < 40 else 1)) for i in range(240)]
    assert [word for word in words if word] == ["fault", "recovered"] * 3
    assert health.faults == 3
    health.reset()
    assert (health.faults, health.fault, health.suspect) == (0, False, False)


def test_after_a_gap_all_times_are_counted_anew_but_a_fault_goes_on() -> None:
    bad = HIGH + 1
    health = Health(SETTINGS, ACCEL)
    for i in range(15):
        assert health.push(10 * i, trembling(i, x=bad)) == ""
    health.clear()
    assert not health.suspect
    words = [health.push(500 + 10 * i, trembling(i, x=bad)) for i in range(30)]
    assert words.index("fault") == 20, "the 140 ms before the gap do not count"
    for i in range(9):
        assert health.push(900 + 10 * i, trembling(i)) == ""
    health.clear()
    assert health.fault
    # The clock was reset: the good time counts from here on.
    words = [health.push(10 * i, trembling(i)) for i in range(30)]
    assert words.index("recovered") == 10 and not health.fault
    # What repeats the frame before a gap repeats nothing.
    health.push(300, trembling(0, x=901))
    health.clear()
    health.push(0, trembling(0, x=901))
    assert not health.suspect


def test_plain_values_and_back() -> None:
    assert DecideSpec.from_dict({"health": asdict(SETTINGS)}).health == SETTINGS
    assert DecideSpec.from_dict({"health": {}}).health == HealthSettings()
    with pytest.raises(ConfigError, match="Unknown key 'fault' in decision settings, health"):
        DecideSpec.from_dict({"health": {"fault": 3}})
    with pytest.raises(ConfigError, match=r"health\.low is 3: accepted is a list of whole numbers"):
        DecideSpec.from_dict({"health": {"low": 3, "high": 4}})


@pytest.mark.parametrize(
    "table",
    [
        {"fault_ms": -1}, {"still_ms": MOST_MS + 1}, {"recover_ms": 1.5}, {"fault_ms": True},
        {"low": (1,)}, {"low": (2,), "high": (1,)}, {"low": (-(1 << 31) - 1,), "high": (0,)},
    ],
)  # fmt: skip
def test_what_the_toy_could_not_hold_is_refused(table: dict[str, Any]) -> None:
    with pytest.raises(BundleError):
        HealthSettings(**table)


def test_limits_of_another_layout_are_refused() -> None:
    with pytest.raises(BundleError, match="2 channels, the layout has 3"):
        Health(HealthSettings((0, 0), (1, 1)), ACCEL)
