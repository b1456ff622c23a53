"""Jobs on a cluster: the same results as here, through lost nodes, and in sentences where it cannot be."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
import types
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import work

from plushsense.core.errors import ConfigError, PlushSenseError, TrainingError
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import Job, JobCallbacks, JobsSpec, run_jobs

pytestmark = [pytest.mark.apart("ray"), pytest.mark.slow]

SMALL = 80 * 2**20


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(
        np.array_equal(one[job]["sums"], other[job]["sums"]) and one[job]["task"] == other[job]["task"] for job in one
    )


def test_a_lost_node_changes_nothing(two_nodes: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    jobs = [Job(f"job{n}", n) for n in range(8)]
    nodes = list(two_nodes.worker_nodes)
    shared = {"data": np.arange(1000.0), "folder": str(tmp_path), "doomed": nodes[0].node_id}
    undisturbed = run_jobs(jobs, work.walk, shared=shared)
    for mark in tmp_path.glob("started-*"):
        mark.unlink()

    journal = Journal(tmp_path / "journal")
    # Begun on this machine, gone on with on the cluster.
    journal.save("job3", undisturbed["job3"])
    saved: Counter[str] = Counter()
    resumed: list[str] = []
    said: list[Any] = []
    removed: list[threading.Thread] = []

    def on_report(job: Job, message: Any) -> None:
        said.append((job.id, message))
        if not removed and message[1] == nodes[0].node_id:
            # While a job is at work on that node; killed, not asked to go.
            removed.append(threading.Thread(target=two_nodes.remove_node, args=(nodes[0], False)))
            removed[0].start()

    def on_done(job: Job, result: Any, before: bool) -> None:
        saved[job.id] += 1
        if before:
            resumed.append(job.id)

    got = run_jobs(
        jobs,
        work.walk,
        shared=shared,
        spec=JobsSpec(journal=journal, cluster=two_nodes.address),
        callbacks=JobCallbacks(on_report=on_report, on_done=on_done),
    )
    assert removed, "no job ever said that it is at work on the second node"
    removed[0].join()
    # What Ray has to say of the node is not for standard output.
    assert capfd.readouterr().out == ""
    assert same(got, undisturbed)
    assert resumed == ["job3"] and saved == Counter({job.id: 1 for job in jobs})
    assert same({job.id: journal.load(job.id) for job in jobs}, undisturbed)
    # Some job was begun again, since its node was lost; and epochs were told on the way.
    starts = {n: len((tmp_path / f"started-{n}").read_text()) for n in range(8) if n != 3}
    assert sum(starts.values()) > 7
    assert all(0 <= message[0] < 10 for _, message in said)
    # The same again costs nothing: everything is there.
    again = run_jobs(jobs, work.walk, shared=shared, spec=JobsSpec(journal=journal, cluster="nowhere:1"))
    assert same(again, undisturbed)
    two_nodes.add_node(num_cpus=1, object_store_memory=SMALL)


@pytest.mark.exhaustive
def test_what_a_job_raises_comes_through(two_nodes: Any, tmp_path: Path) -> None:
    jobs = [Job(f"job{n}", n) for n in range(4)]
    journal = Journal(tmp_path)
    failed: list[tuple[str, str]] = []
    got = run_jobs(
        jobs,
        work.diverge,
        shared=100,
        spec=JobsSpec(journal=journal, cluster=two_nodes.address),
        callbacks=JobCallbacks(
            on_failed=lambda job, error: failed.append((job.id, f"{type(error).__name__}: {error}"))
        ),
    )
    assert sorted(got) == ["job0", "job1", "job3"] and failed == [("job2", "TrainingError: no more")]
    assert all(result["threads"] == "1" for result in got.values())
    assert not journal.has("job2") and journal.has("job3")
    with pytest.raises(TrainingError, match="^no more$"):
        run_jobs(jobs, work.diverge, shared=100, spec=JobsSpec(journal=journal, cluster=two_nodes.address))
    with pytest.raises(ConfigError, match="No node of the cluster has 3 processors"):
        run_jobs(jobs, work.diverge, shared=100, spec=JobsSpec(threads=3, journal=journal, cluster=two_nodes.address))
    # A package that only this process has.
    only_here = types.ModuleType("only_here")
    exec("def square(shared, task, report): return {'value': task}", only_here.__dict__)
    only_here.square.__module__ = "only_here"
    sys.modules["only_here"] = only_here
    try:
        with pytest.raises(PlushSenseError, match="lacks the package 'only_here'"):
            run_jobs(jobs, only_here.square, spec=JobsSpec(cluster=two_nodes.address))
    finally:
        del sys.modules["only_here"]


def test_an_address_where_no_cluster_is(cluster_possible: None) -> None:
    began = time.monotonic()
    jobs = [Job("a", 1)]
    for address in ("nonsense", "host:99999", "ray://", "http://x:1"):
        with pytest.raises(ConfigError, match="is not the address of a cluster: accepted are"):
            run_jobs(jobs, work.square, shared=0, spec=JobsSpec(cluster=address))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        # Takes the connection and says nothing.
        with pytest.raises(ConfigError, match=rf"127.0.0.1:{port}' \(no answer\)"):
            run_jobs(jobs, work.square, shared=0, spec=JobsSpec(cluster=f"127.0.0.1:{port}"))
    with pytest.raises(ConfigError, match=r"refused.*ray start --head"):
        run_jobs(jobs, work.square, shared=0, spec=JobsSpec(cluster=f"ray://127.0.0.1:{port}"))
    assert time.monotonic() - began < 30
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
