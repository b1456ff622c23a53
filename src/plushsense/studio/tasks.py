"""Define the long tasks of the studio and the worker process in which `plushsense.studio.app.jobs` runs each one.

The worker reads one line of JSON, ``{"task": ..., "spec": {...}}``, from standard input. It writes lines of JSON to
standard output: ``{"progress": {...}}``, ``{"warning": ...}``, and finally ``{"result": {...}}`` or ``{"refused":
{...}}``, a `Message` as JSON. A process that ends with neither of these was stopped.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, PlushSenseError, ToolError
from plushsense.core.files import free_path, write_file
from plushsense.core.sentences import Message, plain
from plushsense.dataset.backup import backup, is_backup, restore
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.importing.importers import import_recordings, propose
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.forget import forget
from plushsense.dataset.publishing.checking import validate_package
from plushsense.dataset.store import HEAD
from plushsense.deploy.profile import profile
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import verify
from plushsense.jobs.progress import JobProgress
from plushsense.studio.app.jobs import UNFINISHED
from plushsense.studio.app.workspace import folder_digest, refusal_of
from plushsense.training.spec import EpochRow
from plushsense.workflow.api import simulate, train, unfinished
from plushsense.workflow.config import from_settings
from plushsense.workflow.datasets import PublishSpec, check_dataset, publish_dataset
from plushsense.workflow.export import export
from plushsense.workflow.networks import REFIT
from plushsense.workflow.preparation import count_people, refits
from plushsense.workflow.reporting import check_folder


class TaskReporter:
    """Writer of the progress and warnings of a task as lines of JSON; its methods are thread-safe."""

    def __init__(self, out: Any) -> None:
        self._out, self._lock = out, threading.Lock()

    def write(self, **message: Any) -> None:
        """Write one line of JSON."""
        with self._lock:
            self._out.write(json.dumps(plain(message), ensure_ascii=True, default=str) + "\n")
            self._out.flush()

    def progress(self, **values: Any) -> None:
        """Report the progress of the task."""
        self.write(progress=values)

    def count(self, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` items are done."""
        self.progress(done=done, total=total)

    def stage(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` items of a stage are done."""
        self.progress(stage=stage, done=done, total=total)

    def warn(self, sentence: str) -> None:
        """Report a warning to the user."""
        self.write(warning=plain(sentence))


class Clock:
    """Estimator of the remaining time of a task from the share of the work that is done.

    A resumed task reports the work of earlier runs within moments, which does not indicate its speed. Therefore, time
    is measured from the first report that came more than ``instant_s`` after the previous one.
    """

    def __init__(self, instant_s: float = 0.02) -> None:
        self._instant_s = instant_s
        self._last_s = self._start_s = time.monotonic()
        self._start_share = 0.0

    def at(self, share: float) -> dict[str, Any]:
        """Return a dictionary with ``share`` and ``left_s``, the remaining seconds (None if unknown)."""
        now = time.monotonic()
        if self._start_share == 0.0 or (now - self._last_s < self._instant_s and now - self._start_s < 1.0):
            self._start_share, self._start_s = share, now
        self._last_s = now
        gained = share - self._start_share
        left = (now - self._start_s) / gained * (1.0 - share) if gained > 0 else None
        return {"share": round(share, 4), "left_s": None if left is None else round(left, 1)}


def _check(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Check every recording of the data set ``spec["dataset"]`` and return counts of the findings."""
    report = check_dataset(spec["dataset"], progress=reporter.count)
    by_severity = report.counts()["by_severity"]
    return {"dataset": str(spec["dataset"]), "undecided": len(report.undecided), "by_severity": by_severity}


UNPACKED = UnpackLimits(total_bytes=4_000_000_000, files=50_000)
"""Limits for unpacking an uploaded zip."""


def _import(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Import ``sessions`` (folders in ``recordings``, collected in ``work``) into ``dest``.

    With ``add``, ``dest`` is an existing data set.
    """
    settings: dict[str, Any] = {"add_to": True} if spec.get("add") else {"name": spec.get("name") or None}
    with _collected(spec) as source:
        done = import_recordings(source, spec["dest"], progress=reporter.count, **settings)
    halving = done.head.get("halving", {})
    return {"out": str(done.out), "best": done.head["best"], "winner": halving.get("winner", {})}


def _profile(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Profile the exported code in the folder ``spec["place"]``."""
    return {"profile": _profile_of(Path(spec["place"]), reporter)}


def _profile_of(folder: Path, reporter: TaskReporter) -> dict[str, Any]:
    """Return the profile of an export, or the reason ``refused`` why there is none, with a ``digest`` of the files."""
    digest = folder_digest(folder)
    reporter.progress(stage="profile")
    try:
        return {"digest": digest, **profile(folder, progress=partial(reporter.stage, "profile")).to_json()}
    except ToolError as refusal:
        # Not an error: an export without a profile is valid.
        return {"digest": digest, "refused": refusal.message}


def _export(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Export ``bundle`` to ``place``, in the formats ``also`` too; calibrate it again if ``dataset`` is not ""."""
    reporter.progress(stage="export")
    done = export(
        spec["bundle"],
        spec["place"],
        dataset=spec.get("dataset") or None,
        also=spec.get("also", ()),
        warn=reporter.warn,
    )
    return {**done.to_json(), "profile": _profile_of(Path(spec["place"]), reporter)}


_SAMPLES = 100_000


def _verify(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Verify the export ``place`` on ``targets``, by default on all that are available.

    The input is recordings of ``dataset`` if given, else generated data. With ``trust``, also verify a folder with code
    that PlushSense does not write.
    """
    folder = Path(spec["place"])
    digest = folder_digest(folder)
    reporter.progress(stage="vectors")
    export = Export(folder)
    dataset = spec.get("dataset")
    vectors = export.recorded(open_dataset(dataset), [], _SAMPLES) if dataset else export.made_up(0)
    done = verify(
        export,
        spec.get("targets", ()),
        vectors,
        trust=bool(spec.get("trust")),
        progress=partial(reporter.stage, "verify"),
    )
    return {**done.to_json(), "digest": digest}


TASKS: dict[str, Callable[[dict[str, Any], TaskReporter], dict[str, Any]]] = {
    "check": _check,
    "make": _make,
    "train": _train,
    "sweep": _sweep,
    "search": _sweep,
    "evaluate": _evaluate,
    "import": _import,
    "inspect": _inspect,
    "publish": _publish,
    "export": _export,
    "verify": _verify,
    "simulate": _simulate,
    "profile": _profile,
    "validate": _validate,
    "backup": _backup,
    "restore": _restore,
    "forget": _forget,
}
"""Functions of the tasks by name. Specs and results contain only JSON values."""


def main() -> int:
    """Run the requested task; return 0 if it succeeded, 1 if it was interrupted, and 2 if it failed."""
    # Libraries may print, but standard output is reserved for messages.
    out, sys.stdout = sys.stdout, sys.stderr
    reporter = TaskReporter(out)
    line = sys.stdin.readline()
    threading.Thread(target=_end_with_studio, daemon=True).start()
    try:
        request = json.loads(line)
        reporter.write(result=TASKS[request["task"]](request["spec"], reporter))
    except KeyboardInterrupt:
        return 1
    except PlushSenseError as refusal:
        reporter.write(refused=refusal.message.to_json())
        return 2
    except OSError as cause:
        reporter.write(refused=refusal_of(cause).to_json())
        return 2
    except Exception as cause:  # noqa: BLE001, RUF100
        what = f"{type(cause).__name__}: {cause}"
        message = Message("The work broke off: {what}. What was finished is kept.", what=what)
        reporter.write(refused=message.to_json())
        return 2
    return 0


def _end_with_studio() -> None:
    """Wait until the studio ends, which closes standard input; then end this process."""
    while sys.stdin.read(1):
        pass
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        # This also ends all processes that the task has started.
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
