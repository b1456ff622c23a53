"""Work for the tests of the pool; in a module of its own, so that fresh processes can import it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from plushsense.core.errors import TrainingError


def square(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    report(("at", task))
    return {"value": task * task + shared, "process": os.getpid(), "threads": os.environ.get("OPENBLAS_NUM_THREADS")}


def refuse(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    if task == 2:
        raise TrainingError("no more")
    return {"value": task}


def stumble(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    raise ZeroDivisionError("in the work")


def die(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    if task == 2:
        os._exit(9)
    time.sleep(0.2)
    return {"value": task}


def tick(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    """Leave a mark for each start, take a while, and say so on the way."""
    with Path(shared, f"started-{task}").open("a") as file:
        file.write("x")
    for n in range(5):
        time.sleep(0.06)
        report(n)
    return {"value": task}
