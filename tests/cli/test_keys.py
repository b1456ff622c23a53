"""Keys that are held, and programs that are asked to end."""

from __future__ import annotations

import signal
import sys

import pytest

from plushsense.cli.signals import interrupt_on_signals
from plushsense.cli.terminal import KeyRepeatFilter


def pressed(*keys: tuple[float, str]) -> list[str]:
    """Which of these keys, each at its second, count."""
    held = KeyRepeatFilter()
    return [key for at_s, key in keys if not held.repeats(key, at_s)]


def test_a_space_bar_that_is_held_is_one_press() -> None:
    repeats = [(10.0, " "), (10.5, " "), *((10.5 + 0.033 * n, " ") for n in range(1, 90))]
    assert pressed(*repeats) == [" "]
    assert pressed(*repeats, (14.5, " ")) == [" ", " "]


def test_keys_in_a_row_all_count() -> None:
    row = [(n * 0.2, "b") for n in range(4)]
    assert pressed(*row) == ["b"] * 4
    assert pressed((1.0, " "), (1.1, "p"), (1.15, "p"), (1.2, " ")) == [" ", "p", "p", " "]
    assert pressed((0.0, "s"), (0.03, "s"), (0.06, "s")) == ["s"]


@pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends a program on Windows")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_request_to_end_is_an_interrupt_and_only_once(name: str) -> None:
    number = getattr(signal, name)
    before = signal.getsignal(number)
    if before is not signal.SIG_DFL:
        pytest.skip(f"{name} is taken here")
    with interrupt_on_signals():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
        signal.raise_signal(number)
    assert signal.getsignal(number) is before


@pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends a program on Windows")
@pytest.mark.parametrize("own", [True, False])
def test_a_request_to_end_does_what_ctrl_c_does_here(own: bool) -> None:
    """A server has its own way to end; in the background of a shell, Ctrl-C is ignored, but not ``kill``."""
    if signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        pytest.skip("SIGTERM is taken here")
    asked: list[int] = []
    before = signal.signal(signal.SIGINT, (lambda number, _: asked.append(number)) if own else signal.SIG_IGN)
    try:
        with interrupt_on_signals():
            if own:
                signal.raise_signal(signal.SIGTERM)
            else:
                with pytest.raises(KeyboardInterrupt):
                    signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, before)
    assert asked == [signal.SIGINT] * own
