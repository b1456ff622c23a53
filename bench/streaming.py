"""Measure the cost of a live decision: a network that keeps its state against one that recomputes its window.

Both run in the NumPy reference on one thread, in turn, on the same samples. Times are of the processor, and ratios are
taken within a round, so that other programs and slow changes of the machine's speed have little effect.

    python bench/streaming.py [--rounds 15] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time

# Before NumPy: threads of BLAS that wait for each other would take time, too.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from plushsense.models.arch import Arch
from plushsense.models.reference import Network, random_weights

DECISIONS = 200
NETWORKS = {
    "default, stream": ("14d1_19d2_19d4", "stream"),
    "paper's, stream": ("14d1_39d2_41d4", "stream"),
    "paper's, mirror": ("14d1_39d2_41d4", "mirror"),
}
AGAINST = "paper's, mirror"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    samples = np.random.default_rng(0).normal(size=(600 + 5 * DECISIONS, 11))
    archs = {name: Arch.parse(spec, (8, 12, 16), padding=padding) for name, (spec, padding) in NETWORKS.items()}
    steppers = {name: Network(arch, random_weights(arch, 1)).stepper() for name, arch in archs.items()}
    times: dict[str, list[float]] = {name: [] for name in archs}
    for _ in range(args.rounds + 1):
        for name, stepper in steppers.items():
            stepper.reset()
            stepper.push(samples[:600])
            began = time.process_time()
            for at in range(600, len(samples), 5):
                stepper.push(samples[at : at + 5])
            times[name].append((time.process_time() - began) / DECISIONS)
    rows = []
    for name, arch in archs.items():
        mine, other = times[name][1:], times[AGAINST][1:]
        ratios = sorted(o / m for o, m in zip(other, mine, strict=True))
        rows.append(
            {
                "network": name,
                "macs_per_step": arch.macs_per_step,
                "macs_ratio": round(archs[AGAINST].macs_per_step / arch.macs_per_step, 1),
                "us_a_decision": round(1e6 * statistics.median(mine), 1),
                "times_faster": [round(r, 2) for r in (ratios[0], statistics.median(ratios), ratios[-1])],
            }
        )
    print(json.dumps(rows, indent=None if args.json else 1))


if __name__ == "__main__":
    main()
