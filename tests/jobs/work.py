"""Work for the tests of the pool; in a module of its own, so that fresh processes can import it."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import TrainingError


def square(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    report(("at", task))
    return {"value": task * task + shared, "process": os.getpid(), "threads": os.environ.get("OPENBLAS_NUM_THREADS")}


def number(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    report((1, 1))
    return {"value": task + shared}


def wait_for(file: Path) -> None:
    until = time.monotonic() + 30
    while not file.exists() and time.monotonic() < until:
        time.sleep(0.01)


def refuse(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    """Fail at 2, but not before job 0 is kept in the folder ``shared``: which worker is faster is chance."""
    if task == 2:
        wait_for(Path(shared, "job0.npz"))
        raise TrainingError("no more")
    return {"value": task}


def stumble(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    raise ZeroDivisionError("in the work")


def die(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    if task == 2:
        wait_for(Path(shared, "job0.npz"))
        os._exit(9)
    return {"value": task}


def tick(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    """Leave a mark for each start, take a while, and say so on the way."""
    with Path(shared, f"started-{task}").open("a") as file:
        file.write("x")
    for n in range(5):
        time.sleep(0.06)
        report(n)
    return {"value": task}


def walk(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    """Ten epochs that depend on each other, with a mark for each start; says the epoch and the node it is on.

    On the node that is to be lost it never comes to an end.
    """
    node = ""
    if "ray" in sys.modules:
        import ray

        if ray.is_initialized():
            node = ray.get_runtime_context().get_node_id()
    with Path(shared["folder"], f"started-{task}").open("a") as file:
        file.write("x")
    rng = np.random.default_rng(task)
    sums = []
    for epoch in range(10):
        time.sleep(0.05)
        shared["data"][:] += 0.0
        sums.append(float(shared["data"] @ rng.normal(size=len(shared["data"]))) + (sums[-1] if sums else 0.0))
        report((epoch, node))
        if epoch == 5 and node and node == shared["doomed"]:
            time.sleep(120)
    return {"sums": np.array(sums), "task": task}


def diverge(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    if task == 2:
        raise TrainingError("no more")
    return {"value": task, "threads": os.environ.get("OPENBLAS_NUM_THREADS")}


def killed_once(shared: Any, task: Any, report: Any) -> dict[str, Any]:
    """Job 1 is killed from outside at its first try; job 3 kills its process at every try."""
    mark = Path(shared, f"started-{task}")
    first = not mark.exists()
    with mark.open("a") as file:
        file.write("x")
    if task == 1 and first:
        report(os.getpid())
        time.sleep(60)
    if task == 3:
        os._exit(9)
    return {"value": task}
