"""Measure what helps on people a network never met: one row for each idea, also for those that failed.

    python bench/people.py ../shared/data/makeability-gestures OUT [--rows kept,raw] [--seeds 0,1,2] [--json]

The settings are chosen on the people P01 to P14 alone: by-subject:5, the shared gestures, windows with their real past;
the other people are not read, except with --everybody, for the rows of the self-calibration. Each seed trains five
networks. OUT holds the data set of these people and the finished folds, so that a stopped run can be continued, and
networks that several rows share. A row of three seeds takes about three minutes on two cores, all of them about two
hours. The row "ceiling" needs the extra "rocket". To measure on many cores, import the recordings once and run one
process for each row and seed, each with a folder OUT of its own (examples of rows and seeds):

    plushsense import ../shared/data/makeability-gestures DS --layout accel-3
    echo "kept 0 kept 1 both-states 0 both-states 1" | xargs -n 2 -P 4 sh -c 'python bench/people.py DS "OUT/$0-$1" \
        --everybody --rows "$0" --seeds "$1" --workers 1 --json > "$0-$1.json"'
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor
from torch.nn import functional as F

import plushsense as ps
from plushsense.core import layouts
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import HEAD, Dataset, RecordingInfo
from plushsense.evaluation.crossval import EpochProgress, FoldOutput, evaluate, windows_fingerprint
from plushsense.experiments.baselines.models import RocketFit, likelihoods
from plushsense.jobs.journal import Journal, job_id
from plushsense.models import net
from plushsense.models.arch import NORM_EPSILON, Arch, VectorLayer
from plushsense.models.reference import Network
from plushsense.training.augment import Channels, augmentations
from plushsense.training.engine import Adam, slices, torch_threads
from plushsense.training.fit import fit, predict
from plushsense.training.spec import TrainSpec
from plushsense.windows import cut
from plushsense.windows.calibration import SelfCalibration
from plushsense.windows.clock import Segment
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import Scaler
from plushsense.windows.sessions import SessionReader
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import classes_for, network_inputs_of, windows_for

Weights = dict[str, NDArray[np.float32]]
Floats = NDArray[np.floating[Any]]

PEOPLE = tuple(f"P{n:02}" for n in range(1, 15))
SPLIT = "by-subject:5"
TEACHERS = range(10)  # seeds of the networks of the ensemble
BEFORE = {"arch": "14d1_19d2_19d4", "filters": "8,12,16"}


class ByDivision(net.VectorNet):
    """A vector layer whose sense of rotation is u · (h × h') / √(n n')."""

    def sense(self, turn: Tensor, length: Tensor) -> Tensor:
        return turn * (length * length.roll(-1, 1)).rsqrt()


class WithoutSense(net.VectorNet):
    """A vector layer that cannot tell the sense of a rotation."""

    def sense(self, turn: Tensor, length: Tensor) -> Tensor:
        return torch.zeros_like(turn)


class WithFixedKernels(net.VectorNet):
    """A vector layer with three kernels that are not trained: two edge filters, of 2 and 8 samples, and a peak filter.

    They are those of LITE (Ismail-Fawaz et al. 2023), without the decreasing edges: these differ in sign only.
    """

    def __init__(self, layer: VectorLayer, arch: Arch) -> None:
        super().__init__(layer, arch)
        edge, slope = torch.tensor([-1.0, 1.0]), torch.tensor([0.25, 1.0, 1.0, 0.25])
        fixed = [edge, edge.repeat(4), torch.cat([-slope, 2.0 * slope, -slope])]
        with torch.no_grad():
            for number, taps in enumerate(fixed):
                self.weight[:, number] = F.pad(taps / taps.norm(), (layer.kernel - len(taps), 0))
        trained = torch.arange(layer.filters)[:, None] >= len(fixed)
        self.weight.register_hook(lambda gradient: gradient * trained)  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class FoldTask:
    """The arguments of a variant: network, training settings, windows, and a journal of trained networks."""

    arch: Arch
    spec: TrainSpec
    train: WindowSet
    test: WindowSet
    networks: Journal

    @cached_property
    def scaler(self) -> Scaler:
        return Scaler.fit(self.train.integers, self.train.vectors)

    def scaled(self, windows: WindowSet) -> NDArray[np.float32]:
        return self.scaler.apply(windows.integers[:, :, -self.arch.span :])

    def weights(self, seed: int | None = None, averaged: bool = False) -> Weights:
        """Return the last weights, or all averaged over the last third of the epochs; train if there are none."""
        spec = self.spec if seed is None else replace(self.spec, seed=seed)
        key = {"arch": self.arch.to_dict(), "training": spec.key(), "windows": windows_fingerprint(self.train)}
        found = self.networks.find(job_id(key))
        if found is None:
            last = range(2 * spec.epochs // 3 + 1, spec.epochs + 1)
            fitted = fit(self.train, None, self.arch, spec, keep=last)
            found = {f"last {name}": values for name, values in fitted.weights.items()}
            for name in fitted.weights:
                found[f"average {name}"] = np.mean([fitted.kept[epoch][name] for epoch in last], axis=0)
            self.networks.save(job_id(key), found)
        kind = "average" if averaged else "last"
        return {name: found[f"{kind} {name}"] for name in self.arch.weight_shapes}

    def predict(self, weights: Weights, windows: WindowSet | None = None) -> Floats:
        return predict(self.arch, weights, self.scaler, self.test if windows is None else windows)


def trained(task: FoldTask) -> Floats:
    """Train one network as PlushSense does."""
    fitted = fit(task.train, None, task.arch, task.spec)
    return predict(task.arch, fitted.weights, fitted.scaler, task.test)


def with_layer(layer: type[net.VectorNet], task: FoldTask) -> Floats:
    """Train a network with another vector layer."""
    own = net.VectorNet
    try:
        net.VectorNet = layer  # type: ignore[misc]
        return trained(task)
    finally:
        net.VectorNet = own  # type: ignore[misc]


def ensemble(task: FoldTask, windows: WindowSet | None = None) -> Floats:
    """Return the mean probabilities of the networks with the seeds `TEACHERS`."""
    return np.asarray(np.mean([task.predict(task.weights(seed), windows) for seed in TEACHERS], axis=0))


def distilled(task: FoldTask) -> Floats:
    """Train one network on the ensemble's probabilities of the training windows."""
    spec, x = task.spec, torch.from_numpy(task.scaled(task.train))
    soft = torch.from_numpy(ensemble(task, task.train)).float()
    augment = augmentations(spec.augment, Channels(task.train.vectors, task.scaler, x.device, has_gravity=True))
    with torch_threads(1):
        torch.manual_seed(spec.seed)
        random = torch.Generator().manual_seed(spec.seed)
        student = net.Net(task.arch)
        adam = Adam(student.parameters())
        for epoch in range(1, spec.epochs + 1):
            # Whole batches only: the statistics of a few remaining windows would be noisy.
            for batch in torch.randperm(len(x), generator=random).unfold(0, spec.batch, spec.batch):
                windows = x[batch] if augment is None else augment(x[batch], random)
                adam.zero_grad()
                torch.autograd.backward(F.cross_entropy(student(windows), soft[batch]))
                adam.step(spec.learning_rate_at(epoch))
    return task.predict(student.export_weights())


