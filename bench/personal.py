"""Measure personal adaptation under misuse: wrong labels, half of the gestures, people from the training set.

    plushsense adapt --evaluate DATASET --split by-subject:5     (once: trains the networks that this reads)
    python bench/personal.py DATASET [--choices 3] [--json]

The networks are those in DATASET/cache/adapting. New people are those on whom a network was neither trained nor
validated. Two recordings of each gesture adapt the network and the others test it; each line of the table states how
many more recordings are correct.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import numpy as np

from plushsense.core.errors import BadInput
from plushsense.dataset.index import as_dataset
from plushsense.live.adaptation import judge, personalise
from plushsense.models.bundle import Bundle
from plushsense.windows.cut import WindowSet, WindowSpec
from plushsense.workflow.preparation import windows_for

USE = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset")
    parser.add_argument("--choices", type=int, default=3, help="choices of recordings a person and case (3)")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    dataset = as_dataset(args.dataset)
    bundles = [Bundle.load(p) for p in sorted((Path(args.dataset) / "cache" / "adapting").glob("*.plush"))]
    if not bundles:
        raise SystemExit(f"no network in {args.dataset}/cache/adapting: run  plushsense adapt --evaluate first")
    dataset = dataset.with_inputs(bundles[0].layout)
    windows = windows_for(dataset, bundles[0].arch, WindowSpec(**bundles[0].windowing), bundles[0].gestures)
    draw, cases = np.random.default_rng(0), Cases()
    for bundle in bundles:
        met = {*bundle.provenance["subjects"], *bundle.provenance["validation_subjects"]}
        strangers = sorted(set(windows.subject.tolist()) - met)
        for person in strangers:
            mine = windows.take(np.flatnonzero(windows.subject == person))
            for chosen in choices(mine, args.choices, draw):
                cases.add("new people, all gestures recorded", bundle, mine, chosen)
                cases.add("strangers, labels shuffled", bundle, mine, chosen, shuffle=draw)
                for count in (9, 7, 5):
                    some = draw.permutation(len(mine.labels))[:count]
                    part = chosen & np.isin(mine.y, some)
                    cases.add(f"new people, {count} of 10 gestures recorded", bundle, mine, part, tested=~chosen)
        for person in bundle.provenance["subjects"][::6]:
            mine = windows.take(np.flatnonzero(windows.subject == person))
            for chosen in choices(mine, args.choices, draw):
                cases.add("people trained on", bundle, mine, chosen)
    print(json.dumps(cases.to_dict()) if args.json else cases)


def choices(mine: WindowSet, many: int, draw: np.random.Generator) -> list[np.ndarray]:
    """Yield masks (N,) of the windows of two recordings of each gesture, for some of the ten pairs."""
    by_class = [np.unique(mine.recording[mine.y == k]) for k in np.unique(mine.y)]
    pairs = list(itertools.combinations(range(max(map(len, by_class))), USE))
    found = []
    for at in draw.permutation(len(pairs))[:many]:
        chosen = [r[n] for r in by_class for n in pairs[at] if n < len(r)]
        found.append(np.isin(mine.recording, chosen))
    return found


class Cases:
    """Results of each case: whether the adaptation was accepted, and how many more recordings are correct."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[bool, int]]] = {}

    def add(
        self,
        name: str,
        bundle: Bundle,
        mine: WindowSet,
        chosen: np.ndarray,
        tested: np.ndarray | None = None,
        shuffle: np.random.Generator | None = None,
    ) -> None:
        own, test = mine.take(np.flatnonzero(chosen)), mine.take(np.flatnonzero(~chosen if tested is None else tested))
        y = own.y
        if shuffle is not None:
            _, first, place = np.unique(own.recording, return_index=True, return_inverse=True)
            y = shuffle.permutation(y[first])[place]
        try:
            done = personalise(bundle, own.integers, y, own.recording, subject="?")
        except BadInput:
            return
        before, after = (
            judge(b.network().probabilities(b.scaler.apply(test.integers)), test.y, test.recording).scores.right
            for b in (bundle, done.bundle)
        )
        self.rows.setdefault(name, []).append((done.accepted, after - before))

    def to_dict(self) -> dict[str, dict[str, float]]:
        """Return plain values by case."""
        return {
            name: {
                "cases": len(rows),
                "adapted": float(np.mean([accepted for accepted, _ in rows])),
                "more_right": float(np.mean([more for _, more in rows])),
                "worst": int(min(more for _, more in rows)),
                "worse_by_more_than_one": float(np.mean([more < -1 for _, more in rows])),
            }
            for name, rows in self.rows.items()
        }

    def __str__(self) -> str:
        head = f"{'case':<34}{'n':>5}{'adapted':>9}{'more correct':>14}{'worst':>7}{'< -1':>7}"
        lines = [
            f"{name:<34}{r['cases']:>5}{r['adapted']:>9.0%}{r['more_right']:>14.1f}{r['worst']:>7}"
            f"{r['worse_by_more_than_one']:>7.1%}"
            for name, r in self.to_dict().items()
        ]
        return "\n".join([head, *lines])


if __name__ == "__main__":
    main()
