"""What tests of the record page share."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.core.layouts import load_layout
from plushsense.devices.virtual.server import ToyServer
from plushsense.devices.virtual.stream import ToySpec
from plushsense.recording.writer import SessionEvent, read_events
from support.browsing import connected, marked
from support.pty_toys import QUIET

if TYPE_CHECKING:
    from playwright.sync_api import Page

_PRESSES, _PRESSED_MS = 20, 5_000.0
CALM = "virtual://?person=7&lost=0&garbled=0&glitch=0"
"""A virtual toy that loses nothing."""


@contextmanager
def tcp_toy(port: int = 0, speed: float = 1.0, layout: str = "plush-15", spec: ToySpec = QUIET) -> Iterator[str]:
    """A toy on a port of this machine: its URL."""
    stop, ready, urls = threading.Event(), threading.Event(), list[str]()

    def on_ready(url: str) -> None:
        urls.append(url)
        ready.set()

    options: dict[str, Any] = {"layout": load_layout(layout), "speed": speed, "on_ready": on_ready, "stop": stop}
    thread = threading.Thread(target=lambda: ToyServer(spec, **options).serve_tcp(port), daemon=True)
    thread.start()
    assert ready.wait(10)
    try:
        yield urls[0]
    finally:
        stop.set()
        thread.join(15)


def showing(page: Page, *starts: str, limit_ms: float | None = None) -> str:
    """Wait until the page shows one of these states, such as ``idle.3.``; what it shows. None: the page's own limit."""
    found = page.wait_for_function(
        "starts => { const at = document.querySelector('[data-seen]'); const seen = at ? at.dataset.seen : '';"
        " return starts.some(s => seen.startsWith(s)) ? seen : null }",
        arg=list(starts),
        timeout=limit_ms,
    )
    return str(found.json_value())


def start_recording(page: Page, number: int) -> bool:
    """Press the space bar until this step is recorded, and return whether it still is.

    On a slow machine the toy may not be heard at the moment of a press, which is then answered with a sentence only,
    and the recording may end by itself before it is seen.
    """
    from playwright.sync_api import TimeoutError as TooSlow

    showing(page, f"idle.{number}.")
    for _ in range(_PRESSES):
        page.keyboard.press("Space")
        # A second press, for an outdated display, is refused by the page.
        with contextlib.suppress(TooSlow):
            begun = f"recording.{number}.", f"idle.{number + 1}.", "finished."
            return showing(page, *begun, limit_ms=_PRESSED_MS).startswith("recording.")
    raise AssertionError(f"step {number} does not begin")


def heard(page: Page) -> None:
    """Wait until the toy can be heard: a space before it is only answered with a sentence."""
    page.wait_for_selector('[data-signal="good"], [data-signal="fair"], [data-signal="poor"]')


def begun(page: Page, url: str, code: str, protocol: str = "quick") -> Page:
    """A new session on this page, its toy heard."""
    page.goto(url + "/record?new=1")
    connected(page)
    marked(page, "code").fill(code)
    if protocol != "plush-17":
        choose(page, "protocol", "Short trial" if protocol == "quick" else protocol)
    marked(page, "begin").click()
    sat(page, f"{code}/1")
    return page


def choose(page: Page, field: str, text: str) -> None:
    """Choose in a list."""
    marked(page, field).click()
    page.get_by_role("option").filter(has_text=text).first.click()


def sat(page: Page, name: str) -> None:
    """The session of this name is shown, and its toy is heard."""
    page.wait_for_url(f"**/record?session={name}")
    page.wait_for_selector('[data-test="state-box"]')
    connected(page)
    heard(page)


def stop(page: Page, seconds: float = 0.1, key: str = "Space") -> None:
    """End the recording by a key, after so many seconds: at least half a second of the toy's time.

    An earlier stop is taken for a slip, and the recording goes on to its longest. The default is enough for a toy at
    five times its speed. On a slow machine less of its time may have passed, so that the key is pressed again; if the
    recording has just ended, the page answers that press with a sentence only.
    """
    from playwright.sync_api import TimeoutError as TooSlow

    for _ in range(10):
        page.wait_for_timeout(1000.0 * seconds)
        page.keyboard.press(key)
        with contextlib.suppress(TooSlow):
            showing(page, "idle.", "finished.", limit_ms=5_000)
            return


def take(page: Page, number: int, seconds: float = 0.1) -> None:
    """Make a recording of so many seconds by the space bar; see `stop`."""
    if start_recording(page, number):
        stop(page, seconds)
    showing(page, "idle.", "finished.")


def events(home: Path, name: str = "S01/1") -> list[SessionEvent]:
    """What the session's log says."""
    return list(read_events(home / "recordings" / name))


def whats(home: Path, name: str = "S01/1") -> list[str]:
    """What happened, in words."""
    return [e.kind for e in events(home, name)]


def files(home: Path, name: str = "S01/1") -> list[dict[str, Any]]:
    """The sidecars of its recordings, by time."""
    folder = home / "recordings" / name
    beside = [json.loads(p.with_suffix(".json").read_text("utf-8")) for p in folder.glob("*_*_*.csv")]
    return sorted(beside, key=lambda b: int(b["stream_row"]))
