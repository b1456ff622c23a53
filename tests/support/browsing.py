"""What tests of the studio use: a studio in a process of its own, a browser that keeps a log, axe-core."""

from __future__ import annotations

import asyncio
import functools
import io
import json
import multiprocessing
import os
import re
import shutil
import signal
import socket
import sys
import threading
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

from plushsense.studio.app.shell import PAGES
from support.requirements import missing

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, ConsoleMessage, Page, Request
    from playwright.sync_api import Error as PageError

T = TypeVar("T")
TESTS = Path(__file__).parents[1]
AXE = TESTS / "studio" / "vendor" / "axe.min.js"
CHROMIUM = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # Pages of tests are closed so soon that compiling optimized code takes longer than the code saves.
    "--js-flags=--no-maglev,--no-turbofan",
]
# What Chromium says of a message that a page sends just when its connection is closed, as on leaving the page.
_CLOSED = "WebSocket is already in CLOSING or CLOSED state."
KEPT = os.environ.get("PLUSHSENSE_SHOTS", "")
_PICTURE_BYTES = 100_000
_PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
_START_S = 120.0
_WAIT_MS = 120_000
_SETTLE_MS = 200
_POLL_MS = 25
_LOOKS = 4
LONG_MS = 300_000
"""How long to wait for a job of the studio."""
DESK, TABLET, PHONE = (1280, 800), (820, 1180), (390, 844)
ZOOM = (640, 400)
"""What is left of a desk at 200 % zoom."""


# Importing takes longer than starting: a server process imports once, and every studio is forked from it.
_FORKING = multiprocessing.get_context("forkserver")
_FORKING.set_forkserver_preload(
    ["nicegui", "plushsense.studio.app.serve", *(f"plushsense.studio.pages.{name}.{name}_page" for name in PAGES)]
)


def _run_studio(
    words: list[str], folder: str, out: Connection, errors: Connection, open_files: int, without: tuple[str, ...]
) -> None:
    """Run ``plushsense studio`` in this process, with its output to two pipes."""
    import resource

    from plushsense.cli.main import main

    # Nothing that a test of the whole suite sets must reach it.
    for name in [k for k in os.environ if k.startswith(("NICEGUI_", "PYTEST_"))]:
        del os.environ[name]
    # NiceGUI does not serve from what it takes for the process of a pool.
    multiprocessing.current_process().name = "MainProcess"
    os.dup2(out.fileno(), 1)
    os.dup2(errors.fileno(), 2)
    sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", closefd=False) for n in (1, 2))
    os.chdir(folder)
    sys.modules.update(dict.fromkeys(without))  # type: ignore[arg-type]
    if open_files:
        resource.setrlimit(resource.RLIMIT_NOFILE, (open_files, open_files))
    sys.exit(main(words))


# Outside of the range from which systems take ports for outgoing connections.
_PORT = 20_000 + os.getpid() % 10_000


def _free_port() -> int:
    """Return the same port as long as it is free, so that browsers need not compile the pages' scripts again."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", _PORT))
        except OSError:
            return 0
    return _PORT


@dataclass
class Studio:
    """`plushsense studio` in a process of its own. ``start`` it again after ``kill`` on the same folder and port."""

    home: Path
    options: tuple[str, ...] = ()
    url: str = ""
    port: int = 0
    process: BaseProcess | None = None
    errors: list[str] = field(default_factory=list)
    open_files: int = 0
    """The limit on its open files; 0: the tests' own."""
    without: tuple[str, ...] = ()
    """Modules that it shall not find."""
    _pipes: list[Connection] = field(default_factory=list)

    def start(self) -> Studio:
        """Wait until it answers."""
        self.port = self.port or _free_port()
        words = ["studio", "--home", str(self.home), "--port", str(self.port), "--no-show", "--json", *self.options]
        out, its_out = _FORKING.Pipe(duplex=False)
        errors, its_errors = _FORKING.Pipe(duplex=False)
        self._pipes = [out, errors]
        arguments = (words, str(self.home.parent), its_out, its_errors, self.open_files, self.without)
        self.process = _FORKING.Process(target=_run_studio, args=arguments)
        self.process.start()
        its_out.close()
        its_errors.close()
        lines = os.fdopen(os.dup(errors.fileno()), encoding="utf-8")
        threading.Thread(target=lambda: self.errors.extend(lines), daemon=True).start()
        timer = threading.Timer(_START_S, self.process.kill)
        timer.start()
        with os.fdopen(os.dup(out.fileno()), encoding="utf-8") as answer:
            line = answer.readline()
        timer.cancel()
        assert line, f"the studio did not start: {''.join(self.errors)}"
        self.url = json.loads(line)["url"].rstrip("/")
        self.port = int(urlsplit(self.url).port or 0)
        return self

    def kill(self) -> None:
        """As a power cut."""
        assert self.process is not None
        self.process.kill()
        self.process.join(20.0)

    def signal(self, number: int) -> None:
        """Send a signal to it."""
        assert self.process is not None and self.process.pid is not None
        os.kill(self.process.pid, number)

    def stop(self) -> None:
        """As Ctrl-C."""
        if self.process is not None and self.process.is_alive():
            self.signal(signal.SIGINT)
            self.process.join(20.0)
            if self.process.is_alive():
                self.kill()


