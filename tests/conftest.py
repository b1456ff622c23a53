"""What tests share: the real recordings, and how a missing tool is treated."""

from __future__ import annotations

import contextlib
import ctypes
import fnmatch
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from support import apart
from support.memory import LIMIT_MB, memory_mb
from support.requirements import installed, missing

pytest_plugins = ["support.small_dataset", "support.small_windows", "support.study"]

# Many small arrays: threads only get in each other's way when tests run in parallel.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

REPO = Path(__file__).resolve().parents[1]
# CI draws the same examples every time, so that a change is judged by itself; at a desk they are new ones each time.
# No example has a deadline, which a busy machine would miss.
settings.register_profile("desk", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("PLUSHSENSE_REQUIRE") else "desk")


# Folders and fixtures of tests that take seconds; `make test-quick` leaves them out, and files marked `slow`.
SLOW_FOLDERS = {"bench", "cli", "deploy", "experiments", "faults", "studio", "workflow"}
SLOW_FIXTURES = {"real_data", "c_compiler", "target_here", "two_nodes", "lsl_possible", "publish_tools", "pty_possible"}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Run three tests on two processors; four of the studio, which wait half of their time (with five, pages stall)."""
    waiting = all("studio" in word for word in config.args)
    return max(2, (4 if waiting else 3) * (os.cpu_count() or 1) // 2)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import tests that `make test-quick` leaves out."""
    left_out = config.option.markexpr == "not slow" and _in_slow_place(collection_path)
    return True if left_out else None


def _in_slow_place(path: Path) -> bool:
    place = path.relative_to(REPO / "tests").as_posix() if path.is_relative_to(REPO / "tests") else ""
    return place.split("/")[0] in SLOW_FOLDERS


