"""The studio's long tasks; `plushsense.studio.app.worker` runs each in a process of its own."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, ToolError
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.pseudonymise import pseudonymise
from plushsense.deploy.package import changed_copies
from plushsense.deploy.profile import profile
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import verify
from plushsense.studio.app.jobs import UNFINISHED
from plushsense.studio.app.worker import TaskReporter
from plushsense.studio.pages.export.exports import folder_digest
from plushsense.workflow.api import simulate
from plushsense.workflow.config import from_settings
from plushsense.workflow.datasets import check_dataset, publish_dataset, validate_package
from plushsense.workflow.export import export
from plushsense.workflow.reporting import check_folder


class Clock:
    """Told the share of the work that is done, says ``share`` and ``left_s`` (None while there is nothing to go by).

    What was done before, by an earlier run, comes at once and is no measure: time counts from the first share that took
    any.
    """

    def __init__(self, instant_s: float = 0.02) -> None:
        self._instant_s = instant_s
        self._last_s = self._began_s = time.monotonic()
        self._from = 0.0

    def at(self, share: float) -> dict[str, Any]:
        """Return the share of the work that is done and the time left."""
        now = time.monotonic()
        if self._from == 0.0 or (now - self._last_s < self._instant_s and now - self._began_s < 1.0):
            self._from, self._began_s = share, now
        self._last_s = now
        gone = share - self._from
        left = (now - self._began_s) / gone * (1.0 - share) if gone > 0 else None
        return {"share": round(share, 4), "left_s": None if left is None else round(left, 1)}


def run_check(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Look at every recording of ``spec["dataset"]``."""
    found = check_dataset(spec["dataset"], progress=lambda done, total: reporter.progress(done=done, total=total))
    counts = found.counts()
    return {
        "dataset": str(spec["dataset"]),
        "recordings": found.recordings,
        "undecided": len(found.undecided),
        "by_severity": counts["by_severity"],
        "by_check": counts["by_check"],
        "hash": found.dataset.hash,
        "seconds": round(found.seconds, 2),
    }


UNPACKED = UnpackLimits(total_bytes=4_000_000_000, files=50_000)
"""What a zip that came through the browser may unpack to."""


def run_import(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Import ``sessions`` (folders below ``recordings``, gathered in ``work``) or the zip ``archive`` to ``dest``.

    ``add``: to the data set that is there. The archive is the studio's own copy, and is removed in the end.
    """
    settings: dict[str, Any] = {"add_to": True} if spec.get("add") else {"name": spec.get("name") or None}
    if spec.get("layout"):
        settings["layout"] = spec["layout"]
    archive = Path(spec["archive"]) if spec.get("archive") else None
    try:
        with _itself(archive) if archive is not None else _gathered(spec) as source:
            done = import_recordings(
                source,
                spec["dest"],
                progress=lambda at, total: reporter.progress(done=at, total=total),
                limits=UNPACKED,
                **settings,
            )
    finally:
        if archive is not None:
            archive.unlink(missing_ok=True)
    return {
        "dataset": str(spec["dest"]),
        "recordings": done.recordings,
        "subjects": done.subjects,
        "added": done.added,
        "already_there": done.already_there,
        "warnings": done.notes + done.warnings,
        "left_out": done.left_out,
        "rejected": done.rejected,
        "seconds": round(done.seconds, 2),
    }


@contextmanager
def _itself(archive: Path) -> Iterator[Path]:
    yield archive


@contextmanager
def _gathered(spec: dict[str, Any]) -> Iterator[Path]:
    """Yield a temporary folder with these sessions alone, as hard links where the disk supports them."""
    recordings = Path(spec["recordings"])
    work = Path(spec["work"])
    work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=work) as place:
        folder = Path(place) / "recordings"
        for session in spec["sessions"]:
            inside = Path(session).relative_to(recordings)
            shutil.copytree(recordings / inside, folder / inside, copy_function=_linked)
        yield folder


def _linked(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target


def run_simulate(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Simulate ``people`` with ``repetitions`` each as the new data set ``dest``, which says that it
    is a simulation. ``work`` is a folder for what is made on the way.
    """
    work = Path(spec["work"])
    work.mkdir(parents=True, exist_ok=True)
    # The recordings are of no more use once the data set holds them.
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=work) as place:
        done = simulate(
            Path(place) / "sessions",
            people=int(spec["people"]),
            repetitions=int(spec["repetitions"]),
            seed=int(spec.get("seed", 1)),
            dataset=spec["dest"],
            progress=lambda what, at, total: reporter.progress(what=what, done=at, total=total),
        )
    return {"dataset": str(spec["dest"]), "recordings": done["recordings"], "people": done["people"]}