@dataclass
class Look:
    """A browser profile without cookies, and what it asked for and complained about."""

    context: BrowserContext
    size: tuple[int, int] = DESK
    dark: bool = False
    asked: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
    empty: list[Page] = field(default_factory=list)
    """Tabs to open pages in; in a new tab, a new process of the browser takes almost twice as long to load a page."""

    def ask(self, request: Request) -> None:
        """Note what is asked for."""
        self.asked.append(request.url)

    def _log(self, message: ConsoleMessage) -> None:
        if message.type == "error" and message.text != _CLOSED:
            self.complaints.append(message.text)

    def _fail(self, error: PageError) -> None:
        self.complaints.append(str(error))

    def open(self, url: str) -> Page:
        """A tab at this address, its connection to the studio standing."""
        page = self.empty.pop() if self.empty else self.context.new_page()
        page.set_viewport_size({"width": self.size[0], "height": self.size[1]})
        page.emulate_media(color_scheme="dark" if self.dark else "light", reduced_motion="reduce", media="null")
        page.set_default_timeout(_WAIT_MS)
        # By default a wait looks at every frame, which keeps the browser drawing frames.
        setattr(page, "wait_for_function", functools.partial(page.wait_for_function, polling=_POLL_MS))  # noqa: B010
        page.on("console", self._log)
        page.on("pageerror", self._fail)
        page.goto(url)
        connected(page)
        return page

    def leave(self, page: Page) -> None:
        """Empty a tab, as if it were closed; the next page is opened in it."""
        page.remove_listener("console", self._log)
        page.remove_listener("pageerror", self._fail)
        page.evaluate("() => sessionStorage.clear()")
        page.goto("about:blank")
        self.empty.append(page)

    def close(self) -> None:
        """Forget what pages stored, leave one tab, and close the others."""
        from playwright.sync_api import Error

        self.context.remove_listener("request", self.ask)
        pages = [page for page in self.context.pages if page not in self.empty]
        for page in pages[1:] if not self.empty else pages:
            page.close()
        for page in pages[:1] if not self.empty else ():
            try:
                page.evaluate("() => localStorage.clear()")
                self.leave(page)
            except Error:
                page.close()


def find_chromium() -> str | None:
    """Return the path of the browser; the headless shell loads a page in half of the processor time."""
    return next(filter(None, map(shutil.which, _PROGRAMS)), None)


def connected(page: Page) -> None:
    """Wait until the page has its connection: what is pressed before is lost."""
    page.wait_for_function(
        "() => window.socket && window.socket.connected && window.did_handshake "
        "&& !document.querySelector('#popup[aria-hidden=\"false\"]')"
    )
    page.wait_for_selector("h1")
    # What was set while the page was being built may still be on its way, and would overwrite what is typed now.
    page.wait_for_timeout(_SETTLE_MS)


