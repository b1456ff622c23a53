"""Measure the live page: updates a second, processor time of the server, bytes to page, memory over a long run.

    python bench/studio.py --model BUNDLE [--seconds 30] [--minutes 10 --speed 6] [--json]

A virtual toy in a process of its own (13 channels, 100 Hz) sends over TCP; the studio reads it in another; Chromium,
headless, shows the page. All three and this program share the machine, whose load is reported with the results.

1. Real time, for `--seconds`: messages and drawings per second; processor time of the studio's process (all threads,
   for reading, deciding and sending); time from the arrival of the bytes in the studio to the message in the page, and
   to the end of drawing it, all by the clock of the machine.
2. Memory, for `--minutes` of the toy's time at `--speed`: resident memory of the studio and heap of the page, after a
   forced garbage collection, every few seconds; the growth is the slope of a straight line through the last two thirds.

Linux (/proc), Debian's Chromium and Playwright are required. Only the lines of the virtual toy matter here, not its
scores.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.browsing import CHROMIUM, find_chromium

_LOOK = "() => { const s = window.plushsenseLive; return {...s, delays: [...s.delays], painted: [...s.painted]}; }"


def processor_s(pid: int) -> float:
    """Return the processor time that all threads of a process have used so far, in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def heap_bytes(page: Any) -> int:
    """Return the bytes in a page's heap after a garbage collection."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = int(session.send("Runtime.getHeapUsage")["usedSize"])
    session.detach()
    return used


def growth(points: list[tuple[float, float]]) -> dict[str, float]:
    """Return the means of the first and last third of (seconds, bytes), and the slope of the last two in kB/minute."""
    late = np.array(points[len(points) // 3 :])
    third = max(1, len(points) // 3)
    slope = float(np.polyfit(late[:, 0], late[:, 1], 1)[0]) if len(late) > 2 else 0.0
    return {
        "first_mb": float(np.mean([b for _, b in points[:third]])) / 1e6,
        "last_mb": float(np.mean([b for _, b in points[-third:]])) / 1e6,
        "kb_per_minute": slope * 60.0 / 1e3,
    }


def quantiles(values: list[float]) -> dict[str, float]:
    """Return the 50th, 95th and 99th percentile."""
    return {f"p{q}": round(float(np.percentile(values, q)), 2) for q in (50, 95, 99)} if values else {}


class Program:
    """A plushsense command in a process of its own; its first line of JSON contains its address."""

    def __init__(self, *options: str, cwd: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "plushsense", *options, "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=cwd,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"plushsense {' '.join(options)} did not start.")
        self.url: str = json.loads(line)["url"].rstrip("/")
        threading.Thread(target=self.process.stdout.read, daemon=True).start()

    def end(self) -> None:
        self.process.terminate()
        self.process.wait(20.0)


def begin(page: Any) -> None:
    """Start the selected toy, and wait until the page shows it."""
    page.wait_for_function("() => window.socket && window.socket.connected && window.plushsenseLive")
    page.locator('[data-test="start"]').click()
    page.wait_for_function("() => window.plushsenseLive.updates > 40", timeout=60_000)


def at_real_time(page: Any, pid: int, seconds: float) -> dict[str, Any]:
    """Measure updates, processor time and delays for a number of seconds."""
    page.evaluate("() => { window.plushsenseLive.delays.length = 0; window.plushsenseLive.painted.length = 0; }")
    before, used, began = page.evaluate(_LOOK), processor_s(pid), time.perf_counter()
    delays: list[float] = []
    drawn: list[float] = []
    while time.perf_counter() - began < seconds:
        time.sleep(min(5.0, seconds))
        seen = page.evaluate(
            "() => { const s = window.plushsenseLive; return [s.delays.splice(0), s.painted.splice(0)]; }"
        )
        delays += seen[0]
        drawn += seen[1]
    passed = time.perf_counter() - began
    after, used = page.evaluate(_LOOK), processor_s(pid) - used
    return {
        "seconds": round(passed, 1),
        "updates_per_s": round((after["updates"] - before["updates"]) / passed, 2),
        "drawn_per_s": round((after["drawn"] - before["drawn"]) / passed, 2),
        "samples_per_s": round((after["samples"] - before["samples"]) / passed, 1),
        "server_core_percent": round(100.0 * used / passed, 2),
        "draw_ms": round((after["drawMs"] - before["drawMs"]) / max(1, after["drawn"] - before["drawn"]), 2),
        "bytes_to_page_ms": quantiles(delays),
        "bytes_to_drawn_ms": quantiles(drawn),
        "load_average": round(os.getloadavg()[0], 2),
    }


def memory(page: Any, pid: int, seconds: float, every_s: float = 5.0) -> dict[str, Any]:
    """Measure the memory of server and page for a number of seconds of real time."""
    server: list[tuple[float, float]] = []
    heap: list[tuple[float, float]] = []
    began = time.perf_counter()
    used = processor_s(pid)
    before = page.evaluate(_LOOK)
    while (now := time.perf_counter() - began) < seconds:
        server.append((now, float(resident_bytes(pid))))
        heap.append((now, float(heap_bytes(page))))
        time.sleep(min(every_s, max(0.1, seconds / 12)))
    passed = time.perf_counter() - began
    after = page.evaluate(_LOOK)
    return {
        "seconds": round(passed, 1),
        "server": growth(server),
        "page_heap": growth(heap),
        "updates_per_s": round((after["updates"] - before["updates"]) / passed, 2),
        "samples_per_s": round((after["samples"] - before["samples"]) / passed, 1),
        "server_core_percent": round(100.0 * (processor_s(pid) - used) / passed, 2),
        "load_average": round(os.getloadavg()[0], 2),
    }


def measure(model: Path, speed: float, seconds: float, watched: str) -> dict[str, Any]:
    """Measure one toy, one studio and one browser: ``watched`` is "real" or "memory"."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        toy = Program("toy", "--tcp", "0", "--speed", f"{speed:g}", "--person", "31", cwd=here)
        options = ("--device", toy.url, "--model", str(model.resolve()), "--port", "0", "--no-show")
        studio = Program("studio", "--home", str(here / "home"), *options, cwd=here)
        try:
            with sync_playwright() as driver:
                browser = driver.chromium.launch(
                    executable_path=find_chromium(), headless=True, args=[*CHROMIUM, "--enable-precise-memory-info"]
                )
                page = browser.new_page(viewport={"width": 1280, "height": 900})
                page.goto(f"{studio.url}/live")
                begin(page)
                time.sleep(5.0)
                take = at_real_time if watched == "real" else memory
                result = take(page, studio.process.pid, seconds)
                browser.close()
        finally:
            studio.end()
            toy.end()
    return result | {"speed": speed}


def main() -> None:
    parser = argparse.ArgumentParser(description="What the live page costs.")
    parser.add_argument("--model", required=True, type=Path, metavar="BUNDLE")
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of the first part in real time (30)")
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="duration of the second part in toy time (10); 0: none"
    )
    parser.add_argument("--speed", type=float, default=6.0, help="speed of the second part, times real time (6)")
    parser.add_argument("--json", action="store_true", help="one JSON object, nothing else")
    args = parser.parse_args()
    result: dict[str, Any] = {"cores": os.cpu_count()}
    if args.seconds > 0:
        result["real_time"] = measure(args.model, 1.0, args.seconds, "real")
    if args.minutes > 0:
        result["memory"] = measure(args.model, args.speed, 60.0 * args.minutes / args.speed, "memory")
    print(json.dumps(result, indent=None if args.json else 1))


if __name__ == "__main__":
    main()
