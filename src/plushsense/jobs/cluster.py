"""Run jobs as Ray tasks on a cluster. This is the only module that imports Ray (extra ``cluster``).

The driver (the process that starts the run) stores the results, as nodes may not share its file system. Ray repeats the
tasks of a lost node. An actor on the driver's node passes on messages of jobs, of which some may be lost.
"""

from __future__ import annotations

import os
import pickle
import re
import secrets
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from plushsense.core.errors import ConfigError, PlushSenseError, need
from plushsense.core.sentences import join_names
from plushsense.jobs.journal import Engine, Job, JobEvent, Take, portable, thread_settings

# Number of times that a task is started again after its process or node was lost.
_RETRIES = 3
# Number of tasks to submit beyond those that can run at once, so that no processor is idle.
_SPARE = 2
_LOOK_S = 0.5
_ANSWER_S = 4.0
# The HTTP/2 connection preface and an empty SETTINGS frame (RFC 9113, 3.4). Every Ray port replies to it in kind.
_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])


def on_cluster(take: Take, work_and_shared: tuple[Any, Any], address: str, *, threads: int, gpus: float) -> Engine:
    """Run the jobs that ``take`` returns as tasks of a cluster, as many at a time as it has processors for.

    Args:
        address: an address for `ray.init` ("auto", "host:6379", "ray://host:10001"), or "local" to start Ray here.
        threads: number of processors that each task requires, and of its threads.
        gpus: number of graphics processors that each task requires, which may be a fraction.

    Raises:
        MissingExtraError: without Ray. ConfigError: when the cluster cannot be reached, or no node is large enough.
        PlushSenseError: when a node cannot run PlushSense.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Leave graphics processors visible to tasks that request none, as Ray does by default today.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    ray = need("ray", extra="cluster")
    with _connected(ray, address):
        yield from _conduct(ray, take, work_and_shared, threads, gpus)


@contextmanager
def _connected(ray: Any, address: str) -> Iterator[None]:
    """Connect to the cluster for the duration of the context; an existing connection is used and left open."""
    if ray.is_initialized():
        yield
        return
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == "local":
        # By default Ray reserves a third of the memory for objects, far more than needed.
        quiet |= {"include_dashboard": False, "object_store_memory": 200 * 2**20}
    else:
        _knock(address)
    try:
        ray.init(address, **quiet)
    except (Exception, SystemExit) as cause:
        raise _no_connection(address, cause) from cause
    # Ray prints long messages on standard output when a node is lost, whatever its settings for logs.
    inner: Any = need("ray._private.worker", extra="cluster")
    loud = getattr(inner, "print_to_stdstream", None)
    inner.print_to_stdstream = lambda *_, **__: None
    try:
        yield
    finally:
        ray.shutdown()
        if loud is not None:
            inner.print_to_stdstream = loud


def _knock(address: str) -> None:
    """Raise ConfigError if no Ray answers at an address within seconds; Ray itself would try for a minute."""
    if address == "auto" or os.environ.get("RAY_USE_TLS") == "1":
        return
    found = re.fullmatch(r"(?:ray://)?(?:\[([^]]+)\]|([^:/\s\[\]]+)):(\d{1,5})", address)
    if found is None or not 0 < int(found[3]) < 65536:
        raise ConfigError(
            f"'{address}' is not the address of a cluster: accepted are auto, local, HOST:PORT (as  ray start --head  "
            "prints) and ray://HOST:10001."
        )
    try:
        with socket.create_connection((found[1] or found[2], int(found[3])), timeout=_ANSWER_S) as line:
            line.sendall(_HELLO)
            # The fourth byte of a frame is its type, after 3 bytes of length; 4 is SETTINGS.
            answer = line.recv(4)
            if len(answer) < 4 or answer[3] != 4:
                raise OSError("what answers there is not Ray")
    except OSError as cause:
        raise _no_connection(address, cause) from cause


def _no_connection(address: str, cause: BaseException) -> PlushSenseError:
    reason = str(cause)
    if "ersion mismatch" in reason:
        versions = [" ".join(found) for found in re.findall(r"(Ray|Python): *(\S+)", reason)]
        both = f"{join_names(versions[:2])}; here {join_names(versions[2:])}" if versions else _first_line(reason)
        return ConfigError(
            f"The cluster at '{address}' has other versions ({both}): install the same Python and Ray on both."
        )
    if isinstance(cause, TimeoutError):
        reason = "no answer"
    elif isinstance(cause, OSError) and cause.strerror:
        reason = cause.strerror
    return ConfigError(
        f"No cluster can be reached at '{address}' ({_first_line(reason)}): start one with  ray start --head  and give "
        "the address that it prints; from a machine outside the cluster give ray://HOST:10001."
    )


def _first_line(text: str) -> str:
    return next((line.strip().rstrip(".:") for line in text.splitlines() if line.strip()), "it gave no reason")[:160]


def _conduct(ray: Any, take: Take, work_and_shared: tuple[Any, Any], threads: int, gpus: float) -> Engine:
    if _slots(ray, threads, gpus) == 0:
        resources = f"{threads} processors" + (f" and {gpus:g} graphics processors" if gpus else "")
        raise ConfigError(f"No node of the cluster has {resources}, which each job asks for: give fewer threads.")
    # Ray's pickle includes what the user's script defines. Each process unpacks it once, from bytes, so that the arrays
    # are writable as in the pool; arrays in an object that Ray itself unpacks are read-only.
    packed = ray.put(ray.cloudpickle.dumps(work_and_shared))
    run = secrets.token_hex(8)
    board = ray.remote(_Board).options(num_cpus=0, max_restarts=-1, **_beside(ray)).remote()
    task = ray.remote(_task).options(
        num_cpus=threads,
        num_gpus=gpus,
        max_retries=_RETRIES,
        runtime_env={"env_vars": thread_settings(threads)},
    )
    out: dict[Any, Job] = {}
    try:
        pending: Any = None
        looked = 0.0
        more = True
        while more or out:
            while more and len(out) < _slots(ray, threads, gpus) + _SPARE:
                job = take()
                if job is None:
                    more = False
                else:
                    out[task.remote(run, _version(), [packed], board, job.id, job.task)] = job
            ready, _ = ray.wait(list(out), num_returns=len(out), timeout=0) if out else ([], [])
            if not ready and out:
                ready, _ = ray.wait(list(out), num_returns=1, timeout=_LOOK_S)
            now = time.monotonic()
            if pending is None and now - looked >= _LOOK_S:
                pending, looked = board.take.remote(), now
            if pending is not None and ray.wait([pending], timeout=0)[0]:
                yield from _messages(ray, pending, out)
                pending = None
            for ref in ready:
                yield _outcome(ray, ref, out.pop(ref))
    finally:
        for ref in out:
            with suppress(Exception):
                ray.cancel(ref, force=True)
        with suppress(Exception):
            ray.kill(board)


def _slots(ray: Any, threads: int, gpus: float) -> int:
    """Return the number of tasks that can run at once."""
    slots = 0
    for node in ray.nodes():
        has = node["Resources"] if node["Alive"] else {}
        fits = int(has.get("CPU", 0) // threads)
        slots += min(fits, int(has.get("GPU", 0) / gpus + 1e-9)) if gpus else fits
    return slots


def _beside(ray: Any) -> dict[str, Any]:
    """Return the options that place an actor on the driver's node, without which the run cannot continue anyway."""
    strategy = need("ray.util.scheduling_strategies", extra="cluster").NodeAffinitySchedulingStrategy
    return {"scheduling_strategy": strategy(ray.get_runtime_context().get_node_id(), soft=True)}


