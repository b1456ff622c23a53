"""A real studio in a process of its own, and a real Chromium that looks at it."""

from __future__ import annotations

import contextlib
import importlib.util
import shutil
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from support.browsing import CHROMIUM, DESK, Look, Studio, find_chromium, is_own
from support.requirements import missing
from support.sharing import built_once
from support.trainings import train_apart

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Callable[..., Studio]]:
    """``studio("--device", URL, home=...)`` starts one; all are stopped at the end, and none may have failed inside."""
    begun: list[Studio] = []

    def start(*options: str, home: Path | None = None, **more: Any) -> Studio:
        begun.append(Studio(home or tmp_path / "home", options, **more).start())
        return begun[-1]

    yield start
    for each in begun:
        each.stop()
    assert not [line for each in begun for line in each.errors if "Traceback" in line], "".join(
        line for each in begun for line in each.errors
    )


@pytest.fixture
def server() -> Iterator[Callable[[bytes], str]]:
    """A toy over TCP that sends the same line again and again to everybody; gives its URL."""
    sockets: list[socket.socket] = []

    def serve(line: bytes) -> str:
        reader = socket.create_server(("127.0.0.1", 0))
        sockets.append(reader)

        def talk(connection: socket.socket) -> None:
            with contextlib.suppress(OSError):
                while line:
                    connection.sendall(line)
                    time.sleep(0.01)

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = reader.accept()
                    sockets.append(connection)
                    threading.Thread(target=talk, args=(connection,), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        return f"tcp://127.0.0.1:{reader.getsockname()[1]}"

    yield serve
    for one in sockets:
        one.close()


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """Debian's Chromium, headless, driven by Playwright, whose loop stays in this thread until the end of the run."""
    found = find_chromium()
    if found is None:
        missing("browser", "neither chromium-headless-shell nor chromium is installed")
    if importlib.util.find_spec("playwright") is None or importlib.util.find_spec("nicegui") is None:
        missing("browser", "playwright or nicegui is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, headless=True, args=CHROMIUM)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def profiles(chromium: Browser) -> dict[tuple[str, bool], list[BrowserContext]]:
    """Browser profiles that wait for the next test, by language and touch screen.

    In a new profile the browser compiles the scripts of the first page, which takes longer than most tests.
    """
    return defaultdict(list)


@pytest.fixture
def look(chromium: Browser, profiles: dict[tuple[str, bool], list[BrowserContext]]) -> Iterator[Callable[..., Look]]:
    """``look(size, dark, language)`` gives a browser without cookies; at the end none may have asked for anything
    foreign. ``own`` makes a profile for this test alone, which it may change."""
    made: list[tuple[Look, tuple[str, bool] | None]] = []

    def new(
        size: tuple[int, int] = DESK, dark: bool = False, language: str = "en", touch: bool = False, own: bool = False
    ) -> Look:
        waiting = [] if own else profiles[language, touch]
        context = (
            waiting.pop()
            if waiting
            else chromium.new_context(
                locale=language,
                has_touch=touch,
                reduced_motion="reduce",
                viewport={"width": size[0], "height": size[1]},
                color_scheme="dark" if dark else "light",
            )
        )
        one = Look(context, size, dark, empty=list(context.pages))
        context.on("request", one.ask)
        made.append((one, None if own else (language, touch)))
        return one

    yield new
    for one, shared in made:
        if shared is None:
            one.context.remove_listener("request", one.ask)
            one.context.close()
        else:
            one.close()
            one.context.clear_cookies()
            profiles[shared].append(one.context)
        foreign = [u for u in one.asked if not is_own(u)]
        assert foreign == [], f"the page asked for something foreign: {foreign}"


@pytest.fixture(scope="session")
def furniture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A studio's folder with a data set of six virtual people and a small trained bundle; read only: take a `copy`."""
    from plushsense.workflow.api import simulate

    def build(home: Path) -> None:
        dataset = home / "datasets" / "virtual"
        simulate(home / "made", people=6, repetitions=1, dataset=dataset)
        shutil.rmtree(home / "made")
        (home / "bundles").mkdir()
        options = ("--preset", "loso", "--epochs", "12", "--context", "anywhere")
        train_apart(dataset, home / "bundles" / "little.plush", *options)

    return built_once(tmp_path_factory, "furniture", build)


@pytest.fixture
def home(furniture: Path, tmp_path: Path) -> Path:
    """A furnished folder of one's own."""
    return Path(shutil.copytree(furniture, tmp_path / "home"))


@pytest.fixture
def few(furniture: Path, tmp_path: Path) -> Path:
    """A home of one's own with a data set of three virtual people and nine recordings, quick to publish."""
    dataset = tmp_path / "home" / "datasets" / "virtual"
    shutil.copytree(furniture / "datasets" / "virtual", dataset)
    for folder in (dataset / "streams", dataset / "cache", dataset / "evaluations"):
        shutil.rmtree(folder, ignore_errors=True)
    (dataset / "index.json").unlink()
    for person in (dataset / "recordings").iterdir():
        for extra in sorted(person.rglob("*.csv"))[3 if person.name in ("P01", "P02", "P03") else 0 :]:
            extra.unlink()
    return tmp_path / "home"
