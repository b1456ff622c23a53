"""Measure the default network and the self-calibration on people a network never met, beside what was before.

    python bench/people.py ../shared/data/makeability-gestures OUT [--rows kept,raw] [--seeds 0,1,2] [--json]

The settings are chosen on the people P01 to P14 alone: by-subject:5, the shared gestures, windows with their real past;
the other people are not read, except with --everybody, for the rows of the self-calibration. Each seed trains five
networks. OUT holds the data set of these people and the finished folds, so that a stopped run can be continued. A row
of three seeds takes about three minutes on two cores. To measure on many cores, import the recordings once and run one
process for each row and seed, each with a folder OUT of its own (examples of rows and seeds):

    plushsense import ../shared/data/makeability-gestures DS --layout accel-3
    echo "kept 0 kept 1 raw 0 raw 1" | xargs -n 2 -P 4 sh -c 'python bench/people.py DS "OUT/$0-$1" \
        --everybody --rows "$0" --seeds "$1" --workers 1 --json > "$0-$1.json"'
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np

import plushsense as ps
from plushsense.core import layouts
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import HEAD, Dataset, RecordingInfo
from plushsense.evaluation.crossval import FoldOutput, evaluate
from plushsense.evaluation.scores import Scores
from plushsense.jobs.journal import Journal
from plushsense.models.arch import Arch
from plushsense.scoring.splits import parse_split
from plushsense.training.fit import fit, predict
from plushsense.training.spec import EpochProgress, TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.workflow.config import from_settings
from plushsense.workflow.preparation import prepare

PEOPLE = tuple(f"P{n:02}" for n in range(1, 15))
SPLIT = "by-subject:5"
BEFORE = {"arch": "14d1_19d2_19d4", "filters": "8,12,16"}


@dataclass(frozen=True)
class Row:
    """A row of the table: settings as for `plushsense.evaluate`.

    ``calibrated``: whether the accelerometer calibrates itself; ``regained``: whether each person's readings have
    another gain and offset (`Regained`).
    """

    title: str
    settings: dict[str, Any] = field(default_factory=dict)
    calibrated: bool = False
    regained: bool = False


ROWS: dict[str, Row] = {
    "kept": Row("kept: v14_17d2_19d4 6/16/16, gain and tilt"),
    "raw": Row("raw axes turned at random by 45°, 14d1_19d2_19d4 8/12/16 (before)", BEFORE),
    "raw-plain": Row("raw axes, not augmented", {**BEFORE, "augment": []}),
    "not-augmented": Row("without augmentation", {"augment": []}),
    "calibrated": Row("self-calibration", calibrated=True),
    "regained": Row("  each person's readings with another gain and offset", calibrated=True, regained=True),
    "uncalibrated": Row("  the same without self-calibration", regained=True),
}


class Regained(Dataset):
    """A data set whose readings have a gain and an offset of each person's own.

    Each sensor has a gain of 0.2 to 5, log-uniform, and each axis an offset of up to ±40 000 steps (5 g of accel-3).
    """

    _WIDE = 1 << 18

    @classmethod
    def of(cls, dataset: Dataset) -> Regained:
        """Return the data set with other readings, and a layout that takes them for valid."""
        layout = dataset.layout
        wide = cls._WIDE
        channels = tuple(replace(c, valid_min=-wide * c.step, valid_max=wide * c.step) for c in layout.channels)
        head = replace(dataset.head, layout=replace(layout, channels=channels))
        return cls(dataset.path, head, dataset.recordings, dataset.streams)

    def read(self, recording: RecordingInfo) -> Frames:
        return self._changed(super().read(recording), recording.subject)

    def read_stream(self, stream: str) -> Frames:
        return self._changed(super().read_stream(stream), next(s.subject for s in self.streams if s.id == stream))

    def _changed(self, frames: Frames, person: str) -> Frames:
        rng, values = np.random.default_rng(list(person.encode())), frames.values.copy()
        for vector in self.layout.vectors:
            axes = [self.layout.index(axis) for axis in vector]
            gain, offset = 5.0 ** rng.uniform(-1.0, 1.0), np.rint(rng.uniform(-40_000, 40_000, len(axes)))
            values[:, axes] = np.rint(values[:, axes] * gain + offset)
        return replace(frames, values=values)

    def with_inputs(self, layout: layouts.Layout) -> Dataset:
        return Regained(self.path, replace(self.head, layout=layout), self.recordings, self.streams)


@dataclass(frozen=True)
class FoldWork:
    """Train one network as PlushSense does, and return the probabilities of the test windows."""

    arch: Arch
    spec: TrainSpec

    def __call__(self, train: WindowSet, _: WindowSet, test: WindowSet, progress: EpochProgress, /) -> FoldOutput:
        fitted = fit(train, None, self.arch, self.spec)
        return FoldOutput(predict(self.arch, fitted.weights, fitted.scaler, test).astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="folder of makeability-gestures, or with --everybody its data set")
    parser.add_argument("out", type=Path, help="folder for the data set and the finished folds")
    parser.add_argument("--rows", default=",".join(ROWS), help="rows to measure (all)")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--everybody", action="store_true", help="all people, also those kept for the final score")
    parser.add_argument("--axes", help="which calibrate themselves in such rows (all), as x_gyro,y_gyro,z_gyro")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--epochs", type=int, help="fewer epochs, to try the program")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    names = args.rows.split(",")
    if unknown := [name for name in names if name not in ROWS]:
        raise SystemExit(f"unknown rows: {', '.join(unknown)}; there are {', '.join(ROWS)}")
    began, dataset = time.monotonic(), chosen_people(args.source, args.out, args.everybody)
    table = {}
    for name in names:
        table[name] = measured(ROWS[name], dataset, [int(s) for s in args.seeds.split(",")], args)
        if not args.json:
            print(line(ROWS[name], table[name]), flush=True)
    if args.json:
        print(json.dumps({"people": None if args.everybody else PEOPLE, "split": SPLIT, "rows": table}))
    else:
        print(f"{len(table)} rows in {(time.monotonic() - began) / 60:.0f} min, folds of earlier runs not counted")


def chosen_people(source: Path, out: Path, everybody: bool = False) -> Dataset:
    """Import the recordings of `PEOPLE` alone, or of all people, once; a data set of all people is opened."""
    if everybody and (source / HEAD).is_file():
        return ps.open_dataset(source)
    folder = out / ("everybody" if everybody else "dataset")
    if everybody and not (folder / HEAD).is_file():
        ps.import_recordings(source, folder, layout="accel-3")
    if not (folder / HEAD).is_file():
        with tempfile.TemporaryDirectory() as place:
            for person in PEOPLE:
                shutil.copytree(source / person, Path(place) / person)
            ps.import_recordings(place, folder, layout="accel-3")
    return ps.open_dataset(folder)


def measured(row: Row, dataset: Dataset, seeds: list[int], args: argparse.Namespace) -> dict[str, Any]:
    """Return mean and spread over the seeds, of the means over the people, and the accuracies of each person."""
    runs = [evaluated(row, dataset, seed, args) for seed in seeds]
    scores: dict[str, Any] = {"parameters": runs[0][1], "seeds": seeds}
    for key in ("accuracy", "macro_f1"):
        means = [found.mean(key) for found, _ in runs]
        scores[key] = {"mean": fmean(means), "sd": stdev(means) if len(means) > 1 else None, "runs": means}
    by_recording = [found.by_recording.metrics["accuracy"] for found, _ in runs]
    people: dict[str, list[float]] = {one.subject: [] for one in runs[0][0].subjects}
    for found, _ in runs:
        for one in found.subjects:
            people[one.subject].append(one.metrics["accuracy"])
    return scores | {"by_recording": fmean(by_recording), "people": people}


def evaluated(row: Row, dataset: Dataset, seed: int, args: argparse.Namespace) -> tuple[Scores, int]:
    settings = {**row.settings, "seed": seed} | ({"epochs": args.epochs} if args.epochs else {})
    if row.regained:
        dataset = Regained.of(dataset)
    if row.calibrated:
        axes = args.axes.split(",") if args.axes else [axis for vector in dataset.layout.vectors for axis in vector]
        dataset = dataset.with_inputs(replace(dataset.layout, self_calibration=tuple(axes)))
    run = prepare(dataset, from_settings(**settings))
    arch = run.network
    windows = run.training_windows()
    done = evaluate(
        windows,
        windows,
        parse_split(SPLIT),
        FoldWork(arch, run.training),
        journal=Journal(args.out / "folds"),
        key={"arch": arch.to_dict(), "training": run.training.key(), "layer": ""},
        workers=args.workers,
        validation=False,
    )
    return done.scores, arch.parameters


def line(row: Row, scores: dict[str, Any]) -> str:
    spread = scores["accuracy"]["sd"]
    return (
        f"{row.title:80} {scores['parameters']:7,}  {scores['accuracy']['mean']:.3f} "
        f"± {'–' if spread is None else format(spread, '.3f')}  {scores['macro_f1']['mean']:.3f}  "
        f"{scores['by_recording']:.3f}"
    )


if __name__ == "__main__":
    main()
