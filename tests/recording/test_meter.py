import pytest

from plushsense.core.layouts import load_layout
from plushsense.devices.base import Counters
from plushsense.recording.takes import SIGNAL, SignalMonitor, SignalQuality


def metered(step_ms: int, seconds: float, lost: int = 0, malformed: int = 0) -> SignalQuality:
    """A toy that speaks every ``step_ms`` for so long; what goes wrong comes in the second half."""
    meter, counters = SignalMonitor(load_layout("plush-15")), Counters()
    n = round(1000 * seconds / step_ms)
    for i in range(n):
        meter.push(1000 + i * step_ms + (i % 2))
        counters.frames += 1
        if i == n // 2:
            counters.lost, counters.malformed = lost, malformed
        if i % 5 == 0:
            meter.update_losses(counters, i * step_ms / 1000)
    return meter.quality(seconds)


def test_rate_and_jitter_are_the_toys_own() -> None:
    quality = metered(10, 5)
    assert quality.rate_hz == pytest.approx(100, abs=0.5)
    assert quality.jitter_ms == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("step_ms", "lost", "malformed", "word"),
    [
        (10, 0, 0, "good"),
        (10, 1, 0, "good"),
        (10, 3, 2, "fair"),
        (10, 40, 0, "poor"),
        (10, 0, 40, "poor"),
        (13, 0, 0, "poor"),
    ],
)
def test_one_word_for_the_person(step_ms: int, lost: int, malformed: int, word: str) -> None:
    assert metered(step_ms, 5, lost, malformed).signal == word
    assert word in SIGNAL


def test_silence_is_said() -> None:
    meter = SignalMonitor(load_layout("plush-15"))
    assert meter.quality(0.0).signal == "none"
    for i in range(100):
        meter.push(10 * i)
    meter.update_losses(Counters(frames=100), 1.0)
    assert meter.quality(1.5).signal == "good"
    assert meter.quality(1.5, away=True).signal == "none"
    assert meter.quality(2.5) == SignalQuality()
    meter.push(60_000)
    meter.update_losses(Counters(frames=101), 60.0)
    assert meter.quality(60.0).signal == "none", "after a pause it begins anew"


def test_a_clock_that_stands_still_is_no_good_signal() -> None:
    meter, counters = SignalMonitor(load_layout("plush-15")), Counters()
    for _ in range(100_000):
        meter.push(5000)
        counters.frames += 1
    meter.update_losses(counters, 1.0)
    assert meter.quality(1.0).signal == "poor"
    assert len(meter._clock) < 1000, "what is kept does not grow"


def test_values_out_of_range_are_no_good_signal() -> None:
    meter, counters = SignalMonitor(load_layout("plush-15")), Counters()
    for n in range(300):
        meter.push(10 * n)
        counters.frames += 1
        counters.garbage += 1
        meter.update_losses(counters, n / 100)
    assert meter.quality(3.0).signal == "poor"


def test_the_share_behind_the_word() -> None:
    assert metered(10, 5).bad_share == 0.0
    # The first reading is not counted against: 499 frames came after it.
    assert metered(10, 5, 10, 5).bad_share == pytest.approx(15 / 510, abs=0.001)
    assert SignalQuality().bad_share == 0.0
