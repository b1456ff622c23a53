"""Mutation testing: change one thing at random places of the code, and look whether a test fails (`make mutants`).

A mutant is one change of one line, drawn uniformly from the lines of the packages that can be changed. The tests that
run this line (outside functions: every test that runs something of the module) run against it in a copy of the
repository, the quickest first, in a process forked from one that has imported PyTorch. A mutant without a failing test
survives. `.ci/equivalent.toml` lists changes that no test can find, with the reason. `make coverage` has recorded which
test runs which line. Linux and macOS only.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib
import json
import math
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pytest
from changes import changed_source, changes
from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
SRC = ROOT / "src" / "plushsense"
STATE = ROOT / "build" / "coverage"
PACKAGES = ("runtime", "windows", "scoring", "deploy")
ROUNDS_S = (10.0, 120.0)  # of the tests of the first round, and of the second, for what survives the first
MEMORY_BYTES = 6 << 30
LOST = ("survived", "not run")


@dataclass(frozen=True)
class Mutant:
    module: str  # below src/plushsense
    line: int
    statement: int  # its first line
    in_function: bool
    number: int  # of the change in its module
    kind: str
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.module}:{self.line} {self.kind}: {self.before}  ->  {self.after}"


def sample_of(n: int, seed: int) -> list[Mutant]:
    """Draw lines of the packages, and a mutant of each."""
    places: dict[tuple[str, int], list[Mutant]] = defaultdict(list)
    for path in (path for package in PACKAGES for path in sorted((SRC / package).rglob("*.py"))):
        name = path.relative_to(SRC).as_posix()
        for i, (old, kind, new, statement, inside) in enumerate(changes(ast.parse(path.read_text("utf-8")))):
            before, after = (ast.unparse(node).split("\n")[0][:110] for node in (old, new))
            line: int = old.lineno  # type: ignore[attr-defined]
            places[name, line].append(Mutant(name, line, statement, inside, i, kind, before, after))
    draw = random.Random(seed)
    return [draw.choice(places[place]) for place in draw.sample(sorted(places), n)]


def rounds_of(sample: list[Mutant]) -> Iterator[list[tuple[list[str], float]]]:
    """Yield the tests of each mutant, quickest first, in rounds with their seconds."""
    seconds: dict[str, float] = json.loads((STATE / "seconds.json").read_text("utf-8"))
    data = CoverageData(str(STATE / "data"))
    data.read()
    files = {file.partition("src/plushsense/")[2]: file for file in data.measured_files()}
    for mutant in sample:
        by_line = data.contexts_by_lineno(files.get(mutant.module, ""))
        lines = {mutant.line, mutant.statement} if mutant.in_function else set(by_line)
        found = {test for line in lines for test in by_line.get(line, []) if test in seconds}
        tests = sorted(found, key=lambda test: (seconds[test], test))
        rounds = []
        for limit in ROUNDS_S:
            spent, mine = 0.0, list[str]()
            while tests and (spent + seconds[tests[0]] <= limit or not mine):
                spent += seconds[tests[0]]
                mine.append(tests.pop(0))
            rounds += [(mine, spent)] if mine else []
        yield rounds


class Chosen:
    """A plugin that runs only the chosen tests, file by file, in their order."""

    def __init__(self, tests: list[str]) -> None:
        self.place = {test: i for i, test in enumerate(tests)}
        self.file = {test.split("::")[0]: i for i, test in reversed(list(enumerate(tests)))}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self.place]
        items.sort(key=lambda item: (self.file[item.nodeid.split("::")[0]], self.place[item.nodeid]))


def run_tests(tree: Path, tests: list[str], seconds: float) -> str:
    """Run tests in a copy of the repository, in a forked process; return killed, survived or timed out."""
    child = os.fork()
    if child == 0:
        os.setsid()
        limit = 30 + int(5 * seconds)  # of the process's own time, of which a busy machine uses no more
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        output = os.open(tree / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(tree)
        sys.path.insert(0, str(tree / "src"))
        words = ["-x", "-p", "no:cacheprovider", "-p", "no:xdist", f"--basetemp={tree / 'tmp'}"]
        code: int = pytest.ExitCode.INTERNAL_ERROR
        try:
            code = pytest.main([*words, *sorted({test.split("::")[0] for test in tests})], plugins=[Chosen(tests)])
        finally:
            os._exit(code)
    end = time.monotonic() + 600 + 20 * seconds
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what tests left
    code = os.waitstatus_to_exitcode(ended[1])
    if code == pytest.ExitCode.NO_TESTS_COLLECTED:
        raise RuntimeError(f"The repository does not have these tests; remove {STATE}: {tests[:3]}")
    return {0: "survived", -signal.SIGXCPU: "timed out", -signal.SIGKILL: "timed out"}.get(code, "killed")


def judge(task: tuple[Mutant, list[tuple[list[str], float]]]) -> tuple[Mutant, str]:
    """Run the rounds of tests of a mutant in this worker's copy of the repository until one fails."""
    mutant, rounds = task
    target, result = Path("src/plushsense", mutant.module).resolve(), "not run"
    original = target.read_text("utf-8")
    write(target, changed_source(original, mutant.number) if mutant.kind else original)
    for tests, seconds in rounds:
        result = run_tests(Path.cwd(), tests, seconds)
        if result != "survived":
            break
    write(target, original)
    return mutant, result