def refitted(spread: bool, task: FoldTask) -> Floats:
    """Fit the dense layer again, on the means (and standard deviations) over time of the frozen last features."""
    network = Network(task.arch, task.weights())

    def features(windows: WindowSet) -> Floats:
        x = task.scaled(windows)
        # Without the last normalisation, which `StandardScaler` makes up for.
        last = np.concatenate([network.rectified(x[at])[-1] for at in slices(len(x), 64)])
        return np.concatenate([last.mean(axis=1), last.std(axis=1)][: 1 + spread], axis=1)

    model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000))
    model.fit(features(task.train), task.train.y)
    return likelihoods(model, features(task.test), task.arch.classes)


def person_norm(task: FoldTask) -> Floats:
    """Standardize the outputs of the vector layer by all windows of the person who is scored."""
    weights, out = task.weights(), np.empty((len(task.test), task.arch.classes))
    mean, variance = weights["vector.mean"], weights["vector.var"] + NORM_EPSILON
    for theirs in by_person(task.test):
        windows = task.test.take(theirs)
        z = Network(task.arch, weights).convolved(task.scaled(windows))  # standardized by the training people
        statistics = {
            "vector.mean": mean + np.sqrt(variance) * z.mean(axis=(0, 1)),
            "vector.var": variance * z.var(axis=(0, 1)),
        }
        out[theirs] = task.predict({**weights, **statistics}, windows)
    return out


