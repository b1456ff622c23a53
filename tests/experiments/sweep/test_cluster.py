"""A sweep of real recordings on a cluster whose second node is killed on the way: complete, and as on this machine."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from plushsense.jobs.journal import JOURNAL
from plushsense.jobs.progress import JobProgress
from support.sweeping import sweep

pytestmark = pytest.mark.apart("cluster")

GRID: dict[str, Any] = {
    "architectures": ("20d2_16d4_20d8", "19d1_24d3_19d9", "126d2", "1d1_27d3_20d9"),
    "filters": ((2, 2, 2, 2),),
    "epochs": (1, 3),
    "batches": (128,),
}


class Killer:
    """Kills the second node when a second training reports: each node runs one by then."""

    def __init__(self, cluster: Any) -> None:
        self.cluster, self.node = cluster, next(iter(cluster.worker_nodes))
        self.thread: threading.Thread | None = None
        self.reported: set[str] = set()

    def __call__(self, progress: JobProgress) -> None:
        self.reported.add(progress.name)
        if len(self.reported) > 1 and self.thread is None:
            self.thread = threading.Thread(target=self.cluster.remove_node, args=(self.node, False))
            self.thread.start()


@pytest.mark.exhaustive
def test_a_node_lost_in_a_sweep_changes_nothing(two_nodes: Any, four_people: Path, tmp_path: Path) -> None:
    import polars
    from polars.testing import assert_frame_equal

    for name in ("DS", "whole"):
        shutil.copytree(four_people, tmp_path / name)
    killer = Killer(two_nodes)
    found = sweep(tmp_path / "DS", out=tmp_path / "out", cluster=two_nodes.address, progress=killer, **GRID)
    assert killer.thread is not None, "a node was to be killed in the middle"
    killer.thread.join(60)
    assert found.head["done"] == found.head["trials"] == 8 and not found.head["failed"]
    assert len(list((tmp_path / "DS" / "cache" / JOURNAL).glob("*.npz"))) == 4
    here = sweep(tmp_path / "whole", out=tmp_path / "other", workers=1, **GRID)
    assert_frame_equal(found.trials.drop("seconds"), here.trials.drop("seconds"), check_exact=True)
    curves = [polars.read_parquet(tmp_path / place / "curves.parquet") for place in ("out", "other")]
    assert_frame_equal(*curves, check_exact=True)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere.invalid:6379"])
@pytest.mark.exhaustive_for("127.0.0.1:1", "nowhere.invalid:6379")
def test_a_cluster_that_is_not_there(address: str, cluster_possible: None, four_people: Path, tmp_path: Path) -> None:
    from plushsense.core.errors import PlushSenseError

    shutil.copytree(four_people, tmp_path / "DS")
    with pytest.raises(PlushSenseError, match=address.split(":")[0]):
        sweep(tmp_path / "DS", out=tmp_path / "out", cluster=address, **GRID)