def write(target: Path, text: str, stamps: Iterator[int] = iter(range(1_000_000_000, 2_000_000_000))) -> None:  # noqa: B008
    """Write a module with a time of its own: Python knows compiled files by size and whole seconds."""
    target.write_text(text, "utf-8")
    os.utime(target, (next(stamps),) * 2)


def enter_copy(parent: str) -> None:
    """Copy the repository's files, and work there."""
    tree = Path(tempfile.mkdtemp(dir=parent))
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(words, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0"):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
    os.chdir(tree)
    os.environ.setdefault("PLUSHSENSE_DATA", str(ROOT.parent / "shared" / "data"))
    os.environ.setdefault("PLUSHSENSE_REQUIRE", "nothing")  # the same random examples each time
    os.environ["PYTHONPATH"] = str(tree / "src")


def interval(k: int, n: int) -> str:
    """Return the share k of n in percent, with Wilson's 95 % interval."""
    p, z2 = k / n, 1.96**2
    middle, half = p + z2 / (2 * n), math.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n * n)))
    low, high = (100 * (middle + sign * half) / (1 + z2 / n) for sign in (-1, 1))
    return f"{100 * p:.1f} % ({low:.1f} to {high:.1f})"


def report(results: list[tuple[Mutant, str]]) -> None:
    """Print the survivors, and killed, timed out and survived by package."""
    rows = tomllib.loads((ROOT / ".ci" / "equivalent.toml").read_text("utf-8")).get("mutants", [])
    reasons = {(row["module"], row["before"], row["after"]): row["reason"] for row in rows}
    lost = [(m, result, reasons.get((m.module, m.before, m.after))) for m, result in results if result in LOST]
    for m, result, reason in sorted(lost, key=lambda row: (row[2] is not None, str(row[0]))):
        print(f"equivalent: {m} ({reason})" if reason else f"{result}: {m}")
    for package in (*PACKAGES, ""):
        mine = [result for m, result in results if m.module.startswith(package)]
        counts = ", ".join(f"{mine.count(result)} {result}" for result in ("killed", "timed out", *LOST))
        equal = sum(reason is not None for m, _, reason in lost if m.module.startswith(package))
        print(f"{package or 'all'}: {len(mine)} mutants: {counts} (equivalent: {equal})")
    n, found, equal = len(results), len(results) - len(lost), sum(reason is not None for *_, reason in lost)
    print(f"killed or timed out: {interval(found, n)}; of those not equivalent {interval(found, n - equal)}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Mutation testing of a random sample of lines.")
    parser.add_argument("--mutants", type=int, default=200, help="number of lines to sample")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--control", action="store_true", help="change nothing: all must survive")
    parser.add_argument("--again", action="store_true", help="run what survived the last time, not a new sample")
    args = parser.parse_args()
    lost = STATE / "lost.json"
    sample = [Mutant(**m) for m in json.loads(lost.read_text())] if args.again else sample_of(args.mutants, args.seed)
    if args.control:
        sample = [replace(mutant, kind="", before="", after="") for mutant in sample]
    for module in ("hypothesis", "numpy", "torch", "polars", "matplotlib", "cattrs", "jinja2", "safetensors.numpy"):
        importlib.import_module(module)
    tasks = list(zip(sample, rounds_of(sample), strict=True))
    results: list[tuple[Mutant, str]] = []
    with (
        tempfile.TemporaryDirectory() as parent,
        multiprocessing.get_context("fork").Pool(args.jobs, enter_copy, (parent,)) as workers,
    ):
        for mutant, result in workers.imap_unordered(judge, tasks):
            results.append((mutant, result))
            print(f"{len(results)}/{len(tasks)} {result}: {mutant}", file=sys.stderr, flush=True)
    lost.write_text(json.dumps([asdict(m) for m, result in results if result in LOST]))
    report(results)


if __name__ == "__main__":
    main()
