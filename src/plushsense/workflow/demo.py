"""Run the whole pipeline on a virtual toy: record, import, train, evaluate, classify live, export, report."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from plushsense.deploy.code import FACTS
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.stream import VirtualDevice
from plushsense.live.loop import run_live
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


def run_demo(out: Path, *, quick: bool = False, stage: Stage, progress: Progress) -> dict[str, Any]:
    """Run the demo in the folder ``out``; a second run reuses the finished recordings and folds.

    Returns:
        the paths ``dataset``, ``bundle``, ``report`` and ``export``, the ``scores``, and the ``live`` decisions.
    """
    size = QUICK if quick else FULL
    out.mkdir(parents=True, exist_ok=True)
    mark = out / MARK
    if any(out.iterdir()) and not mark.is_file():
        raise ConfigError(f"'{out}' contains files that are not a demo: give a new or empty folder with --out.")
    mark.write_text("Written by  plushsense demo . A simulation; this folder can be deleted.\n", encoding="utf-8")
    name = f"{size.people}x{size.repetitions}"
    stage(f"1/6  {size.people} virtual people record {size.repetitions} × 17 gestures, and the recordings are imported")
    dataset = _dataset(out / f"dataset-{name}", out / f"recordings-{name}", size, progress)
    config = resolve(None, training={"epochs": size.epochs, "halve_every": max(1, size.epochs // 4)})
    arch = prepare(dataset, config).model.arch
    stage(f"2/6  train {arch} on {len(dataset.subjects)} people, some of them for validation")
    trained = train(dataset, config, progress=lambda epoch, epochs, _: progress("training", epoch, epochs), warn=silent)
    bundle = trained.save(out / "model.plush")
    stage(f"3/6  evaluate it on people left out, in {size.folds} folds")
    evaluation = out / f"evaluation-{name}"
    result = evaluate(
        dataset,
        config,
        split=f"by-subject:{size.folds}",
        out=evaluation,
        overwrite=True,
        progress=lambda at: progress("folds", at.done, at.total),
        warn=silent,
    ).to_json()
    stage(f"4/6  live: {size.live_s:.0f} s of a virtual person left out of the training")
    live = _live(bundle, size.live_s)
    stage("5/6  export C for the toy, which gives the same answers")
    exported = _export(bundle, out / "export")
    stage("6/6  write the report")
    report = write_report(out / "report.html", dataset, [evaluation], [bundle], title="PlushSense demo")
    return {
        "simulation": SIMULATION,
        "dataset": str(dataset.path),
        "bundle": str(bundle),
        "report": str(report),
        "export": str(exported),
        "scores": {key: result[key] for key in ("split", "context", "leaky", "accuracy", "macro_f1", "by_recording")},
        "live": live,
    }


def _dataset(dest: Path, raw: Path, size: DemoSize, progress: Progress) -> Dataset:
    """Open the data set of virtual people; if it does not exist, simulate and import it."""
    if (dest / "dataset.toml").is_file():
        return open_dataset(dest)
    if not raw.exists():
        simulate(raw, people=size.people, repetitions=size.repetitions, seed=1, progress=progress)
    return import_simulation(raw, dest, progress)


def _export(bundle: Path, folder: Path) -> Path:
    """Export the model, replacing the export of an earlier demo."""
    if (folder / FACTS).is_file():
        shutil.rmtree(folder)
    return export(bundle, folder, warn=silent).folder


def _live(bundle: Path, seconds: float) -> dict[str, Any]:
    """Compare the decision at the end of each gesture of a virtual person with the performed gesture."""
    model = Bundle.load(bundle)
    classifier = StreamClassifier(model)
    with open_device(f"virtual://?person={STRANGER}&seed=7&speed=0", model.layout) as device:
        if not isinstance(device, VirtualDevice):
            raise ConfigError("The demo needs the virtual toy.")
        live = run_live(device, classifier, seconds=seconds)
        decisions = list(live)
        summary = live.summary().to_dict()
        gestures = []
        for performed in device.performed:
            begin, end = performed.start_s, performed.end_s
            during = [d for d in decisions if begin <= d.t_s <= end and d.gesture is not None]
            if during and end <= summary["seconds"]:
                last = during[-1]
                gestures.append(
                    {
                        "t_s": round(begin, 2),
                        "performed": performed.label,
                        "affect": model.gestures.get(performed.label).affect,
                        "said": last.gesture,
                        "said_affect": last.affect,
                        "confidence": last.confidence,
                    }
                )
    return {"summary": summary, "gestures": gestures}
