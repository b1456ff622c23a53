"""The ranking of systems: another model in the place of the network changes the logits and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import stream_ranking as bench

import plushsense as ps
from plushsense.experiments.streams.replay import count_events, read_streams
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import argmax_spec
from plushsense.runtime.machine import FloatLogits
from support.bundles import odd_bundle


def test_a_model_in_the_place_of_the_network(four_people: Path, tmp_path: Path) -> None:
    dataset = ps.open_dataset(four_people)
    bundle = Bundle.load(odd_bundle(tmp_path / "odd.plush", "accel-3", dataset.gestures))
    streams = read_streams(dataset, bundle, ["P01"])

    def read(samples: bench.Values) -> bench.Values:
        network = FloatLogits(bundle)
        network.reset()
        return network.push(samples) / 256

    same = bench.Reader(read, bundle.arch.span, bundle.arch.step, "")
    wanted, found = (count_events(s, argmax_spec(0.3)) for s in (streams, bench.read_with(streams, same, [0, 1, 2])))
    assert wanted.truths > 0 and wanted.insertions > 0 and found == wanted

    slow = bench.by_windows(lambda x: np.zeros((len(x), len(dataset.gestures))), "")
    for stream in bench.read_with(streams, slow, [0, 1, 2]):
        for part in stream.replayer.trace.parts:
            assert len(part.logits) == max(0, (len(part.inputs) - bench.WINDOW) // bench.EVERY + 1)


def test_a_line_of_the_table() -> None:
    counts = {"hits": 1, "truths": 2, "matched": 1, "insertions": 1, "hours": 0.5, "latencies": [1.0]}
    rules = {rule: {"curve": [counts] * len(bench.TARGETS), "people": {"P1": counts}} for rule in bench.RULES}
    fold = {"size": "10 nodes", "macs": None, "rules": rules}
    f1, text = bench.line("a forest", "argmax", [fold], [fold])
    assert f1 == 0.5
    assert text == "| a forest | plain argmax | – / 2 / – | 0.50 |  | 0.50 | 2 | 1.00 s | 10 nodes | – |"
