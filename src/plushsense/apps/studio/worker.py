"""The process in which the studio's long work runs: a task as one line of JSON in, JSON lines out.

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
    "check": "plushsense.apps.studio.tasks.check",
    "train": "plushsense.apps.studio.tasks.train",
    "sweep": "plushsense.apps.studio.tasks.sweep",
    "search": "plushsense.apps.studio.tasks.search",
    "evaluate": "plushsense.apps.studio.tasks.evaluate",
    "import": "plushsense.apps.studio.tasks.importing",
    "publish": "plushsense.apps.studio.tasks.publish",
    "export": "plushsense.apps.studio.tasks.export",
    "verify": "plushsense.apps.studio.tasks.verify",
    "simulate": "plushsense.apps.studio.tasks.simulating",
    "profile": "plushsense.apps.studio.tasks.profile",
    "validate": "plushsense.apps.studio.tasks.validate",
    "pseudonymise": "plushsense.apps.studio.tasks.pseudonymise",
}
"""Task to the module with its ``run(spec, tell) -> result``, plain values all; ``tell`` is a `Tell`."""


class Tell:
    """How a task reports; from any thread."""

    def __init__(self, out: Any) -> None:
        self._out, self._lock = out, threading.Lock()

    def __call__(self, **message: Any) -> None:
        """One line of JSON; not for tasks."""
        with self._lock:
            self._out.write(json.dumps(message, ensure_ascii=True, default=str) + "\n")
            self._out.flush()

    def progress(self, **values: Any) -> None:
        """Where the work stands, plain values."""
        self(progress=values)

    def warn(self, sentence: str) -> None:
        """Something that people should know."""
        self(warning=sentence)


Task = Callable[[dict[str, Any], Tell], dict[str, Any]]


def main() -> int:
    """Do one task; 0 done, 1 stopped, 2 refused."""
    # Whatever a library prints must not stand between the messages.
    out, sys.stdout = sys.stdout, sys.stderr
    tell = Tell(out)
    line = sys.stdin.readline()
    threading.Thread(target=_watch, daemon=True).start()
    try:
        asked = json.loads(line)
        task: Task = importlib.import_module(TASKS[asked["task"]]).run
        tell(result=task(asked["spec"], tell))
    except KeyboardInterrupt:
        return 1
    except PlushSenseError as refusal:
        tell(refused=str(refusal))
        return 2
    except OSError as cause:
        tell(
            refused=f"The system refused: {cause.strerror or cause}{f' ({cause.filename})' if cause.filename else ''}."
        )
        return 2
    except Exception as cause:  # noqa: BLE001 (whoever waits for it must hear of it)
        tell(refused=f"The work broke off ({type(cause).__name__}: {cause}): what was finished is kept.")
        return 2
    return 0


def _watch() -> None:
    """End with the studio: its end closes our standard input."""
    while sys.stdin.read(1):
        pass
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        # With all processes that the task has begun.
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