def _place(item: pytest.Item) -> str:
    """Return the path of a test's file within this folder."""
    return item.path.relative_to(REPO / "tests").as_posix() if item.path.is_relative_to(REPO / "tests") else ""


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Iterator[None]:
    """Mark the tests that `make test-quick` and `make test` leave out, and deal those that are left to the workers."""
    for item in items:
        case = item.callspec.id if isinstance(item, pytest.Function) and hasattr(item, "callspec") else ""
        if any(fnmatch.fnmatchcase(case, one) for mark in item.iter_markers("exhaustive_for") for one in mark.args):
            item.add_marker(pytest.mark.exhaustive)
        if _in_slow_place(item.path) or SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    yield
    items[:] = _dealt(items, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


def _dealt(items: list[pytest.Item], workers: int) -> list[pytest.Item]:
    """Deal the longest files to the workers in turn, then the others, in parts of as many tests each.

    `--dist worksteal` cuts the list into one such part for each worker.
    """
    files: dict[str, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(_place(item), []).append(item)
    parts: list[list[pytest.Item]] = [[] for _ in range(workers)]
    # The workers begin with the files that take longest: one of them begun late would end alone.
    for at, name in enumerate([name for name, own in files.items() if own[0].get_closest_marker("early")]):
        parts[at % workers] += files.pop(name)
    # What runs in one process beside a worker is asked for by one worker, if it can be.
    groups = {name: apart.group_of(own[0]) for name, own in files.items()}
    together = sorted(filter(groups.get, groups), key=groups.__getitem__)
    rest = [item for name in dict.fromkeys([*together, *files]) for item in files[name]]
    for at, part in enumerate(parts):
        size = (len(items) - sum(map(len, parts[:at]))) // (workers - at)
        room = max(0, size - len(part))
        part += rest[:room]
        del rest[:room]
    return [item for part in parts for item in part] + rest


# What each worker says of its memory: the most, and a line for each file that raised it beyond the limit, in MB.
PEAKS = pytest.StashKey[dict[str, float]]()
BEYOND = pytest.StashKey[list[str]]()


def pytest_configure(config: pytest.Config) -> None:
    """Have all threads share two arenas of memory (each keeps what was freed in it), and some files a process each."""
    config.stash[PEAKS], config.stash[BEYOND] = {}, []
    # Small data sets give rise to them; a test of warnings sees them all the same.
    config.addinivalue_line("filterwarnings", "ignore::plushsense.core.errors.PlushSenseWarning")
    # M_ARENA_MAX of glibc.
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).mallopt(-8, 2)
    if (plugin := apart.plugin()) is not None:
        config.pluginmanager.register(plugin, "apart")


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand what this worker knows of memory to the process that writes the summary."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        plugin = session.config.pluginmanager.get_plugin("apart")
        output["peak_mb"], output["beyond"] = memory_mb()[1], session.config.stash[BEYOND]
        output["apart"] = plugin.peaks if isinstance(plugin, apart.Worker) else {}


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Keep what a worker said of its memory."""
    output = getattr(node, "workeroutput", {})
    peaks, beyond = node.config.stash[PEAKS], node.config.stash[BEYOND]
    peaks[node.gateway.id] = output.get("peak_mb", 0.0)
    beyond += [f"{node.gateway.id}: {line}" for line in output.get("beyond", [])]
    for place, mb in output.get("apart", {}).items():
        peaks[place] = max(mb, peaks.get(place, 0.0))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print the largest memory of the processes that ran tests, and the files in which one passed the limit.

    No failure: which tests share a worker is chance.
    """
    peaks = config.stash[PEAKS] or {"pytest": memory_mb()[1]}
    if any(peaks.values()):
        of_workers = ", ".join(f"{name} {mb:.0f} MB" for name, mb in sorted(peaks.items()) if not name.endswith(".py"))
        terminalreporter.write_line(f"largest memory of the test processes: {of_workers}")
        for name, mb in sorted(peaks.items(), key=lambda item: -item[1]):
            if name.endswith(".py") and mb > 0.75 * LIMIT_MB:
                terminalreporter.write_line(f"  in a process of its own: {name} {mb:.0f} MB")
        for line in config.stash[BEYOND]:
            terminalreporter.write_line(f"  beyond {LIMIT_MB} MB: {line}")


@pytest.fixture(scope="session", autouse=True)
def one_processor() -> Iterator[None]:
    """Make trainings run in this process where a test does not say how many workers: each would import PyTorch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)
        yield


@pytest.fixture(scope="module", autouse=True)
def memory_returned(request: pytest.FixtureRequest) -> Iterator[None]:
    """Give freed memory back to the system after each module: after trainings it is more than 100 MB.

    A module that raised the most of this process beyond the limit is named in the summary.
    """
    before = memory_mb()[1]
    yield
    after = memory_mb()[1]
    if after > max(before, LIMIT_MB):
        line = f"{request.path.relative_to(REPO).as_posix()} {before:.0f} -> {after:.0f} MB"
        request.config.stash[BEYOND].append(line)
    # Only glibc has it.
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings beside the checkout; it is never committed."""
    folder = Path(os.environ.get("PLUSHSENSE_DATA", REPO.parent / "shared" / "data"))
    if not (folder / "makeability-gestures").is_dir():
        missing("data", f"no real recordings at {folder}")
    return folder


@pytest.fixture(scope="session")
def authors_run(real_data: Path) -> Path:
    """Files that the authors' own scripts and recorder wrote, beside the real recordings."""
    folder = real_data.parent / "authors-run"
    if not folder.is_dir():
        missing("data", f"no files of the authors' scripts at {folder}")
    return folder


@pytest.fixture(scope="session")
def imported_study(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The import of all real recordings of gestures; never to be changed by a test."""
    from plushsense.dataset.importing.importers import import_recordings

    folder = tmp_path_factory.mktemp("study")
    return import_recordings(real_data / "makeability-gestures", folder / "DS", layout="accel-3")


@pytest.fixture(scope="session")
def four_people(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of the real recordings of four people, to copy."""
    from plushsense.dataset.importing.importers import import_recordings

    folder = tmp_path_factory.mktemp("four")
    for person in ("P01", "P02", "P03", "P04"):
        shutil.copytree(real_data / "makeability-gestures" / person, folder / "raw" / person)
    return import_recordings(folder / "raw", folder / "DS", layout="accel-3").dataset.path


@pytest.fixture(scope="session")
def pty_possible() -> None:
    """Pseudo-terminals, which stand in for a serial port."""
    try:
        import pty

        for end in pty.openpty():
            os.close(end)
    except (ImportError, OSError) as cause:
        missing("pty", f"no pseudo-terminal here: {cause}")


@pytest.fixture(scope="session")
def c_compiler() -> str:
    """A C compiler of this machine: ``gcc``."""
    if shutil.which("gcc") is None:
        missing("compilers", "gcc is not installed")
    return "gcc"


@pytest.fixture(scope="session")
def all_compilers(c_compiler: str) -> None:
    """Every compiler of this machine that the toy's C is tried with."""
    for tool in ("clang", "g++"):
        if shutil.which(tool) is None:
            missing("compilers", f"{tool} is not installed")


@pytest.fixture(scope="session")
def lsl_possible() -> None:
    """The lab streaming layer, and a network on which a stream of this process is found."""
    try:
        import pylsl

        info = pylsl.StreamInfo(f"probe-{os.getpid()}", "Touch", 1, 0.0, "int32", f"probe-{os.getpid()}")
        outlet = pylsl.StreamOutlet(info)
        found = pylsl.resolve_byprop("name", info.name(), timeout=3.0)
        del outlet
    except (ImportError, RuntimeError) as cause:
        missing("lsl", f"no LSL here: {cause}")
    else:
        if not found:
            missing("lsl", "no LSL loopback here: a stream published on this machine is not found")


@pytest.fixture(scope="session")
def publish_tools() -> None:
    """The validators of a package (extra publish), and scikit-learn (extra baselines)."""
    for module in ("mlcroissant", "frictionless", "datacite", "sklearn"):
        installed(module, "publish")


@pytest.fixture(scope="session")
def cluster_possible() -> None:
    """Ray (extra cluster), and the system on which it can run several nodes on one machine."""
    installed("ray", "cluster")
    if not Path("/dev/shm").is_dir():
        missing("cluster", "several nodes of a Ray cluster on one machine are tested on Linux only")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"


@pytest.fixture(scope="session")
def onnx_here() -> None:
    """ONNX and the runtime that tries it (extra onnx)."""
    for module in ("onnx", "onnxruntime"):
        installed(module, "onnx")


@pytest.fixture(scope="session")
def litert_here() -> None:
    """LiteRT (extra tflite)."""
    installed("ai_edge_litert", "tflite")


@pytest.fixture(scope="session")
def scikit_learn() -> None:
    """Scikit-learn (extra baselines)."""
    installed("sklearn", "baselines")


@pytest.fixture(scope="session")
def target_here() -> Callable[[str], str]:
    """Makes sure that programs can be built for a target of `plushsense.deploy.targets` and run, and hands it back."""
    from plushsense.deploy.targets import missing_tools

    def here(target: str) -> str:
        if packages := missing_tools(target):
            missing("compilers" if target == "host" else "emulators", f"{target} needs {' '.join(packages)}")
        return target

    return here


# Bytes: a small /dev/shm must hold two.
_STORE = 80 * 2**20


@pytest.fixture(scope="module")
def two_nodes(cluster_possible: None) -> Iterator[Any]:
    """A head and a second node on this machine; nothing of it is left afterwards."""
    import ray
    from ray.cluster_utils import Cluster

    with tempfile.TemporaryDirectory(prefix="ps", ignore_cleanup_errors=True) as folder:
        # A short path: it holds sockets, whose names may have 107 bytes. Nothing is written to /tmp/ray.
        patch = pytest.MonkeyPatch()
        patch.setenv("RAY_TMPDIR", folder)
        jobs = str(REPO / "tests" / "jobs")
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [jobs, os.environ.get("PYTHONPATH")])))
        head = {"num_cpus": 1, "object_store_memory": _STORE, "include_dashboard": False, "temp_dir": f"{folder}/ray"}
        Path(folder, "ray").mkdir()
        cluster = Cluster(initialize_head=True, head_node_args=head)
        try:
            cluster.add_node(num_cpus=1, object_store_memory=_STORE)
            yield cluster
        finally:
            ray.shutdown()
            cluster.shutdown()
            patch.undo()
        left = _processes_of(folder)
        for _ in range(100):
            if not left:
                break
            time.sleep(0.1)
            left = _processes_of(folder)
        assert left == []


def _processes_of(folder: str) -> list[str]:
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if folder.encode() in (process / "cmdline").read_bytes():
                found.append(process.name)
        except OSError:
            continue
    return found
