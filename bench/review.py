"""Measure the time from the key to the drawn plot of the next recording on the review page, in Chromium.

    python bench/review.py DATASET [--recordings 200]

The data set is copied and does not change. The time is measured in the browser with ``performance.now()``, from the key
event to the frame after the plot was drawn, once the background analysis of all recordings is finished.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.browsing import CHROMIUM, Look, Studio, find_chromium

PLOT = "document.querySelector('[data-test=plot]')"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--recordings", type=int, default=200)
    args = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as place, sync_playwright() as driver:
        home = Path(place) / "home"
        shutil.copytree(args.dataset, home / "datasets" / "copy", ignore=shutil.ignore_patterns("cache", "marks*"))
        studio = Studio(home).start()
        found = find_chromium()
        browser = driver.chromium.launch(executable_path=found, headless=True, args=CHROMIUM)
        try:
            page = Look(browser.new_context(viewport={"width": 1280, "height": 800})).open(
                f"{studio.url}/review?view=one"
            )
            page.wait_for_function(f"() => {PLOT}?.dataset.shown")
            page.wait_for_timeout(1000)
            page.wait_for_function(
                "() => document.querySelector('[data-test=making]').textContent === ''", timeout=300_000
            )
            for _ in range(args.recordings):
                was = page.evaluate(f"() => {PLOT}.dataset.shown")
                page.keyboard.press("Enter")
                page.wait_for_function(f"(was) => {PLOT}.dataset.shown !== was", arg=was)
            times = sorted(page.evaluate(f"() => {PLOT}.psPlot.times"))
        finally:
            browser.close()
            studio.stop()
    result = {
        "recordings": len(times),
        "median_ms": round(statistics.median(times), 1),
        "p95_ms": round(times[int(0.95 * len(times))], 1),
        "max_ms": round(times[-1], 1),
        "load": [round(x, 1) for x in os.getloadavg()],
    }
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
