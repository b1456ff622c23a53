"""Measure the headline figures, keep them in docs/measurements/numbers.json, and write numbers.md there: `make bench`.

    python bench/measure.py --list                       # the rows, how long each takes, and when it was measured
    python bench/measure.py                              # measure every row: hours
    python bench/measure.py --rows chip-default,import   # some of them
    python bench/measure.py --rows strangers --seeds 0   # with one seed in place of three
    python bench/measure.py --page                       # measure nothing; write the page again

`ROWS` in `headlines.py` says what is measured. Results of each row and seed are kept in OUT (build/numbers), in a
folder for the commit that last changed `src`, with the data sets and networks that they need: the same command goes on
after a stop, and a later commit measures again, as do changes of `src` that are not committed. The file is written
after each row, the page at the end.

The README and other pages quote a figure as ``0.770<!-- = strangers.accuracy -->``: row, figure. The quotes are
written anew, too; tests/test_numbers.py compares page and quotes with the file.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from headlines import QUESTIONS, ROWS, SETS, Line, Row, git

from plushsense.core.files import write_file
from plushsense.reports.table import DASH, Table

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "measurements" / "numbers.md"
FILE = PAGE.with_suffix(".json")
CHANGED = "+changes"  # after the commit, where `src` has changes that are not committed
# A number, in groups of three or not, and the mark that says which figure it is.
NUMBER = r"(?:\d{1,3}(?:[ ,\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}]\d{3})+|\d+)(?:\.\d+)?(?: ?%)?"
QUOTE = re.compile(rf"(?P<number>{NUMBER})?<!-- = (?P<row>[a-z0-9-]+)\.(?P<key>[a-z0-9_.-]+) -->")

Record = dict[str, Any]


class Workplace:
    """The folder of one commit in OUT: results, and the data sets, networks and exports that rows share."""

    def __init__(self, out: Path, commit: str) -> None:
        self.folder, self.commit = out / commit, commit
        self.folder.mkdir(parents=True, exist_ok=True)

    def run(self, *words: object) -> Any:
        """Run a Python program or module of this checkout; return the JSON in the last line that it prints."""
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
        done = subprocess.run(
            [sys.executable, *map(str, words)], cwd=self.folder, env=environment, stdout=subprocess.PIPE, text=True
        )
        if done.returncode != 0:
            raise SystemExit(f"python {' '.join(map(str, words))} ended with {done.returncode}: see above.")
        return json.loads(done.stdout.splitlines()[-1])

    def plushsense(self, *words: object) -> Any:
        """Run a command of PlushSense."""
        return self.run("-m", "plushsense", *words, "--json")

    def bench(self, name: str, *words: object) -> Any:
        """Run another program of this folder."""
        return self.run(ROOT / "bench" / name, *words, "--json")

    def made(self, name: str) -> Path:
        """Return a data set, network or export of `headlines.SETS`, and make it if it is not there."""
        path = self.folder / name
        if not path.exists():
            draft = path.with_name(f"draft-{name}")
            shutil.rmtree(draft, ignore_errors=True)
            draft.unlink(missing_ok=True)
            SETS[name](self, draft)
            draft.rename(path)
        return path

    def measured(self, name: str, row: Row, seed: int | None, again: bool) -> Record:
        """Return the result of a row with one seed, from the folder if it is there."""
        path = self.folder / f"{name}{'' if seed is None else f'-seed-{seed}'}.json"
        if not path.exists() or again:
            began, load = time.perf_counter(), _load()
            figures = dict(row.measure(self, seed))
            origin = figures.pop("origin", {})
            result = {
                "figures": {
                    key: value if isinstance(value, dict) else {"value": value} for key, value in figures.items()
                },
                "date": f"{datetime.now(UTC):%Y-%m-%d}",
                "machine": machine(),
                "load": [load, _load()],
                "seconds": round(time.perf_counter() - began),
                **origin,
            }
            write_file(path, json.dumps(result))
        return dict(json.loads(path.read_text("utf-8")))


def _load() -> float | None:
    return round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None


def machine() -> str:
    """Describe processor, cores, system, Python, PyTorch, and the graphics card if `evaluate` would train on it."""
    import torch

    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    cpu = names[0] if names else platform.processor() or platform.machine()
    versions = f"Python {platform.python_version()}, PyTorch {version('torch')}"
    card = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{cpu}, {os.cpu_count()} cores, {platform.system()}, {versions}{card}"


def commit() -> str:
    """Return the commit that last changed `src`, marked if `src` has other changes."""
    dirty = git("status", "--porcelain", "--", "src")
    return git("log", "-1", "--format=%h", "--abbrev=8", "--", "src") + (CHANGED if dirty else "")


def record(row: Row, results: list[Record], seeds: list[int], commit: str) -> Record:
    """Join the results of the seeds of a row, of the figures in its lines: means over the seeds, and their spread."""
    figures: dict[str, Any] = {}
    for key in (key for line in row.lines for key in line.keys):
        of = [result["figures"][key] for result in results]
        values = [one["value"] for one in of]
        figures[key] = {**of[0], "value": None if None in values else values[0] if len(values) == 1 else fmean(values)}
        if "people_sd" in of[0]:
            figures[key]["people_sd"] = fmean(one["people_sd"] for one in of)
        if len(values) > 1 and None not in values:
            figures[key]["seeds_sd"] = stdev(values)
            figures[key].pop("ci95", None)
    loads = [load for result in results for load in result["load"] if load is not None]
    return {
        "figures": figures,
        "seeds": seeds,
        "commit": results[-1].get("commit", commit),
        "date": results[-1]["date"],
        "machine": results[-1]["machine"],
        "load": [min(loads), max(loads)] if loads else None,
        "seconds": sum(result["seconds"] for result in results),
        "note": results[-1].get("note", ""),
    }


def text_of(value: float | None, line: Line) -> str:
    """Format a number of a line of the table, with narrow spaces between groups as `plushsense.reports.table` has."""
    if value is None:
        return DASH
    return format(value, line.form).replace(",", "\N{NARROW NO-BREAK SPACE}").replace("%", " %")


SPREADS = {"people_sd": "± {} over people", "ci95": "95 % {}", "seeds_sd": "± {} over seeds", "range": "{}"}


def spread_of(figures: list[Record], line: Line) -> str:
    """Describe the spread of the figures of a line; "" if there is none."""
    found = []
    for key, words in SPREADS.items():
        ends = [end if isinstance(end := figure.get(key), list) else [end] for figure in figures]
        if any(end != [None] for end in ends):
            found.append(words.format(" / ".join(" to ".join(text_of(one, line) for one in end) for end in ends)))
    return ", ".join(found)


def bare(number: str) -> str:
    """Return a number without the spaces and commas between its groups."""
    return re.sub(r"[\s,]", "", number)


def requoted(text: str, numbers: dict[str, Record]) -> str:
    """Return a text whose quotes have the figures of ``numbers``, each as it was if it is equal.

    Raises:
        ValueError: for a mark that names no figure, or that does not follow a number.
    """

    def quote(match: re.Match[str]) -> str:
        lines = ROWS[match["row"]].lines if match["row"] in ROWS else ()
        line = next((line for line in lines if match["key"] in line.keys), None)
        if line is None or match["number"] is None:
            what = "names no figure of numbers.json" if line is None else "does not follow a number"
            raise ValueError(f"{match[0]}: the mark {what}.")
        found = text_of(numbers[match["row"]]["figures"][match["key"]]["value"], line)
        return match[0] if bare(found) == bare(match["number"]) else match[0].replace(match["number"], found, 1)

    return QUOTE.sub(quote, text)


def quoting() -> list[Path]:
    """Return the files that may quote figures; this page and that of `peers.py` are written by programs."""
    others = {PAGE, PAGE.with_name("peers.md")}
    return [ROOT / "README.md", *sorted(set((ROOT / "docs").rglob("*.md")) - others)]


def page(numbers: dict[str, Record]) -> str:
    """Return docs/measurements/numbers.md."""
    machines = list(dict.fromkeys(numbers[name]["machine"] for name in ROWS))
    letters = {one: chr(ord("A") + at) for at, one in enumerate(machines)}
    minutes = sum(row.minutes for row in ROWS.values())
    parts = [HEAD.format(hours=f"{minutes / 60:.0f}")]
    for question in QUESTIONS:
        rows = [
            cells
            for name, row in ROWS.items()
            if row.question == question
            for cells in _lines(name, row, numbers[name], letters)
        ]
        table = Table.of(("row", "figure", "value", "spread", "data, split, settings", "measured"), rows)
        parts.append(f"## {question}\n\n{table.markdown().replace(DASH, '–')}\n")
    parts.append("## Machines\n\n" + "".join(f"- {letter}: {one}\n" for one, letter in letters.items()))
    return "\n".join(parts)


HEAD = """\
<!-- Written by bench/measure.py (make bench) from docs/measurements/numbers.json: do not edit. -->
# Numbers