def person_scale(task: FoldTask) -> Floats:
    """Give the movement of every person who is scored the strength that it has in the training windows."""
    return task.predict(task.weights(), with_strength(task.test, rms(movement(task.train)[0])))


def people_scale(task: FoldTask) -> Floats:
    """Give the movement of all people the same strength."""
    strength = rms(movement(task.train)[0])
    return trained(replace(task, train=with_strength(task.train, strength), test=with_strength(task.test, strength)))


def by_person(windows: WindowSet) -> list[NDArray[np.int64]]:
    return [np.flatnonzero(windows.subject == person) for person in np.unique(windows.subject)]


def movement(windows: WindowSet) -> tuple[Floats, Floats]:
    """Return acceleration without gravity, and gravity, (N, 3, T)."""
    gravity = windows.integers[:, 3:6] / (1 << layouts.GRAVITY_FRACTION_BITS)
    return windows.integers[:, :3] - gravity, gravity


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def with_strength(windows: WindowSet, strength: float) -> WindowSet:
    """Multiply the movement of each person by one factor, so that its root mean square is ``strength``."""
    x = windows.integers.copy()
    for theirs in by_person(windows):
        moved, gravity = movement(windows.take(theirs))
        x[theirs, :3] = np.rint(gravity + moved * (strength / rms(moved)))
    return replace(windows, integers=x)


def rocket(task: FoldTask) -> Floats:
    """Fit MultiRocket-Hydra to channels that do not depend on how the toy is held.

    They are the vertical part and the horizontal length of the movement, the length of the acceleration, and the sense
    in which the horizontal part turns within 50 ms.
    """

    def invariant(windows: WindowSet) -> WindowSet:
        moved, gravity = movement(windows)
        up = gravity / np.linalg.norm(gravity, axis=1, keepdims=True).clip(1e-6)
        vertical = (moved * up).sum(axis=1)
        flat = moved - vertical[:, None] * up
        turn = (np.cross(np.roll(flat, 5, axis=2), flat, axis=1) * up).sum(axis=1)
        turn[:, :5] = 0.0
        channels = [vertical, np.linalg.norm(flat, axis=1), np.linalg.norm(windows.integers[:, :3], axis=1)]
        values = np.stack([*channels, np.sign(turn) * np.sqrt(np.abs(turn))], axis=1)
        return replace(windows, integers=np.rint(16 * values).astype(np.int32), vectors=())

    fitted = RocketFit("multirocket-hydra", task.arch.span, task.spec.seed)
    return fitted(invariant(task.train), task.train.take(np.arange(0)))(invariant(task.test))


def of_people(count: int, task: FoldTask) -> Floats:
    """Train on some of the people, chosen by the seed."""
    people = np.random.default_rng(task.spec.seed).permutation(np.unique(task.train.subject))[:count]
    return trained(replace(task, train=task.train.take(np.flatnonzero(np.isin(task.train.subject, people)))))