def _messages(ray: Any, pending: Any, out: dict[Any, Job]) -> Iterator[JobEvent]:
    """Yield the messages of the jobs since the previous request."""
    try:
        messages = ray.get(pending)
    except ray.exceptions.RayError:
        return
    at = {job.id: job for job in out.values()}
    for job, kind, packed in messages:
        # Ignore the message of a job that has finished in the meantime.
        if job in at:
            with suppress(Exception):
                yield JobEvent(at[job], kind, pickle.loads(packed))


def _outcome(ray: Any, ref: Any, job: Job) -> JobEvent:
    errors = ray.exceptions
    try:
        kind, packed = ray.get(ref)
    except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError, errors.ObjectLostError) as cause:
        lost = PlushSenseError(
            f"This job was given up: its process or node was lost {_RETRIES + 1} times ({_first_line(str(cause))}), "
            "perhaps for lack of memory: run again, finished jobs are kept."
        )
        return JobEvent(job, "failed", lost)
    except errors.RayError as cause:
        raise _unfit(str(cause)) from cause
    payload = pickle.loads(packed)
    if kind == "lost":
        raise payload
    return JobEvent(job, kind, payload)


def _unfit(reason: str) -> PlushSenseError:
    """Return the error for a node that cannot run any task."""
    missing = re.search(r"No module named '?([\w.]+)", reason)
    if missing:
        return PlushSenseError(
            f"A node of the cluster lacks the package '{missing[1]}': install the same PlushSense with the same extras "
            "on every node; finished jobs are kept."
        )
    return PlushSenseError(
        f"The cluster cannot run this ({_first_line(reason.splitlines()[-1] if reason else '')}): install the same "
        "PlushSense, Python and Ray on every node; finished jobs are kept."
    )


