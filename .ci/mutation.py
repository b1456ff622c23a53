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
import gc
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
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest
from changes import changed_tree, changes
from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
SRC = ROOT / "src" / "plushsense"
STATE = ROOT / "build" / "coverage"
PACKAGES = ("runtime", "windows", "scoring", "deploy")
# For constants, which no line of a test reads: the reference pins defaults, the formats answers of a network.
ALWAYS = ("tests/test_reference.py", "tests/test_formats.py")
MEMORY_BYTES = 6 << 30
LOST = ("survived", "not run")


@dataclass(frozen=True)
class Mutant:
    module: str  # below src/plushsense
    line: int
    column: int
    statement: int  # its first line
    in_function: bool
    number: int  # of the change in its module
    kind: str
    before: str
    after: str

    @property
    def change(self) -> tuple[str, str, str]:
        """The text of the line with a mark where the change is, before and after."""
        line = (SRC / self.module).read_text("utf-8").splitlines()[self.line - 1]
        return f"{line[: self.column]}@{line[self.column :]}".strip(), self.before, self.after

    def __str__(self) -> str:
        return f"{self.module}:{self.line} {self.kind}: {self.before}  ->  {self.after}"


Task = tuple[Mutant, list[str], float]
"""A mutant, its tests, and the seconds that they take."""


def sample_of(n: int, seed: int) -> list[Mutant]:
    """Draw lines of the packages, and a mutant of each."""
    places: dict[tuple[str, int], list[Mutant]] = defaultdict(list)
    for path in (path for package in PACKAGES for path in sorted((SRC / package).rglob("*.py"))):
        name = path.relative_to(SRC).as_posix()
        for i, (old, kind, new, statement, inside) in enumerate(changes(ast.parse(path.read_text("utf-8")))):
            before, after = (ast.unparse(node).split("\n")[0][:110] for node in (old, new))
            place: tuple[int, int] = old.lineno, old.col_offset  # type: ignore[attr-defined]
            places[name, place[0]].append(Mutant(name, *place, statement, inside, i, kind, before, after))
    draw = random.Random(seed)
    return [draw.choice(places[place]) for place in draw.sample(sorted(places), n)]


def tests_of(sample: list[Mutant], most: float) -> Iterator[tuple[list[str], float]]:
    """Yield the tests of each mutant, quickest first, and their seconds, ``most`` in all."""
    seconds: dict[str, float] = json.loads((STATE / "seconds.json").read_text("utf-8"))
    data = CoverageData(str(STATE / "data"))
    data.read()
    files = {file.partition("src/plushsense/")[2]: file for file in data.measured_files()}
    for mutant in sample:
        by_line = data.contexts_by_lineno(files.get(mutant.module, ""))
        lines = {mutant.line, mutant.statement} if mutant.in_function else set(by_line)
        tests = {test for line in lines for test in by_line.get(line, []) if test in seconds}
        if not mutant.in_function:
            tests |= {test for test in seconds if test.startswith(ALWAYS)}
        spent, chosen = 0.0, list[str]()
        for test in sorted(tests, key=lambda test: (seconds[test], test)):
            spent += seconds[test]
            if spent <= most or not chosen:
                chosen.append(test)
        yield chosen, min(spent, most)


class Forks:
    """A plugin that runs tests file by file, the quickest first; of mutants, each in a fork with its tests."""

    def __init__(self, tests: list[str], tasks: list[Task] | None = None, results: Any = None) -> None:
        self.tests, self.tasks, self.results = tests, tasks, results

    def chosen(self, items: list[pytest.Item], tests: list[str]) -> list[pytest.Item]:
        place = {test: i for i, test in enumerate(tests)}
        file = {test.split("::")[0]: i for test, i in reversed(place.items())}
        mine = [item for item in items if item.nodeid in place]
        return sorted(mine, key=lambda item: (file[item.nodeid.split("::")[0]], place[item.nodeid]))

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = self.chosen(items, self.tests)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        known = [value for value in gc.get_objects() if type(value) is FunctionType]
        gc.freeze()  # so that a collection in a fork does not copy all pages
        for mutant, tests, seconds in self.tasks or ():
            name = "plushsense." + mutant.module.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
            mine = [function for function in known if function.__module__ == name]
            with changed_module(mutant) as code:
                self.results.put((mutant, forked(partial(self.run, session, tests, mine, code), seconds)))
        return None if self.tasks is None else True

    def run(self, session: pytest.Session, tests: list[str], known: list[FunctionType], code: CodeType) -> int:
        """Run tests with the code of a changed module in its functions, wherever they are used, if it is loaded."""
        parts, new = [code], {}
        for part in parts:
            parts += [constant for constant in part.co_consts if isinstance(constant, CodeType)]
            new[part.co_qualname, part.co_firstlineno] = part
        for function in known:
            old = function.__code__
            function.__code__ = new.get((old.co_qualname, old.co_firstlineno), old)
        factory = session.config._tmp_path_factory  # type: ignore[attr-defined]
        factory._given_basetemp, factory._basetemp = Path("tmp").resolve(), None
        session.items = self.chosen(session.items, tests)
        for i, item in enumerate(session.items):
            after = session.items[i + 1] if i + 1 < len(session.items) else None
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            if session.testsfailed:
                return pytest.ExitCode.TESTS_FAILED
        return pytest.ExitCode.OK if session.items else pytest.ExitCode.NO_TESTS_COLLECTED


def run_pytest(plugin: Forks) -> int:
    sys.path.insert(0, str(Path("src").resolve()))
    files = sorted({test.split("::")[0] for test in plugin.tests})
    words = ["-x", "-p", "no:cacheprovider", "-p", "no:xdist", f"--basetemp={Path('tmp').resolve()}"]
    return pytest.main([*words, *files], plugins=[plugin])