def run_pseudonymise(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Make ``spec["place"]`` of ``dataset`` with the ``key`` file; ``words`` and ``drop_notes`` as the library's.

    Raises:
        ConfigError: without ``words``: a studio that was started again has not kept them, and none is not the same.
    """
    if "words" not in spec:
        raise ConfigError("Words that may not be left anywhere are not kept: give them again on the publish page.")
    done = pseudonymise(
        spec["dataset"],
        spec["place"],
        key=spec["key"],
        words=spec["words"],
        drop_notes=spec.get("drop_notes", False),
        progress=lambda done, total: reporter.progress(stage="rewriting", done=done, total=total),
    )
    return done.to_dict()


def run_publish(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Publish ``spec["dataset"]`` as the package ``spec["place"]``; the other keys are arguments of
    `publish_dataset`.
    """
    key = spec.get("key") or None
    if key is not None:
        try:
            Path(key).parent.mkdir(parents=True, exist_ok=True)
        except OSError as cause:
            raise DatasetError(f"The key '{key}' cannot be kept: {cause.strerror or cause}.") from None
    done = publish_dataset(
        spec["dataset"],
        spec["place"],
        licence=spec.get("licence", ""),
        contact=spec.get("contact", ""),
        consent=spec.get("consent", ""),
        save=spec.get("save", False),
        streams=spec.get("streams", True),
        excluded=spec.get("excluded", False),
        columns=tuple(spec.get("columns", ())),
        key=key,
        bids=spec.get("bids", False),
        reidentification=spec.get("reidentification", True),
        thorough=spec.get("thorough", False),
        progress=lambda stage, done, total: reporter.progress(stage=stage, done=done, total=total),
    )
    return done.to_dict()


def run_validate(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Prove the package ``spec["place"]``, a folder or a zip; ``thorough``: every row of the streams by everybody."""
    checked = validate_package(
        spec["place"],
        thorough=spec.get("thorough", False),
        progress=lambda stage, done, total: reporter.progress(stage=stage, done=done, total=total),
    )
    return checked.to_dict()


def run_train(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Train and save a bundle; of a dry run return the estimate of `preview_training`."""
    config = from_settings(**spec.get("settings", {}))
    if spec.get("dry"):
        from plushsense.trials.estimate import preview_training

        return preview_training(spec["dataset"], config, warn=reporter.warn)
    out = Path(spec["out"])
    check_folder(out.parent, "A bundle")
    reporter.progress(stage="reading", share=0.0)

    from plushsense.workflow.api import train, unfinished

    clock, tuning = Clock(), int(spec.get("quantize_aware", 0))
    whole = config.training.epochs + tuning

    def epoch(at: int, of: int, row: dict[str, Any]) -> None:
        fine = "what" in row
        done = config.training.epochs + at if fine else at
        stage = "fine-tuning" if fine else "training"
        shown = {k: row.get(k) for k in ("train_loss", "train_accuracy", "validation_loss", "validation_accuracy")}
        reporter.progress(stage=stage, epoch=at, epochs=of, **shown, **clock.at(done / whole))
        if at == of and not fine and not tuning:
            reporter.progress(stage="deciding", epoch=at, epochs=of, share=1.0)

    done = train(
        spec["dataset"],
        config,
        quantize_aware=tuning,
        fit_decisions=bool(spec.get("fit_decisions", True)),
        journal=unfinished(spec["dataset"]),
        progress=epoch,
        warn=reporter.warn,
    )
    bundle = done.save(_free(out, done.bundle.to_bytes()))
    return {
        "bundle": str(bundle),
        "scores": done.scores,
        "seconds": round(done.seconds, 1),
        "parameters": done.bundle.arch.parameters,
        "title": done.bundle.arch.title,
        "epochs": len(done.history),
        "fitted": done.bundle.decision.get("fitted") is not None,
    }


def _free(path: Path, content: bytes) -> Path:
    """Return the path, or a numbered one beside it if another file has taken it meanwhile."""
    number, free = 2, path
    while free.exists() and not (free.is_file() and free.read_bytes() == content):
        free = path.with_stem(f"{path.stem} {number}")
        number += 1
    return free


def run_evaluate(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Evaluate; return the output folder, the report and the main scores, of a dry run the estimate."""
    config = from_settings(**spec.get("settings", {}))
    if spec.get("split"):
        config = replace(config, evaluation=replace(config.evaluation, split=spec["split"]))
    if spec.get("dry"):
        from plushsense.trials.estimate import preview_evaluation

        return preview_evaluation(spec["dataset"], config, warn=reporter.warn)
    reporter.progress(stage="reading", share=0.0)

    from plushsense.dataset.index import open_dataset
    from plushsense.workflow.api import evaluate
    from plushsense.workflow.reporting import PAGE, name_of, write_report

    dataset = open_dataset(spec["dataset"])
    out = dataset.path / "evaluations" / name_of(config, dataset)
    clock, running = Clock(), dict[str, float]()

    def fold(at: Any) -> None:
        if at.epoch:
            running[at.fold] = at.epoch / at.epochs
        else:
            running.pop(at.fold, None)
        share = (at.done + sum(running.values())) / at.folds
        row = at.row or {}
        shown = {k: row.get(k) for k in ("train_loss", "validation_loss", "validation_accuracy")}
        where = {"done": at.done, "folds": at.folds, "resumed": at.resumed, "fold": at.fold}
        reporter.progress(stage="training", epoch=at.epoch, epochs=at.epochs, **where, **shown, **clock.at(share))

    result = evaluate(dataset, config, out=out, int8=bool(spec.get("int8")), progress=fold, warn=reporter.warn)
    report = write_report(out / PAGE, dataset, [out])
    table = result.table
    return {
        "out": str(out),
        "report": str(report),
        "split": result.split.text,
        "leaky": result.split.leaky,
        "context": result.context,
        "simulated": dataset.head.simulated,
        "seeds": result.seeds,
        "over": table["over"],
        "units": len(table[table["over"]]),
        "accuracy": table["accuracy"],
        "macro_f1": table["macro_f1"],
    }


def run_sweep(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Run a sweep; return ``out`` and the summary's main figures, of a dry run the preview."""
    from plushsense.experiments.sweep.run import preview, sweep

    changes = dict(spec.get("changes", {}))
    if spec.get("dry"):
        return preview(spec["dataset"], spec["grid"], measure=True, warn=reporter.warn, **changes)
    reporter.progress(stage="reading", share=0.0)
    clock = Clock()

    def training(at: Any) -> None:
        best = at.best and {key: at.best[key] for key in ("arch", "filters", "accuracy", "macro_f1")}
        where = {"done": at.done, "trainings": at.trainings, "resumed": at.resumed, "what": at.what}
        reporter.progress(stage="training", epoch=at.epoch, epochs=at.epochs, best=best, **where, **clock.at(at.share))

    found = sweep(spec["dataset"], spec["grid"], progress=training, warn=reporter.warn, **changes)
    s = found.summary
    for lost in s["failed"]:
        reporter.warn(f"{lost['arch']} with {lost['filters']} was given up: {lost['why']}")
    keys = ("name", "split", "leaky", "context", "simulated", "trials", "done", "trainings_lost", "best", "seconds")
    return {"out": str(found.out), **{key: s[key] for key in keys}}


def run_search(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Run a search; return ``out`` and the summary's main figures, of a dry run the preview."""
    from plushsense.experiments.search.run import preview_search, search

    asked, changes = dict(spec.get("asked", {})), dict(spec.get("changes", {}))
    if spec.get("dry"):
        return preview_search(
            spec["dataset"], spec["grid"], asked=asked, changes=changes, measure=True, warn=reporter.warn
        )
    reporter.progress(stage="reading", share=0.0)
    clock = Clock()

    def training(at: Any) -> None:
        best = at.best and {"title": at.best[0], "macro_f1": at.best[1]}
        where = {"rung": at.rung, "rungs": at.rungs, "networks": at.networks, "what": at.what}
        where |= {"done": at.done, "trainings": at.trainings, "resumed": at.resumed}
        share = min(1.0, at.share)
        reporter.progress(stage="training", epoch=at.epoch, epochs=at.epochs, best=best, **where, **clock.at(share))

    found = search(spec["dataset"], spec["grid"], **asked, progress=training, warn=reporter.warn, **changes)
    s = found.summary
    keys = ("name", "split", "leaky", "context", "simulated", "candidates", "winner", "smallest_equal", "seconds")
    return {"out": str(found.out), **{key: s[key] for key in keys}, "command": s["command"]}


def run_profile(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Count on the export ``spec["place"]``."""
    return {"profile": measured(Path(spec["place"]), reporter)}


def measured(folder: Path, reporter: TaskReporter) -> dict[str, Any]:
    """Return the profile in plain values with the ``digest`` of what was measured; ``refused``: why there is none."""
    before = folder_digest(folder)
    reporter.progress(stage="profile")
    try:
        found = profile(folder, progress=lambda done, total: reporter.progress(stage="profile", done=done, total=total))
    except ToolError as refusal:
        # The export stands without it.
        return {"digest": before, "refused": str(refusal)}
    return {"digest": before, **found.to_dict()}


def run_export(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Export ``spec["bundle"]`` to ``spec["place"]``; ``also`` are formats, ``dataset`` ("": none) calibrates anew."""
    reporter.progress(stage="export")
    done = export(
        spec["bundle"],
        spec["place"],
        dataset=spec.get("dataset") or None,
        also=spec.get("also", ()),
        warn=reporter.warn,
    )
    return {**done.to_dict(), "profile": measured(Path(spec["place"]), reporter)}


_SAMPLES = 100_000


def run_verify(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Prove the export ``spec["place"]`` on ``targets`` (none: all that are here), also with recordings of
    ``dataset`` ("": none), with mutants if ``faults``, and with ``trust`` also where the C was changed.
    """
    folder = Path(spec["place"])
    before = folder_digest(folder)
    reporter.progress(stage="vectors")
    export = Export(folder)
    dataset = spec.get("dataset")
    vectors = export.recorded(open_dataset(dataset), [], _SAMPLES) if dataset else export.made_up(0)
    done = verify(
        export,
        spec.get("targets", ()),
        vectors,
        mutants=(lambda mutant: True) if spec.get("faults") else None,
        trust=bool(spec.get("trust")),
        progress=lambda done, total: reporter.progress(stage="verify", done=done, total=total),
    )
    return {**done.to_dict(), "digest": before, "changed_copies": changed_copies(folder)}
