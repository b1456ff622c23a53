"""What tests of the studio use: a studio in a process of its own, a browser that keeps a log, axe-core."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page

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
]
_START_S = 60.0
_WAIT_MS = 60_000
_SETTLE_MS = 200
DESK, TABLET = (1280, 800), (820, 1180)


@dataclass
class Studio:
    """`plushsense studio` in a process of its own. ``start`` it again after ``kill`` on the same folder and port."""

    home: Path
    options: tuple[str, ...] = ()
    url: str = ""
    port: int = 0
    process: subprocess.Popen[str] | None = None
    errors: list[str] = field(default_factory=list)
    open_files: int = 0
    """The limit on its open files; 0: the tests' own."""

    def start(self) -> Studio:
        """Wait until it answers."""
        command = [sys.executable, "-m", "plushsense.cli.main", "studio", "--home", str(self.home)]
        command += ["--port", str(self.port), "--no-show", "--json", *self.options]
        if self.open_files:
            command = ["/bin/sh", "-c", 'ulimit -n "$0" && exec "$@"', str(self.open_files), *command]
        # Nothing that a test of the whole suite sets must reach it.
        env = {k: v for k, v in os.environ.items() if not k.startswith(("NICEGUI_", "PYTEST_"))}
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=self.home.parent, env=env
        )
        errors = self.process.stderr
        assert self.process.stdout is not None and errors is not None
        threading.Thread(target=lambda: self.errors.extend(errors), daemon=True).start()
        timer = threading.Timer(_START_S, self.process.kill)
        timer.start()
        line = self.process.stdout.readline()
        timer.cancel()
        assert line, f"the studio did not start: {''.join(self.errors)}"
        self.url = json.loads(line)["url"].rstrip("/")
        self.port = int(urlsplit(self.url).port or 0)
        return self

    def kill(self) -> None:
        """As a power cut."""
        assert self.process is not None
        self.process.kill()
        self.process.wait(20.0)

    def stop(self) -> None:
        """As Ctrl-C."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(20.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait(20.0)


@dataclass
class Look:
    """One browser with an empty profile, and what it asked for and complained about."""

    context: BrowserContext
    asked: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def open(self, url: str) -> Page:
        """A new tab at this address, its connection to the studio standing."""
        page = self.context.new_page()
        page.set_default_timeout(_WAIT_MS)
        page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: self.complaints.append(str(e)))
        page.goto(url)
        connected(page)
        return page


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
    """Serious and critical findings of axe-core, a line each."""
    # Evaluated, not added as a script: the page's own policy stands.
    page.evaluate(AXE.read_text(encoding="utf-8"))
    found: dict[str, Any] = page.evaluate("() => axe.run(document, {resultTypes: ['violations']})")
    return [
        f"{v['id']} ({v['impact']}): {v['help']}: {node['html'][:160]}"
        for v in found["violations"]
        if v["impact"] in ("serious", "critical")
        for node in v["nodes"]
    ]


def marked(page: Page, name: str) -> Any:
    """The element that the code marks with ``.mark(name)`` (`plushsense.studio.app.shell.tag`)."""
    return page.locator(f'[data-test="{name}"]')