# Functions that compute the probabilities (N, K) of the test windows of a fold.
VARIANTS: dict[str, Callable[[FoldTask], Floats]] = {
    "": trained,
    "division": partial(with_layer, ByDivision),
    "no sense": partial(with_layer, WithoutSense),
    "fixed kernels": partial(with_layer, WithFixedKernels),
    "averaged": lambda task: task.predict(task.weights(averaged=True)),
    "ensemble": ensemble,
    "distilled": distilled,
    "refit mean": partial(refitted, False),
    "refit mean and sd": partial(refitted, True),
    "person norm": person_norm,
    "person scale": person_scale,
    "people scale": people_scale,
    "rocket": rocket,
    "people 3": partial(of_people, 3),
    "people 6": partial(of_people, 6),
    "people 9": partial(of_people, 9),
}


@dataclass(frozen=True)
class Row:
    """An idea: settings as for `plushsense.evaluate`, a time constant of gravity, and one of `VARIANTS`.

    ``seeds``: the most that are measured; ``parameters``: where they are not those of the one network;
    ``calibrated``: whether the accelerometer calibrates itself; ``regained``: whether each person's readings have
    another gain and offset (`Regained`); ``both_states``: whether each training window is read twice, in the causal
    state of the self-calibration and in that of `WholeSessions`.
    """

    title: str
    settings: dict[str, Any] = field(default_factory=dict)
    gravity_s: float = layouts.GRAVITY_S
    variant: str = ""
    seeds: int = 3
    parameters: int | None = None
    calibrated: bool = False
    regained: bool = False
    both_states: bool = False


GAIN, TILT, SPEED = "random-gain:0.3", "random-tilt:8", "random-speed:0.2"


def beside(title: str, gravity_s: float = layouts.GRAVITY_S, variant: str = "", **settings: Any) -> Row:
    """Return a row to compare with the row "speed", whose augmentations it has."""
    return Row(f"  {title}", {"augment": [GAIN, TILT, SPEED], **settings}, gravity_s, variant)


