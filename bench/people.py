"""Measure what helps on people a network never met: one row for each idea, also for those that failed.

    python bench/people.py ../shared/data/makeability-gestures OUT [--rows kept,raw] [--seeds 0,1,2] [--json]

The settings are chosen on the people P01 to P14 alone: by-subject:5, the shared gestures, windows with their real past;
the other people are not read. Each seed trains five networks. OUT holds the data set of these people and the finished
folds, so that a stopped run can be continued. A row of three seeds takes about three minutes on two cores, all of them
about an hour.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import torch
from torch import Tensor

import plushsense as ps
from plushsense.core import layouts
from plushsense.dataset.store import HEAD, Dataset
from plushsense.evaluation.crossval import EpochProgress, FoldOutput, evaluate
from plushsense.jobs.journal import Journal
from plushsense.models import net
from plushsense.windows.cut import WindowSet
from plushsense.workflow.api import TrainAndPredict
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import classes_for, network_inputs_of, windows_for

PEOPLE = tuple(f"P{n:02}" for n in range(1, 15))
SPLIT = "by-subject:5"
BEFORE = {"arch": "14d1_19d2_19d4", "filters": "8,12,16"}


class ByDivision(net.VectorNet):
    """A vector layer whose sense of rotation is u · (h × h') / √(n n')."""

    def sense(self, turn: Tensor, length: Tensor) -> Tensor:
        return turn * (length * length.roll(-1, 1)).rsqrt()


class WithoutSense(net.VectorNet):
    """A vector layer that cannot tell the sense of a rotation."""

    def sense(self, turn: Tensor, length: Tensor) -> Tensor:
        return torch.zeros_like(turn)


LAYERS: dict[str, type[net.VectorNet]] = {"": net.VectorNet, "division": ByDivision, "no sense": WithoutSense}


@dataclass(frozen=True)
class Row:
    """An idea: settings as for `plushsense.evaluate`, a time constant of gravity, and a vector layer of `LAYERS`."""

    title: str
    settings: dict[str, Any] = field(default_factory=dict)
    gravity_s: float = layouts.GRAVITY_S
    layer: str = ""


GAIN, TILT, SPEED = "random-gain:0.3", "random-tilt:8", "random-speed:0.2"


def beside(title: str, gravity_s: float = layouts.GRAVITY_S, layer: str = "", **settings: Any) -> Row:
    """Return a row to compare with the row "speed", whose augmentations it has."""
    return Row(f"  {title}", {"augment": [GAIN, TILT, SPEED], **settings}, gravity_s, layer)


ROWS: dict[str, Row] = {
    "kept": Row("kept: v14_17d2_19d4 6/16/16, gain and tilt"),
    "raw": Row("raw axes turned at random by 45°, 14d1_19d2_19d4 8/12/16 (before)", BEFORE),
    "raw-plain": Row("raw axes, not augmented", {**BEFORE, "augment": []}),
    "not-augmented": Row("without augmentation", {"augment": []}),
    "tilt-speed": Row("speed in place of gain", {"augment": [TILT, SPEED]}),
    "gain-speed": Row("speed in place of tilt", {"augment": [GAIN, SPEED]}),
    "speed": Row("with speed as well; compared with it:", {"augment": [GAIN, TILT, SPEED]}),
    "no-sense": beside("without the sense of rotation", layer="no sense"),
    "division": beside("sense of rotation divided by the lengths, not a root", layer="division"),
    "gravity-0.32": beside("gravity over 0.32 s", gravity_s=0.32),
    "gravity-1.28": beside("gravity over 1.28 s", gravity_s=1.28),
    "gravity-2.56": beside("gravity over 2.56 s", gravity_s=2.56),
    "first-19": beside("first convolution with 19 taps", arch="v14_19d2_19d4"),
    "both-17": beside("both convolutions with 17 taps", arch="v14_17d2_17d4"),
    "kernels-5": beside("5 kernels", filters="5,16,16"),
    "kernels-8": beside("8 kernels, 12 and 16 filters", filters="8,12,16"),
    "taps-10": beside("kernels of 10 taps", arch="v10_17d2_19d4"),
    "taps-20": beside("kernels of 20 taps", arch="v20_17d2_19d4"),
    "gain-0.6": beside("gain up to 60 %", augment=["random-gain:0.6", TILT, SPEED]),
    "rate-0.005": beside("learning rate 0.005", learning_rate=0.005),
    "epochs-100": beside("100 epochs, halved every 25", epochs=100, halve_every=25),
}


@dataclass(frozen=True)
class WithLayer:
    """The work of a fold with another vector layer."""

    work: TrainAndPredict
    layer: str

    def __call__(
        self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: EpochProgress, /
    ) -> FoldOutput:
        own = net.VectorNet
        try:
            net.VectorNet = LAYERS[self.layer]  # type: ignore[misc]
            return self.work(train, validation, test, progress)
        finally:
            net.VectorNet = own  # type: ignore[misc]


@contextmanager
def gravity_over(seconds: float) -> Iterator[None]:
    """Change the time constant of gravity."""
    before = layouts.GRAVITY_S
    layouts.GRAVITY_S = seconds
    try:
        yield
    finally:
        layouts.GRAVITY_S = before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="folder of makeability-gestures")
    parser.add_argument("out", type=Path, help="folder for the data set and the finished folds")
    parser.add_argument("--rows", default=",".join(ROWS), help="rows to measure (all)")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--epochs", type=int, help="fewer epochs, to try the program")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    names = args.rows.split(",")
    if unknown := [name for name in names if name not in ROWS]:
        raise SystemExit(f"unknown rows: {', '.join(unknown)}; there are {', '.join(ROWS)}")
    began, dataset = time.monotonic(), chosen_people(args.source, args.out)
    table = {}
    for name in names:
        table[name] = measured(ROWS[name], dataset, [int(s) for s in args.seeds.split(",")], args)
        if not args.json:
            print(line(ROWS[name], table[name]), flush=True)
    if args.json:
        print(json.dumps({"people": PEOPLE, "split": SPLIT, "rows": table}))
    else:
        print(f"{len(table)} rows in {(time.monotonic() - began) / 60:.0f} min, folds of earlier runs not counted")


def chosen_people(source: Path, out: Path) -> Dataset:
    """Import the recordings of `PEOPLE` alone, once."""
    folder = out / "dataset"
    if not (folder / HEAD).is_file():
        with tempfile.TemporaryDirectory() as place:
            for person in PEOPLE:
                shutil.copytree(source / person, Path(place) / person)
            ps.import_recordings(place, folder, layout="accel-3")
    return ps.open_dataset(folder)


def measured(row: Row, dataset: Dataset, seeds: list[int], args: argparse.Namespace) -> dict[str, Any]:
    """Return mean and spread over the seeds, of the means over the people."""
    with gravity_over(row.gravity_s):
        runs = [evaluated(row, dataset, seed, args) for seed in seeds]
    scores: dict[str, Any] = {"parameters": runs[0][1], "seeds": seeds}
    for key in ("accuracy", "macro_f1"):
        means = [table[key]["mean"] for table, _ in runs]
        scores[key] = {"mean": fmean(means), "sd": stdev(means) if len(means) > 1 else None, "runs": means}
    by_recording = [table["by_recording"]["accuracy"] for table, _ in runs]
    return scores | {"by_recording": fmean(by_recording)}


def evaluated(row: Row, dataset: Dataset, seed: int, args: argparse.Namespace) -> tuple[dict[str, Any], int]:
    settings = {**row.settings, "seed": seed}
    if args.epochs:
        settings["epochs"] = args.epochs
    config: RunConfig
    read, config = network_inputs_of(dataset, from_settings(**settings))
    config = replace(config, evaluation=replace(config.evaluation, seed=0))
    gestures = classes_for(read, config.evaluation.classes, config.windows.context)
    arch = config.model.build(read.layout, len(gestures), config.windows.window_s, config.padding)
    windows = windows_for(read, arch, config.windows, gestures)
    done = evaluate(
        windows,
        windows,
        SPLIT,
        WithLayer(TrainAndPredict(arch, config.training), row.layer),
        journal=Journal(args.out / "folds"),
        key={"arch": arch.to_dict(), "training": config.training.key(), "layer": row.layer},
        workers=args.workers,
        validation=False,
    )
    return done.table, arch.parameters


def line(row: Row, scores: dict[str, Any]) -> str:
    spread = scores["accuracy"]["sd"]
    return (
        f"{row.title:80} {scores['parameters']:7,}  {scores['accuracy']['mean']:.3f} "
        f"± {'–' if spread is None else format(spread, '.3f')}  {scores['macro_f1']['mean']:.3f}  "
        f"{scores['by_recording']:.3f}"
    )


if __name__ == "__main__":
    main()