def alone(coroutine: Coroutine[Any, Any, T]) -> T:
    """`asyncio.run` in a thread of its own: Playwright may be running in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, coroutine).result()


def is_own(url: str) -> bool:
    """Whether this is the studio itself."""
    parts = urlsplit(url)
    return parts.scheme in ("data", "blob", "about") or parts.hostname in ("127.0.0.1", "localhost")


def axe(page: Page) -> list[str]:
    """Serious and critical findings of axe-core, a line each, that are still there after a moment.

    A field that is just being enabled, or a label that is moving, may be found in between. Nothing is preloaded: only a
    rule on films and sounds, of moderate impact, needs that, and it takes as long as all the rules. In the folder
    ``PLUSHSENSE_LOOKS``, if set, a picture of the page is kept for looking at.
    """
    if folder := os.environ.get("PLUSHSENSE_LOOKS"):
        name = re.sub(r"\W+", "-", os.environ["PYTEST_CURRENT_TEST"].rpartition("::")[2].partition(" (")[0])
        Path(folder).mkdir(parents=True, exist_ok=True)
        number = len(list(Path(folder).glob(f"{name}-*.png")))
        page.screenshot(path=str(Path(folder) / f"{name}-{number}.png"), full_page=True)
    # Evaluated, not added as a script: the page's own policy stands. Once a page, as that takes as long as looking.
    if not page.evaluate("() => 'axe' in window"):
        page.evaluate(AXE.read_text(encoding="utf-8"))
    findings: list[str] = []
    for _ in range(_LOOKS):
        found: dict[str, Any] = page.evaluate(
            "() => axe.run(document, {resultTypes: ['violations'], preload: false, "
            "rules: {'target-size': {enabled: true}}})"
        )
        findings = [
            f"{v['id']} ({v['impact']}): {v['help']}: {node['html'][:160]}"
            for v in found["violations"]
            if v["impact"] in ("serious", "critical")
            for node in v["nodes"]
        ]
        if not findings:
            break
        page.wait_for_timeout(_SETTLE_MS * 2)
    return findings


# Words that no Latvian sentence has.
_ENGLISH = re.compile(r"\b(the|of|and|with|this|are|has|have|was|were|from|your|which|cannot|does|not|is|or)\b", re.I)


def english(page: Page) -> list[str]:
    """Return the lines of a page, and its labels for screen readers, that read as English; paths do not count."""
    texts: list[str] = page.evaluate(
        "() => [...document.body.innerText.split('\\n'), "
        "...[...document.querySelectorAll('[aria-label], [placeholder], [title]')]"
        ".flatMap(e => ['aria-label', 'placeholder', 'title'].map(k => e.getAttribute(k) || ''))]"
    )
    return sorted({text for text in texts if _ENGLISH.search(re.sub(r"\S*/\S*", "", text))})


def in_sight(page: Page, name: str) -> bool:
    """Wait until the element has the focus and its beginning is in sight below the bar; False after a while."""
    from playwright.sync_api import TimeoutError as TooSlow

    try:
        page.wait_for_function(
            "name => { const at = document.activeElement, top = at.getBoundingClientRect().top;"
            " return at.dataset.test === name && top > 50 && top < innerHeight - 40 }",
            arg=name,
            timeout=10_000,
        )
    except TooSlow:
        return False
    return True


def marked(page: Page, name: str) -> Any:
    """The element that the code marks with ``.mark(name)`` (`plushsense.studio.app.shell.tag`)."""
    return page.locator(f'[data-test="{name}"]')


def keep_picture(png: bytes, name: str, width: int) -> None:
    """Keep a picture for the documentation in the folder ``PLUSHSENSE_SHOTS``, if set."""
    if KEPT:
        kept = _small(png, width)
        assert len(kept) <= _PICTURE_BYTES, f"{name}.png has {len(kept)} bytes"
        Path(KEPT).mkdir(parents=True, exist_ok=True)
        (Path(KEPT) / f"{name}.png").write_bytes(kept)


def _small(png: bytes, width: int) -> bytes:
    """The picture as few bytes: a palette, and no wider than ``width``."""
    try:
        from PIL import Image
    except ImportError:
        missing("pictures", "pillow is not installed, and the pictures for the README are to be small")
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    if picture.width > width:
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
    out = io.BytesIO()
    picture.quantize(192, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    return out.getvalue()