class _Board:
    """The actor that collects messages between requests of the driver: started jobs, and each job's latest report."""

    def __init__(self) -> None:
        self._begun: list[str] = []
        self._latest: dict[str, bytes] = {}

    def begun(self, job: str) -> None:
        self._begun.append(job)

    def put(self, job: str, packed: bytes) -> None:
        self._latest[job] = packed

    def take(self) -> list[tuple[str, str, bytes]]:
        nothing = pickle.dumps(None)
        messages = [(job, "started", nothing) for job in self._begun]
        messages += [(job, "report", packed) for job, packed in self._latest.items()]
        self._begun, self._latest = [], {}
        return messages


# The last unpacked (run, work, shared) of this process.
_unpacked: tuple[str, Any, Any] | None = None


def _task(run: str, expected: str, packed: list[Any], board: Any, job: str, task: Any) -> tuple[str, bytes]:
    """Run one job on a node; return ("done", result), ("failed", exception) or, if no job can run, ("lost", error)."""
    global _unpacked
    ray = need("ray", extra="cluster")
    if expected != _version():
        other = PlushSenseError(
            f"A node of the cluster has PlushSense {_version()} where the run was started with {expected}: install the "
            "same on every node; finished jobs are kept."
        )
        return "lost", pickle.dumps(other)
    board.begun.remote(job)
    try:
        if _unpacked is None or _unpacked[0] != run:
            _unpacked = (run, *pickle.loads(ray.get(packed[0])))
    except ImportError as cause:
        return "lost", pickle.dumps(_unfit(str(cause)))
    try:
        result = _unpacked[1](_unpacked[2], task, _sparing(lambda packed: board.put.remote(job, packed)))
        return "done", pickle.dumps(result)
    except Exception as error:  # noqa: BLE001, RUF100
        return "failed", pickle.dumps(portable(error))


def _version() -> str:
    try:
        return version("plushsense")
    except PackageNotFoundError:
        return "that is not installed"


def _sparing(send: Callable[[bytes], Any]) -> Callable[[Any], None]:
    """Return a callback that sends at most two reports a second and never raises."""
    last = 0.0

    def report(message: Any) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _LOOK_S:
            last = now
            with suppress(Exception):
                send(pickle.dumps(message))

    return report
