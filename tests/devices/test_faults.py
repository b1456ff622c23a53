"""Every fault of a scenario, as a program that reads the toy meets it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.devices.base import Counters
from plushsense.devices.virtual.faults import CLOCK, FAULTS, Fault
from plushsense.devices.virtual.scenario import ScenarioPart, ToyScenario
from plushsense.devices.virtual.stream import ToySpec, ToyStream, received
from plushsense.devices.virtual.world import CHANNELS

PLUSH = load_layout("plush-15")
BEGIN_S, LENGTH_S = 3.0, 1.0
Row = tuple[int, tuple[int, ...]]


@dataclass(frozen=True)
class Reading:
    """What a reader gets: its frames, the time since the first line at which each arrived, and its counters."""

    frames: list[Row]
    passed_ms: list[int]
    counters: Counters


def reading(*faults: Fault, layout: str = "plush-15", **more: float) -> Reading:
    """A toy that nobody touches for six seconds, with these faults and no others."""
    parts = (ScenarioPart("idle", duration_s=6.0),)
    scenario = ToyScenario(parts, lost=0.0, garbled=0.0, glitch=0.0, faults=faults, **more)
    frames: list[Row] = []
    passed = []
    total = Counters()
    for line, read, counters in received(ToySpec.of(scenario), load_layout(layout)):
        frames += [(frame.device_ms, frame.values) for frame in read]
        passed += [line.passed_ms] * len(read)
        total = counters
    return Reading(frames, passed, total)


@pytest.fixture(scope="module")
def clean() -> Reading:
    whole = reading()
    assert whole.counters == Counters(frames=len(whole.frames))
    assert np.diff(whole.passed_ms).min() >= 9
    return whole


def within(clean: Reading) -> slice:
    """The frames of the fault."""
    begin, end = np.searchsorted(clean.passed_ms, [1000 * BEGIN_S, 1000 * (BEGIN_S + LENGTH_S)]).tolist()
    return slice(begin, end)


def fault(kind: str, **more: object) -> Fault:
    return Fault(kind, BEGIN_S, LENGTH_S, **more)  # type: ignore[arg-type]


def channel(rows: list[Row], name: str) -> np.ndarray:
    return np.array([values[CHANNELS.index(name)] for _, values in rows])


def others(rows: list[Row], *names: str) -> np.ndarray:
    return np.array([[v for n, v in zip(CHANNELS, values, strict=True) if n not in names] for _, values in rows])


def check_stuck(clean: Reading) -> None:
    got, where = reading(fault("stuck", channels=("ears", "acc_x"))), within(clean)
    for name in ("ears", "acc_x"):
        assert set(channel(got.frames[where], name)) == {channel(clean.frames, name)[where.start]}
        assert np.array_equal(channel(got.frames[where.stop :], name), channel(clean.frames[where.stop :], name))
    assert np.array_equal(others(got.frames, "ears", "acc_x"), others(clean.frames, "ears", "acc_x"))
    assert got.counters == clean.counters
    still = reading(fault("stuck")).frames[where]
    assert len({values for _, values in still}) == 1


def check_dead(clean: Reading) -> None:
    got, where = reading(fault("dead", channels=("ears",))), within(clean)
    assert set(channel(got.frames[where], "ears")) == {0}
    assert np.array_equal(others(got.frames, "ears"), others(clean.frames, "ears"))
    assert got.counters == clean.counters
    broken = reading(fault("dead", channels=("ears",), value=-3000))
    assert broken.counters.garbage == where.stop - where.start


def check_noisy(clean: Reading) -> None:
    got, where = reading(fault("noisy", channels=("belly",), counts=100.0)), within(clean)
    added = channel(got.frames, "belly") - channel(clean.frames, "belly")
    assert 50 < added[where].std() < 200
    assert not added[: where.start].any() and not added[where.stop :].any()
    assert np.array_equal(others(got.frames, "belly"), others(clean.frames, "belly"))


def check_glitch(clean: Reading) -> None:
    got, where = reading(fault("glitch", share=0.5)), within(clean)
    changed = [n for n, (a, b) in enumerate(zip(got.frames, clean.frames, strict=True)) if a != b]
    assert got.counters.garbage == len(changed) > 10
    assert where.start <= min(changed) and max(changed) < where.stop


def check_torn(clean: Reading) -> None:
    got, where = reading(fault("torn")), within(clean)
    n = where.stop - where.start
    assert got.frames == clean.frames[: where.start] + clean.frames[where.stop :]
    assert (got.counters.malformed, got.counters.lost) == (n, n)
    some = reading(fault("torn", share=0.2)).counters
    assert 0 < some.malformed == some.lost < n


def check_garbled(clean: Reading) -> None:
    got, where = reading(fault("garbled", share=0.3)), within(clean)
    assert got.frames[: where.start] == clean.frames[: where.start]
    # The last one may have been joined to the first line after it.
    after = clean.frames[where.stop + 1 :]
    assert got.frames[-len(after) :] == after
    assert got.counters.lost == len(clean.frames) - len(got.frames) > 10
    assert 10 < got.counters.malformed <= got.counters.lost


def check_junk(clean: Reading) -> None:
    got, where = reading(fault("junk")), within(clean)
    assert got.frames == clean.frames
    assert (got.counters.malformed, got.counters.lost) == (where.stop - where.start, 0)


def check_repeated(clean: Reading, times: int, got: Reading) -> None:
    where = within(clean)
    doubled = [row for row in clean.frames[where] for _ in range(times)]
    assert got.frames == clean.frames[: where.start] + doubled + clean.frames[where.stop :]
    assert got.counters == Counters(frames=len(got.frames))


def check_duplicated(clean: Reading) -> None:
    check_repeated(clean, 2, reading(fault("duplicated")))


def check_flood(clean: Reading) -> None:
    check_repeated(clean, 30, reading(fault("flood", times=30)))


def check_unended(clean: Reading) -> None:
    where = within(clean)
    for got in (reading(fault("unended")), reading(fault("unended", bytes=5000))):
        assert got.frames == clean.frames[: where.start] + clean.frames[where.stop + 1 :]
        assert (got.counters.malformed, got.counters.lost) == (1, where.stop + 1 - where.start)


def check_lost(clean: Reading) -> None:
    got, where = reading(fault("lost")), within(clean)
    assert got.frames == clean.frames[: where.start] + clean.frames[where.stop :]
    assert got.counters == Counters(frames=len(got.frames), lost=where.stop - where.start)


def check_stall(clean: Reading) -> None:
    got, where = reading(fault("stall")), within(clean)
    assert got.frames == clean.frames
    assert got.counters == clean.counters
    assert set(got.passed_ms[where]) == {clean.passed_ms[where.stop]}, "all at once, with the first line after it"
    # One that does not end before the toy does.
    assert reading(Fault("stall", BEGIN_S, 100.0)).frames == clean.frames


def check_reset(clean: Reading) -> None:
    got, where = reading(fault("reset")), within(clean)
    assert got.frames[: where.start] == clean.frames[: where.start]
    after = got.frames[where.start :]
    assert after[0][0] == 0
    assert [values for _, values in after] == [values for _, values in clean.frames[where.stop :]]
    steps = np.diff([ms for ms, _ in after])
    assert np.array_equal(steps, np.diff([ms for ms, _ in clean.frames[where.stop :]]))
    assert got.counters == Counters(frames=len(got.frames))
    again = reading(fault("reset"), Fault("reset", 4.5, 0.1))
    assert [ms for ms, _ in again.frames].count(0) == 2


def check_disconnect(clean: Reading) -> None:
    got, where = reading(fault("disconnect")), within(clean)
    assert got.frames == clean.frames[: where.start] + clean.frames[where.stop :]
    assert got.counters.reconnects == 1


CHECKS: dict[str, Callable[[Reading], None]] = {
    name.removeprefix("check_"): check
    for name, check in globals().items()
    if name.startswith("check_") and name != "check_repeated"
}


@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.slow
def test_a_fault_is_what_the_documents_say(kind: str, clean: Reading) -> None:
    CHECKS[kind](clean)


def test_the_clock_wraps_at_32_bits(clean: Reading) -> None:
    got = reading(wrap_s=2.0)
    before = sum(passed < 2000 for passed in clean.passed_ms)
    clocks = [ms for ms, _ in got.frames]
    assert clocks[before - 1] > CLOCK - 20 and clocks[before] < 20
    assert (np.diff(clocks) % CLOCK).tolist() == np.diff(clean.passed_ms).tolist()
    assert [values for _, values in got.frames] == [values for _, values in clean.frames]
    assert got.counters == clean.counters
    # After a reset, this wrap does not come.
    clocks = [ms for ms, _ in reading(Fault("reset", 1.0, 0.5), wrap_s=2.0).frames]
    assert sum(np.diff(clocks) < 0) == 1 and max(clocks[-100:]) < 5000


def test_a_fault_comes_again_and_again(clean: Reading) -> None:
    lost = reading(Fault("lost", 1.0, 0.1, every_s=0.5))
    assert lost.counters.lost == pytest.approx(100, abs=10)
    assert len(lost.frames) + lost.counters.lost == len(clean.frames)
    assert reading(Fault("disconnect", 1.0, 0.1, every_s=1.0)).counters.reconnects == 5
    resets = [ms for ms, _ in reading(Fault("reset", 1.0, 0.2, every_s=1.0), Fault("reset", 1.5, 0.2)).frames]
    assert resets.count(0) == 6
    stalls = reading(Fault("stall", 1.0, 0.3, every_s=1.0))
    assert stalls.frames == clean.frames
    assert len(set(stalls.passed_ms)) == pytest.approx(len(clean.frames) - 5 * 30, abs=10)
    ears = channel(reading(Fault("stuck", 1.0, 0.5, every_s=1.0, channels=("ears",))).frames, "ears")
    changed = np.flatnonzero(ears != channel(clean.frames, "ears"))
    assert set((np.array(clean.passed_ms)[changed] - 1000) // 1000) == {0, 1, 2, 3, 4}
    assert ((np.array(clean.passed_ms)[changed] - 1000) % 1000).max() < 500


def test_one_fault_does_not_change_another() -> None:
    glitch, torn = Fault("glitch", 1.0, 1.0, share=0.5), Fault("torn", 4.0, 1.0, share=0.5)
    both, alone = reading(glitch, torn), reading(glitch)
    assert both.frames[:250] == alone.frames[:250]
    assert both.counters.garbage == alone.counters.garbage
    assert reading(glitch, torn).frames == both.frames
    # Those of one moment have their own order.
    lost, flood = Fault("lost", 1.0, 1.0), Fault("flood", 1.0, 1.0)
    assert reading(lost, flood).frames == reading(flood, lost).frames


def test_floods_do_not_multiply_without_end() -> None:
    parts = (ScenarioPart("idle", duration_s=0.2),)
    floods = tuple(Fault("flood", 0.0, 0.1, times=1000) for _ in range(3))
    lines = ToyStream(ToySpec.of(ToyScenario(parts, faults=floods)), PLUSH)
    assert 900_000 < max(len(line.data) for line in lines) <= 1_000_000


def test_lines_that_are_broken_already_are_torn_no_further() -> None:
    torn = Fault("torn", BEGIN_S, LENGTH_S)
    read = reading(torn, torn, torn)
    assert read.counters.malformed == read.counters.lost > 90
    scenario = ToyScenario((ScenarioPart("idle", duration_s=6.0),), garbled=0.9, faults=(torn,))
    assert sum(len(line.data) > 1 for line in ToyStream(ToySpec.of(scenario), PLUSH)) > 500


def test_firmware_without_a_clock_shows_no_reset() -> None:
    clocks = [ms for ms, _ in reading(Fault("reset", 3.0, 1.0), layout="plush-14").frames]
    assert np.diff(clocks).min() >= 9


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"kind": "stal", "at_s": 1.0}, "accepted are stuck, dead, .*Did you mean 'stall'"),
        ({"kind": "lost", "at_s": -1.0}, "at_s is -1; accepted are 0 to 1000000 seconds"),
        ({"kind": "lost", "at_s": 1.0, "share": 1.5}, "share is 1.5; accepted is above 0 to 1"),
        (
            {"kind": "stall", "at_s": 1.0, "share": 0.5},
            "'stall' has no share; it has at_s, duration_s, every_s: leave share out",
        ),
        ({"kind": "dead", "at_s": 1.0, "channels": ("ear",)}, "no channel 'ear'.*Did you mean 'ears'"),
        ({"kind": "flood", "at_s": 1.0, "times": 1}, "times is 1; accepted are whole numbers from 2 to 1000"),
    ],
)
def test_a_wrong_fault_is_refused(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Fault(**settings)  # type: ignore[arg-type]
