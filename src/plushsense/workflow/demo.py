"""Run the whole pipeline on a virtual toy: record, import, train, evaluate, classify live, export, report."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from plushsense.core.errors import ConfigError
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from plushsense.deploy.code import FACTS
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.stream import VirtualDevice
from plushsense.evaluation.crossval import EvaluationResult
from plushsense.live.loop import LiveSummary, run_live
from plushsense.models.bundle import Bundle
from plushsense.runtime.classifier import StreamClassifier
from plushsense.workflow.api import evaluate, import_simulation, simulate, train
from plushsense.workflow.config import resolve
from plushsense.workflow.export import export
from plushsense.workflow.preparation import prepare, silent
from plushsense.workflow.reporting import write_report

SIMULATION = "These scores are of a simulation (the virtual toy) and say nothing about a real toy."


@dataclass(frozen=True)
class DemoSize:
    """Amount of simulated data and length of the training."""

    people: int
    repetitions: int
    epochs: int
    folds: int
    live_s: float


FULL = DemoSize(people=12, repetitions=3, epochs=60, folds=4, live_s=120.0)
QUICK = DemoSize(people=10, repetitions=2, epochs=45, folds=2, live_s=60.0)

# Simulated data sets contain people 1 to 25.
STRANGER = 101
MARK = "plushsense-demo.txt"

Stage = Callable[[str], None]
Progress = Callable[[str, int, int], None]


class DemoGesture(NamedTuple):
    """A gesture that the virtual toy performed, from ``t_s``, and the decision at its end."""

    t_s: float
    performed: str
    affect: str
    decided: str
    decided_affect: str | None
    confidence: float | None


@dataclass(frozen=True)
class DemoResult:
    """What `run_demo` made, how good the network is on people left out, and what it decided live."""

    dataset: Path
    bundle: Path
    report: Path
    export: Path
    evaluation: EvaluationResult
    live: LiveSummary
    gestures: tuple[DemoGesture, ...]

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON; the decisions have the keys ``said`` and ``said_affect``."""
        scores = self.evaluation.to_json()
        keys = ("split", "context", "leaky", "accuracy", "macro_f1", "by_recording")
        names = {"decided": "said", "decided_affect": "said_affect"}
        gestures = [{names.get(key, key): value for key, value in g._asdict().items()} for g in self.gestures]
        return {
            "simulation": SIMULATION,
            **{name: str(getattr(self, name)) for name in ("dataset", "bundle", "report", "export")},
            "scores": {key: scores[key] for key in keys},
            "live": {"summary": self.live.to_dict(), "gestures": gestures},
        }


def run_demo(out: Path, *, quick: bool = False, stage: Stage, progress: Progress) -> DemoResult:
    """Run the demo in the folder ``out``; a second run reuses the finished recordings and folds."""
    size = QUICK if quick else FULL
    out.mkdir(parents=True, exist_ok=True)
    mark = out / MARK
    if any(out.iterdir()) and not mark.is_file():
        raise ConfigError(f"'{out}' contains files that are not a demo: give a new or empty folder with --out.")
    mark.write_text("Written by  plushsense demo . A simulation; this folder can be deleted.\n", encoding="utf-8")
    name = f"{size.people}x{size.repetitions}"
    stage(f"1/6  {size.people} virtual people record {size.repetitions} × 17 gestures, and the recordings are imported")
    dataset = _dataset(out / f"dataset-{name}", out / f"recordings-{name}", size, progress)
    training = {"epochs": size.epochs, "halve_every": max(1, size.epochs // 4)}
    config = resolve(None, training=training, evaluation={"split": f"by-subject:{size.folds}"})
    arch = prepare(dataset, config).model.arch
    stage(f"2/6  train {arch} on {len(dataset.subjects)} people, some of them for validation")
    trained = train(dataset, config, progress=lambda epoch, epochs, _: progress("training", epoch, epochs), warn=silent)
    bundle = trained.save(out / "model.plush")
    stage(f"3/6  evaluate it on people left out, in {size.folds} folds")
    evaluation = out / f"evaluation-{name}"
    result = evaluate(
        dataset,
        config,
        out=evaluation,
        overwrite=True,
        progress=lambda at: progress("folds", at.done, at.total),
        warn=silent,
    )
    stage(f"4/6  live: {size.live_s:.0f} s of a virtual person left out of the training")
    live, gestures = _live(bundle, size.live_s)
    stage("5/6  export C for the toy, which gives the same answers")
    exported = out / "export"
    if (exported / FACTS).is_file():  # that of an earlier demo
        shutil.rmtree(exported)
    exported = export(bundle, exported, warn=silent).folder
    stage("6/6  write the report")
    report = write_report(out / "report.html", dataset, [evaluation], [bundle], title="PlushSense demo")
    return DemoResult(dataset.path, bundle, report, exported, result, live, gestures)


def _dataset(dest: Path, raw: Path, size: DemoSize, progress: Progress) -> Dataset:
    """Open the data set of virtual people; if it does not exist, simulate and import it."""
    if (dest / "dataset.toml").is_file():
        return open_dataset(dest)
    if not raw.exists():
        simulate(raw, people=size.people, repetitions=size.repetitions, seed=1, progress=progress)
    return import_simulation(raw, dest, progress)


def _live(bundle: Path, seconds: float) -> tuple[LiveSummary, tuple[DemoGesture, ...]]:
    """Compare the decision at the end of each gesture of a virtual person with the performed gesture."""
    model = Bundle.load(bundle)
    with open_device(f"virtual://?person={STRANGER}&seed=7&speed=0", model.layout) as device:
        if not isinstance(device, VirtualDevice):
            raise ConfigError("The demo needs the virtual toy.")
        live = run_live(device, StreamClassifier(model), seconds=seconds)
        decisions = list(live)
        summary, gestures = live.summary(), []
        for performed in device.performed:
            begin, end = performed.start_s, performed.end_s
            during = [d for d in decisions if begin <= d.t_s <= end and d.gesture is not None]
            if during and end <= summary.seconds:
                last, affect = during[-1], model.gestures.get(performed.label).affect
                answer = (str(last.gesture), last.affect, last.confidence)
                gestures.append(DemoGesture(round(begin, 2), performed.label, affect, *answer))
    return summary, tuple(gestures)
