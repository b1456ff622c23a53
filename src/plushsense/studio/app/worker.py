"""The process in which a long task of the studio runs: reads one JSON line, writes JSON lines.

Out come ``{"progress": {...}}``, ``{"warning": "..."}`` and in the end ``{"result": {...}}`` or ``{"refused": "..."}``;
a process that ends without either was stopped.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

from plushsense.core.errors import PlushSenseError

TASKS = {
    "check": "run_check",
    "train": "run_train",
    "sweep": "run_sweep",
    "search": "run_search",
    "evaluate": "run_evaluate",
    "import": "run_import",
    "publish": "run_publish",
    "export": "run_export",
    "verify": "run_verify",
    "simulate": "run_simulate",
    "profile": "run_profile",
    "validate": "run_validate",
    "pseudonymise": "run_pseudonymise",
}
"""Task to the function in `plushsense.studio.tasks` that does it:
``(spec, reporter) -> result``, plain values all; ``reporter`` is a `ProgressReporter`."""


class TaskReporter:
    """Writes a task's progress and warnings as JSON lines; methods may be called from any thread."""

    def __init__(self, out: Any) -> None:
        self._out, self._lock = out, threading.Lock()

    def __call__(self, **message: Any) -> None:
        """Write one line of JSON; not for tasks."""
        with self._lock:
            self._out.write(json.dumps(message, ensure_ascii=True, default=str) + "\n")
            self._out.flush()

    def progress(self, **values: Any) -> None:
        """Report the progress of the task as plain values."""
        self(progress=values)

    def warn(self, sentence: str) -> None:
        """Report a warning to the user."""
        self(warning=sentence)


Task = Callable[[dict[str, Any], TaskReporter], dict[str, Any]]


def main() -> int:
    """Run one task; return 0 if it is done, 1 if interrupted, 2 if refused."""
    # Libraries may print; standard output is for messages alone.
    out, sys.stdout = sys.stdout, sys.stderr
    reporter = TaskReporter(out)
    line = sys.stdin.readline()
    threading.Thread(target=_watch, daemon=True).start()
    try:
        request = json.loads(line)
        tasks = importlib.import_module("plushsense.studio.tasks")
        task: Task = getattr(tasks, TASKS[request["task"]])
        reporter(result=task(request["spec"], reporter))
    except KeyboardInterrupt:
        return 1
    except PlushSenseError as refusal:
        reporter(refused=str(refusal))
        return 2
    except OSError as cause:
        reporter(
            refused=f"The system refused: {cause.strerror or cause}{f' ({cause.filename})' if cause.filename else ''}."
        )
        return 2
    except Exception as cause:  # noqa: BLE001, RUF100
        reporter(refused=f"The work broke off ({type(cause).__name__}: {cause}): what was finished is kept.")
        return 2
    return 0


def _watch() -> None:
    """End this process with the studio, whose end closes our standard input."""
    while sys.stdin.read(1):
        pass
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        # Also ends all processes that the task has started.
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