def forked(run: Callable[[], int], seconds: float) -> str:
    """Run tests of some seconds in a fork of this process; return killed, survived or timed out."""
    child = os.fork()
    if child == 0:
        os.setsid()
        limit = 30 + int(5 * seconds)  # of the process's own time, of which a busy machine uses no more
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        code: int = pytest.ExitCode.TESTS_FAILED
        try:
            code = run()
        finally:
            os._exit(code)
    end = time.monotonic() + 600 + 20 * seconds
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.01)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what tests left
    code = os.waitstatus_to_exitcode(ended[1])
    if code == pytest.ExitCode.NO_TESTS_COLLECTED:
        raise RuntimeError("The repository does not have the tests of build/coverage: run  make coverage")
    return {0: "survived", -signal.SIGXCPU: "timed out", -signal.SIGKILL: "timed out"}.get(code, "killed")


@contextlib.contextmanager
def changed_module(mutant: Mutant) -> Iterator[CodeType]:
    """Write the change into this copy of the repository for a while; yield the code of the module."""
    target = Path("src/plushsense", mutant.module).resolve()
    original = target.read_text("utf-8")
    tree = changed_tree(original, mutant.number) if mutant.kind else ast.parse(original)
    try:
        write(target, ast.unparse(tree))
        yield compile(tree, str(target), "exec", dont_inherit=True)
    finally:
        write(target, original)
        shutil.rmtree("tmp", ignore_errors=True)


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
    for descriptor in (1, 2):
        os.dup2(os.open("output.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)


def in_functions(tasks: list[Task], parent: str, results: Any) -> None:
    """Run mutants in functions, whose code is exchanged after all tests are loaded: the tests then begin at once."""
    enter_copy(parent)
    run_pytest(Forks([test for _, tests, _ in tasks for test in tests], tasks, results))


def from_the_start(tasks: list[Task], parent: str, results: Any) -> None:
    """Run mutants in processes that have not loaded the package yet."""
    enter_copy(parent)
    for mutant, tests, seconds in tasks:
        with changed_module(mutant):
            results.put((mutant, forked(partial(run_pytest, Forks(tests)), seconds)))


def reporting(work: Callable[..., None], tasks: list[Task], parent: str, results: Any) -> None:
    """Run mutants in this process; put the traceback of an error among the results, as its output is not shown."""
    try:
        work(tasks, parent, results)
    except BaseException:
        results.put((None, traceback.format_exc()))
        raise


def judged(work: Callable[..., None], tasks: list[Task], jobs: int) -> Iterator[tuple[Mutant, str]]:
    """Yield the results of a stage, by several processes; raise RuntimeError if one of them fails."""
    fork = multiprocessing.get_context("fork")
    results = fork.SimpleQueue()
    with tempfile.TemporaryDirectory() as parent:
        workers = [fork.Process(target=reporting, args=(work, tasks[i::jobs], parent, results)) for i in range(jobs)]
        for worker in workers:
            worker.start()
        try:
            for _ in tasks:
                mutant, result = results.get()
                if mutant is None:
                    raise RuntimeError(f"A process that runs mutants failed:\n{result}")
                yield mutant, result
        finally:
            for worker in workers:
                worker.terminate()
                worker.join()


def interval(k: int, n: int) -> str:
    """Return the share k of n in percent, with Wilson's 95 % interval."""
    p, z2 = k / n, 1.96**2
    middle, half = p + z2 / (2 * n), math.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n * n)))
    low, high = (100 * (middle + sign * half) / (1 + z2 / n) for sign in (-1, 1))
    return f"{100 * p:.1f} % ({low:.1f} to {high:.1f})"


def report(results: list[tuple[Mutant, str]]) -> None:
    """Print the survivors, and killed, timed out and survived by package."""
    rows = tomllib.loads((ROOT / ".ci" / "equivalent.toml").read_text("utf-8")).get("mutants", [])
    reasons = {(row["module"], row["line"], row["before"], row["after"]): row["reason"] for row in rows}
    lost = [(m, result, reasons.get((m.module, *m.change))) for m, result in results if result in LOST]
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
    parser.add_argument("--seconds", type=float, default=30.0, help="of the tests for a mutant, the quickest first")
    parser.add_argument("--control", action="store_true", help="change nothing: all must survive")
    parser.add_argument("--again", action="store_true", help="run what survived the last time, not a new sample")
    args = parser.parse_args()
    lost = STATE / "lost.json"
    sample = [Mutant(**m) for m in json.loads(lost.read_text())] if args.again else sample_of(args.mutants, args.seed)
    if args.control:
        sample = [replace(mutant, kind="", before="", after="") for mutant in sample]
    for module in ("hypothesis", "numpy", "torch", "polars", "matplotlib", "cattrs", "jinja2", "safetensors.numpy"):
        importlib.import_module(module)
    tasks = [(mutant, *found) for mutant, found in zip(sample, tests_of(sample, args.seconds), strict=True)]
    results = dict.fromkeys(sample, "not run")

    def take(found: Iterator[tuple[Mutant, str]]) -> None:
        for mutant, result in found:
            results[mutant] = result
            print(f"{result}: {mutant}", file=sys.stderr, flush=True)

    take(judged(in_functions, [task for task in tasks if task[0].in_function and task[1]], args.jobs))
    # What a function returned when its module was loaded may have been kept: look again at what survived.
    rest = [task for task in tasks if task[1] and results[task[0]] in LOST]
    take(judged(from_the_start, rest, args.jobs))
    lost.write_text(json.dumps([asdict(m) for m, result in results.items() if result in LOST]))
    report(list(results.items()))


if __name__ == "__main__":
    main()