The headline figures of PlushSense in one table, with what each was measured on. Other pages have more figures and say
how they were measured. Where they or the README quote one of these, a test compares it with this table. Programs find
the same figures in [numbers.json](numbers.json).

```sh
make bench                              # every row: about {hours} hours on two idle cores; can be stopped and continued
make bench ROWS=chip-default,import     # some of them
make bench ROWS=strangers SEEDS=0       # with one seed
make bench BENCH_FLAGS=--list           # how long each takes, and when it was measured
```

The column *measured* names the last commit of `src`, the date, the [machine](#machines) and its load (average of a
minute, before and after; at 2, two cores are busy). A row with *as documented* was not measured again: commit and date
are those at which its figures were written down. **Times on a busy machine are longer than on an idle one**: rely on
ratios, whose two parts were measured alternately in one run, and on counts, which do not depend on the machine.
Standard deviations over people are means over the seeds. Nothing was measured on a real toy or a real chip.
"""


def _lines(name: str, row: Row, found: Record, letters: dict[str, str]) -> Iterator[list[str]]:
    seeds = found["seeds"]
    data = row.data + (f"; seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}" if seeds else "")
    load = ", load " + " to ".join(dict.fromkeys(f"{one:g}" for one in found["load"])) if found["load"] else ""
    measured = f"`{found['commit']}`, {found['date']}, {letters[found['machine']]}{load}"
    measured += f". {found['note']}" if found["note"] else ""
    for at, line in enumerate(row.lines):
        of = [found["figures"][key] for key in line.keys]
        value = " / ".join(text_of(one["value"], line) for one in of) + (f" {line.unit}" if line.unit else "")
        yield [
            f"`{name}`" if at == 0 else "",
            line.title,
            value,
            spread_of(of, line) or row.spread,
            data if at == 0 else "",
            measured if at == 0 else "",
        ]


def known() -> dict[str, Record]:
    """Return the records in the file."""
    return dict(json.loads(FILE.read_text("utf-8"))) if FILE.exists() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default=",".join(ROWS), help="rows to measure, joined by commas (all)")
    parser.add_argument("--seeds", help="seeds of rows that train (those of the row), joined by commas")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "numbers", help="folder of results")
    parser.add_argument("--again", action="store_true", help="also measure what OUT has already")
    parser.add_argument("--list", action="store_true", help="list the rows")
    parser.add_argument("--page", action="store_true", help="only write the page from the file")
    args = parser.parse_args()
    names = [name for name in args.rows.split(",") if name]
    if unknown := [name for name in names if name not in ROWS]:
        parser.error(f"there is no row {', '.join(unknown)}: accepted are {', '.join(ROWS)}")
    numbers = known()
    minutes = sum(ROWS[name].minutes for name in names)
    if args.list:
        rows = [(name, f"{ROWS[name].minutes:g}", numbers.get(name, {}).get("date", "never")) for name in names]
        print(Table.of(("row", "minutes", "measured"), rows).text(), end="\n\n")
    print(f"{len(names)} rows: about {minutes:g} minutes on two idle cores.", file=sys.stderr)
    if not args.list and not args.page:
        place = Workplace(args.out.resolve(), commit())
        again = args.again or place.commit.endswith(CHANGED)
        for name in names:
            row = ROWS[name]
            seeds = [int(seed) for seed in args.seeds.split(",")] if args.seeds and row.seeds else list(row.seeds)
            print(f"{name}, about {row.minutes:g} minutes …", file=sys.stderr, flush=True)
            results = [place.measured(name, row, seed, again) for seed in seeds or [None]]
            numbers = known() | {name: record(row, results, seeds, place.commit)}  # another run may have written, too
            numbers = {each: numbers[each] for each in ROWS if each in numbers}
            print(f"{name}: {numbers[name]['seconds'] / 60:.1f} minutes", file=sys.stderr, flush=True)
            write_file(FILE, json.dumps(numbers, indent=1, ensure_ascii=False) + "\n")
    if missing := [name for name in ROWS if name not in numbers]:
        print(f"no page yet, as these rows were never measured: {', '.join(missing)}", file=sys.stderr)
    elif not args.list:
        write_file(PAGE, page(numbers))
        for path in quoting():
            before = path.read_text("utf-8")
            if (after := requoted(before, numbers)) != before:
                write_file(path, after)
                print(f"quotes in {path.relative_to(ROOT)} changed: read what stands beside them", file=sys.stderr)


if __name__ == "__main__":
    main()