ROWS: dict[str, Row] = {
    "kept": Row("kept: v14_17d2_19d4 6/16/16, gain and tilt"),
    "raw": Row("raw axes turned at random by 45°, 14d1_19d2_19d4 8/12/16 (before)", BEFORE),
    "raw-plain": Row("raw axes, not augmented", {**BEFORE, "augment": []}),
    "not-augmented": Row("without augmentation", {"augment": []}),
    "tilt-speed": Row("speed in place of gain", {"augment": [TILT, SPEED]}),
    "gain-speed": Row("speed in place of tilt", {"augment": [GAIN, SPEED]}),
    "speed": Row("with speed as well; compared with it:", {"augment": [GAIN, TILT, SPEED]}),
    "no-sense": beside("without the sense of rotation", variant="no sense"),
    "division": beside("sense of rotation divided by the lengths, not a root", variant="division"),
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
    "average": Row("weights averaged over the last third of the epochs", variant="averaged"),
    "ensemble-10": Row("mean of ten networks (a ceiling)", variant="ensemble", seeds=1, parameters=101_100),
    "distilled": Row("one network trained on the probabilities of these ten", variant="distilled"),
    "mean": Row("dense layer fitted again, on the means over time", variant="refit mean"),
    "statistics": Row("  and on the standard deviations as well", variant="refit mean and sd", parameters=10_270),
    "lite": Row("three kernels fixed: edges and a peak (LITE)", variant="fixed kernels"),
    "person-norm": Row("vector layer standardized by the person's own windows (a ceiling)", variant="person norm"),
    "person-scale": Row("one gain of the movement for the person (a ceiling)", variant="person scale"),
    "people-scale": Row("  for the training people as well", variant="people scale"),
    "ceiling": Row("MultiRocket-Hydra on invariant channels (needs aeon)", variant="rocket", parameters=548_490),
    "people-3": Row("trained on 3 people of 11", variant="people 3"),
    "people-6": Row("trained on 6 people of 11", variant="people 6"),
    "people-9": Row("trained on 9 people of 11", variant="people 9"),
    "calibrated": Row("self-calibration", calibrated=True),
    "regained": Row("  each person's readings with another gain and offset", calibrated=True, regained=True),
    "uncalibrated": Row("  the same without self-calibration", regained=True),
    "both-states": Row("self-calibration, training windows in two states", calibrated=True, both_states=True),
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


class WholeSessions(SessionReader):
    """Reads a session in the state that it gives as a whole: from its beginning, once more after it was read once."""

    def initial_state(self, session: Iterable[Segment]) -> SelfCalibration:
        state = super().initial_state(())
        for segment in session:
            state.apply(segment.data)
        return state


@contextmanager
def whole_sessions() -> Iterator[None]:
    """Cut windows with `WholeSessions`, which is not causal: windows to train on only."""
    before = cut.SessionReader
    cut.SessionReader = WholeSessions  # type: ignore[misc]
    try:
        yield
    finally:
        cut.SessionReader = before  # type: ignore[misc]


@dataclass(frozen=True)
class FoldWork:
    """The work of one fold, with one of `VARIANTS`."""

    arch: Arch
    spec: TrainSpec
    variant: str
    networks: Journal

    def __call__(self, train: WindowSet, _: WindowSet, test: WindowSet, progress: EpochProgress, /) -> FoldOutput:
        found = VARIANTS[self.variant](FoldTask(self.arch, self.spec, train, test, self.networks))
        return FoldOutput(found.astype(np.float32))


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
    with gravity_over(row.gravity_s):
        runs = [evaluated(row, dataset, seed, args) for seed in seeds[: row.seeds]]
    scores: dict[str, Any] = {"parameters": runs[0][1], "seeds": seeds[: row.seeds]}
    for key in ("accuracy", "macro_f1"):
        means = [table[key]["mean"] for table, _ in runs]
        scores[key] = {"mean": fmean(means), "sd": stdev(means) if len(means) > 1 else None, "runs": means}
    by_recording = [table["by_recording"]["accuracy"] for table, _ in runs]
    people: dict[str, list[float]] = {one["subject"]: [] for one in runs[0][0]["subjects"]}
    for table, _ in runs:
        for one in table["subjects"]:
            people[one["subject"]].append(one["accuracy"])
    return scores | {"by_recording": fmean(by_recording), "people": people}


def evaluated(row: Row, dataset: Dataset, seed: int, args: argparse.Namespace) -> tuple[dict[str, Any], int]:
    settings = {**row.settings, "seed": seed} | ({"epochs": args.epochs} if args.epochs else {})
    config: RunConfig
    if row.regained:
        dataset = Regained.of(dataset)
    if row.calibrated:
        axes = args.axes.split(",") if args.axes else [axis for vector in dataset.layout.vectors for axis in vector]
        dataset = dataset.with_inputs(replace(dataset.layout, self_calibration=tuple(axes)))
    read, config = network_inputs_of(dataset, from_settings(**settings))
    config = replace(config, evaluation=replace(config.evaluation, seed=0))
    gestures = classes_for(read, config.evaluation.classes, config.windows.context)
    arch = config.model.build(read.layout, len(gestures), config.windows.window_s, config.padding)
    windows = windows_for(read, arch, config.windows, gestures)
    train = windows
    if row.both_states:
        with whole_sessions():
            train = windows.joined(windows_for(read, arch, config.windows, gestures))
    done = evaluate(
        train,
        windows,
        SPLIT,
        FoldWork(arch, config.training, row.variant, Journal(args.out / "networks")),
        journal=Journal(args.out / "folds"),
        key={"arch": arch.to_dict(), "training": config.training.key(), "layer": row.variant},
        workers=args.workers,
        validation=False,
    )
    return done.table, arch.parameters if row.parameters is None else row.parameters


def line(row: Row, scores: dict[str, Any]) -> str:
    spread = scores["accuracy"]["sd"]
    return (
        f"{row.title:80} {scores['parameters']:7,}  {scores['accuracy']['mean']:.3f} "
        f"± {'–' if spread is None else format(spread, '.3f')}  {scores['macro_f1']['mean']:.3f}  "
        f"{scores['by_recording']:.3f}"
    )


if __name__ == "__main__":
    main()
