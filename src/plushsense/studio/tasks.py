"""Define the long tasks of the studio and the worker process in which `plushsense.studio.app.jobs` runs each one.

The worker reads one line of JSON, ``{"task": ..., "spec": {...}}``, from standard input. It writes lines of JSON to
standard output: ``{"progress": {...}}``, ``{"warning": ...}``, and finally ``{"result": {...}}`` or ``{"refused":
{...}}``, a `Message` as JSON. A process that ends with neither of these was stopped.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, PlushSenseError, ToolError
from plushsense.core.files import free_path, write_file
from plushsense.core.sentences import Message, plain
from plushsense.dataset.backup import backup, is_backup, restore
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.importing.column_parts import GuessSpec
from plushsense.dataset.importing.guessing import guess_pattern
from plushsense.dataset.importing.importers import import_recordings, preview_import, propose
from plushsense.dataset.importing.results import ImportResult
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.removed import CONSENT
from plushsense.dataset.publishing.checking import validate_package
from plushsense.dataset.store import HEAD
from plushsense.dataset.trimming import TrimDecisions, decide_trims
from plushsense.deploy.profile import profile
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import verify
from plushsense.jobs.progress import JobProgress
from plushsense.studio.app.jobs import READY, UNFINISHED, WARM, WARM_S
from plushsense.studio.app.workspace import folder_digest, refusal_of
from plushsense.training.spec import EpochRow
from plushsense.windows.cut import ANYWHERE
from plushsense.workflow.api import simulate, train, unfinished
from plushsense.workflow.config import from_settings, from_stored
from plushsense.workflow.datasets import PublishSpec, check_dataset, publish_dataset
from plushsense.workflow.export import export
from plushsense.workflow.forgetting import forget_everywhere
from plushsense.workflow.networks import REFIT
from plushsense.workflow.preparation import count_people, network_for, refit_epochs, with_preset
from plushsense.workflow.project import open_project, save_project
from plushsense.workflow.reporting import check_folder, load_evaluation


class TaskReporter:
    """Writer of the progress and warnings of a task as lines of JSON; its methods are thread-safe."""

    def __init__(self, out: Any) -> None:
        self._out, self._lock = out, threading.Lock()

    def write(self, **message: Any) -> None:
        """Write one line of JSON."""
        with self._lock:
            self._out.write(json.dumps(plain(message), ensure_ascii=True, default=str) + "\n")
            self._out.flush()

    def progress(self, **values: Any) -> None:
        """Report the progress of the task."""
        self.write(progress=values)

    def count(self, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` items are done."""
        self.progress(done=done, total=total)

    def stage(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` items of a stage are done."""
        self.progress(stage=stage, done=done, total=total)

    def warn(self, sentence: str) -> None:
        """Report a warning to the user."""
        self.write(warning=plain(sentence))


class Clock:
    """Estimator of the remaining time of a task from the share of the work that is done.

    A resumed task reports the work of earlier runs within moments, which does not indicate its speed. Therefore, time
    is measured from the first report that came more than ``instant_s`` after the previous one.
    """

    def __init__(self, instant_s: float = 0.02) -> None:
        self._instant_s = instant_s
        self._last_s = self._start_s = time.monotonic()
        self._start_share = 0.0

    def at(self, share: float) -> dict[str, object]:
        """Return a dictionary with ``share`` and ``left_s``, the remaining seconds (None if unknown)."""
        now = time.monotonic()
        if self._start_share == 0.0 or (now - self._last_s < self._instant_s and now - self._start_s < 1.0):
            self._start_share, self._start_s = share, now
        self._last_s = now
        gained = share - self._start_share
        left = (now - self._start_s) / gained * (1.0 - share) if gained > 0 else None
        return {"share": round(share, 4), "left_s": None if left is None else round(left, 1)}


def _check(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Check every recording of the data set ``spec["dataset"]`` and return counts of the findings."""
    report = check_dataset(spec["dataset"], progress=reporter.count)
    by_severity = report.counts()["by_severity"]
    return {"dataset": str(spec["dataset"]), "undecided": len(report.undecided), "by_severity": by_severity}


UNPACKED = UnpackLimits(total_bytes=4_000_000_000, files=50_000)
"""Limits for unpacking an uploaded zip."""


def _import(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Import ``sessions`` (folders in ``recordings``, collected in ``work``) into ``dest``.

    With ``add``, ``dest`` is an existing data set.
    """
    settings: dict[str, Any] = {"add_to": True} if spec.get("add") else {"name": spec.get("name") or None}
    with _collected(spec) as source:
        done = import_recordings(
            source, spec["dest"], progress=reporter.count, readmit=spec.get("readmit", False), **settings
        )
    stored = done.to_json()
    result = {key: stored[key] for key in ("recordings", "subjects", "added", "rejected")}
    return {**result, "dataset": str(spec["dest"]), "warnings": list(done.notes), "flagged": len(done.warnings)}


@contextlib.contextmanager
def _collected(spec: dict[str, Any]) -> Iterator[Path]:
    """Yield a temporary folder with only the chosen sessions, as hard links if the file system supports them."""
    recordings = Path(spec["recordings"])
    work = Path(spec["work"])
    work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=work) as place:
        folder = Path(place) / "recordings"
        for session in spec["sessions"]:
            inside = Path(session).relative_to(recordings)
            shutil.copytree(recordings / inside, folder / inside, copy_function=_link_or_copy)
        yield folder


def _link_or_copy(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target


def _inspect(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Make the data set ``dest`` of the folder or file of each path in ``sources``; return what it contains.

    A source that cannot be imported is among ``rejected``. If none can, ``foreign`` is read as one of the saved
    ``patterns`` describes it; without one that fits, the result is that of `_guess`. ``pattern`` reads ``foreign`` at
    once, and ``layout`` and ``person`` may be "", see `import_recordings`. A single backup is restored.
    """
    dest, sources = Path(spec["dest"]), [Path(source) for source in spec["sources"]]
    restored = len(sources) == 1 and is_backup(sources[0])
    readmit = bool(spec.get("readmit"))
    if restored:
        restore(sources[0], dest, progress=reporter.count, readmit=readmit)
        return _contents(dest, [], restored=True)
    if pattern := spec.get("pattern"):
        return _contents(dest, [_import_foreign(spec, pattern, reporter)])
    done: list[ImportResult] = []
    refused: list[tuple[str, PlushSenseError]] = []
    for source in sources:
        adding = dest.exists()
        settings: dict[str, Any] = {} if adding or not spec["layout"] else {"layout": spec["layout"]}
        try:
            result = import_recordings(
                source,
                dest,
                add_to=adding,
                person=spec["person"],
                guess_layout=not adding,
                # What a single source proves may not fit the others.
                adopt_proposals=None if len(sources) == 1 and not adding else False,
                readmit=readmit,
                limits=UNPACKED,
                progress=reporter.count,
                **settings,
            )
            done.append(result)
        except PlushSenseError as refusal:
            refused.append((source.name, refusal))
    if done:
        if len(sources) > 1:
            done.append(replace(propose(done[-1], adopting=None), warnings=(), rejected=()))
        return _contents(dest, done, [{"file": file, "reason": cause.message} for file, cause in refused])
    first = refused[0][1]
    needs = first.message.values.get("needs")
    if needs in ("person", CONSENT):
        raise first
    for pattern in spec["patterns"]:
        try:
            read = _import_foreign(spec, pattern, reporter)
            if _MOST_REJECTED * len(read.rejected) <= read.recordings + read.streams:
                return _contents(dest, [read], pattern=pattern)
        except PlushSenseError as refusal:
            if refusal.message.values.get("needs") == CONSENT:
                raise
        shutil.rmtree(dest, ignore_errors=True)
    try:
        return _guess(spec, reporter, recorded=needs == "layout")
    except PlushSenseError as unfit:
        raise (unfit if needs in ("layout", "files") else first) from None


_MOST_REJECTED = 10
"""A saved pattern fits files of which at most one in so many is rejected."""


def _import_foreign(spec: dict[str, Any], pattern: str, reporter: TaskReporter) -> ImportResult:
    """Make the data set ``dest`` of ``foreign`` by a pattern."""
    return import_recordings(
        spec["foreign"],
        spec["dest"],
        pattern=pattern,
        person=spec["person"] or None,
        readmit=bool(spec.get("readmit")),
        limits=UNPACKED,
        progress=reporter.count,
    )


def _contents(
    dest: Path,
    done: list[ImportResult],
    rejected: Iterable[dict[str, str]] = (),
    *,
    pattern: str = "",
    restored: bool = False,
) -> dict[str, Any]:
    """Return what the data set ``dest`` of some imports contains, and what they noted."""
    dataset = open_dataset(dest)
    return {
        "name": dataset.head.name if restored else "",
        "restored": restored,
        "pattern": pattern,
        "layout": dataset.head.layout.name,
        "simulated": dataset.head.simulated,
        "recordings": len(dataset.recordings),
        "people": dict(Counter(r.subject for r in dataset.recordings)),
        "gestures": dict(Counter(r.gesture for r in dataset.recordings)),
        "notes": list(dict.fromkeys(note for result in done for note in result.notes)),
        "flagged": sum(len(result.warnings) for result in done),
        "rejected": [*rejected, *(entry.to_json() for result in done for entry in result.rejected)],
    }


_PREVIEWED = 12


def _guess(spec: dict[str, Any], reporter: TaskReporter, recorded: bool = True) -> dict[str, Any]:
    """Guess how ``foreign`` is to be read, with what ``given`` states; return the guess, and some rows of it.

    If no file can be read so, ``problem`` is the reason.
    """
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in spec["given"].items()}
    guessed = guess_pattern(spec["foreign"], GuessSpec(**given, recorded=recorded), UNPACKED)
    result = {"guess": guessed.to_json()}
    try:
        seen = preview_import(
            spec["foreign"],
            pattern=guessed.pattern,
            person=spec["person"] or None,
            limits=UNPACKED,
            most_files=_PREVIEWED,
        )
    except PlushSenseError as refusal:
        return result | {"problem": refusal.message}
    return result | {"preview": seen.to_json() | {"left_out": len(seen.left_out)}}


def _simulate(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Simulate ``people`` persons with ``repetitions`` as the new data set ``dest``; use ``work`` temporarily."""
    work = Path(spec["work"])
    work.mkdir(parents=True, exist_ok=True)
    # The sessions can be temporary, because the data set contains copies of the recordings.
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=work) as place:
        done = simulate(
            Path(place) / "sessions",
            people=int(spec["people"]),
            repetitions=int(spec["repetitions"]),
            seed=int(spec.get("seed", 1)),
            dataset=spec["dest"],
            progress=lambda step, at, total: reporter.progress(what=step, done=at, total=total),
        )
    return {"dataset": str(spec["dest"]), "recordings": done.recordings, "people": done.people}


def _backup(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Write the data set ``dataset`` into the new backup ``place``."""
    return {**asdict(backup(spec["dataset"], spec["place"], progress=reporter.count)), "dataset": spec["dataset"]}


def _restore(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Restore the backup ``file`` as the new data set ``dest`` with the name ``name``."""
    # One of the studio's own backups: only the disk limits it.
    limits = UnpackLimits(max(1, shutil.disk_usage(Path(spec["file"]).parent).free), files=1 << 30)
    readmit = bool(spec.get("readmit"))
    dataset = restore(spec["file"], spec["dest"], progress=reporter.count, limits=limits, readmit=readmit)
    write_file(dataset.path / HEAD, replace(dataset.head, name=spec["name"]).to_toml())
    return {"dataset": str(spec["dest"]), "recordings": len(dataset.recordings), "people": len(dataset.subjects)}


def _save(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Write the ``datasets`` and ``networks`` into the new project ``place``."""
    datasets, networks = (list(map(Path, spec[kind])) for kind in ("datasets", "networks"))
    return asdict(save_project(spec["place"], datasets, networks, reporter.count))


def _open(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Open the project ``file`` in the studio's folder ``home``."""
    done = open_project(spec["file"], spec["home"], reporter.count, readmit=spec["readmit"])
    rejected = [{"file": name, "reason": why} for name, why in done.refused]
    return {"datasets": done.datasets, "networks": done.networks, "rejected": rejected}


def _forget(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Remove what is ``chosen`` of the traces of ``person`` in ``home`` and in the data sets ``given``.

    Raises:
        ConfigError: if ``person`` is missing, as in a job resumed after a restart, because it is never stored.
    """
    if "person" not in spec:
        raise ConfigError("The person's code is not stored. Choose the person again on the home page.")
    given = [Path(path) for path in spec["given"]]
    done = forget_everywhere(Path(spec["home"]), spec["person"], spec["chosen"], given)
    left = len(done.kept) + len(done.failed) + len(done.found.mentions)
    return {"removed": len(done.removed), "left": left, "receipt": done.to_json()}


def _publish(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Publish ``dataset`` as the package ``place``; the other keys are those of `PublishSpec`."""
    key = spec.get("key") or None
    if key is not None:
        try:
            Path(key).parent.mkdir(parents=True, exist_ok=True)
        except OSError as cause:
            file, why = Path(key).name, cause.strerror or str(cause)
            raise DatasetError("The key file “{file}” cannot be written: {why}.", file=file, why=why) from None
    options = {name: value for name, value in spec.items() if name not in ("dataset", "place")}
    options |= {"key": key}
    return publish_dataset(spec["dataset"], spec["place"], PublishSpec(**options), reporter.stage).to_dict()


def _validate(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Validate the package ``place``, a folder or a zip."""
    return validate_package(spec["place"], progress=reporter.stage).to_dict()


def _train(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Train and save a bundle; for a dry run, return only the estimate made by `preview_training`.

    With ``evaluation``, a folder, the settings are those of that evaluation; with ``place``, it is exported.
    """
    stored = spec.get("evaluation")
    config = from_stored(load_evaluation(stored)["config"]) if stored else from_settings(**spec.get("settings", {}))
    if spec.get("dry"):
        from plushsense.workflow.estimate import preview_training

        return preview_training(spec["dataset"], config, warn=reporter.warn).to_json()
    out = Path(spec["out"])
    check_folder(out.parent, "A bundle")
    reporter.progress(stage="reading", share=0.0)
    dataset = open_dataset(spec["dataset"])
    clock, tuning = Clock(), int(spec.get("quantize_aware", 0))
    usual = with_preset(config, network_for(config, dataset.layout)[0])
    epochs, again = usual.training.epochs, refit_epochs(usual, count_people(dataset))
    whole = epochs + tuning + (again + tuning if again else 0)

    def epoch(at: int, of: int, row: EpochRow) -> None:
        what = str(row.get("what", ""))
        second, part = what.startswith(REFIT), what.removeprefix(REFIT).lstrip(", ")
        past = (epochs + tuning if second else 0) + ((again if second else epochs) if part else 0)
        stage = "refitting" if second else "fine-tuning" if part else "training"
        scores = {k: row.get(k) for k in ("train_loss", "train_accuracy", "validation_loss", "accuracy")}
        share = (past + at) / whole
        reporter.progress(stage=stage, epoch=at, epochs=of, **scores, **clock.at(share))
        if at == of and second == (again > 0) and not tuning:
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
    bundle = done.save(free_path(out, done.bundle.to_bytes()))
    exported = _export({"bundle": str(bundle), "place": spec["place"]}, reporter) if spec.get("place") else {}
    return {"bundle": str(bundle), **exported}


def _try(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Wait until ``session`` is complete, and train a network for trying on it, in the folder ``place``."""
    importlib.import_module("plushsense.training.fit")
    place = Path(spec["place"])
    while not (place / READY).exists():
        time.sleep(0.05)
    dataset = import_recordings(Path(spec["session"]).parents[1], place / "trial").dataset
    # Takes have one length, so that many begin and end at rest.
    decide_trims(dataset, TrimDecisions(above=0.0, offset=True, who="trial"))
    config = from_settings(context=ANYWHERE, epochs=_TRIAL_EPOCHS, **_TRIAL_IDLE)

    def epoch(at: int, of: int, row: EpochRow) -> None:
        reporter.progress(share=at / of)

    done = train(place / "trial", config, fit_decisions=False, progress=epoch, warn=reporter.warn)
    return {"bundle": str(done.save(place / "only for trying.plush")), "seconds": done.seconds}


def _make(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Train a network and evaluate it on people left out, in about ``minutes``; see `make_network`."""
    out = Path(spec["out"])
    reporter.progress(stage="reading", share=0.0)

    from plushsense.workflow.budget import BudgetProgress, make_network

    clock = Clock()

    def report(at: BudgetProgress) -> None:
        row = {key: value for key, value in at.row.items() if key != "learning_rate"}
        what = str(row.get("what", ""))
        stage = "refitting" if what.startswith(REFIT) else at.stage
        reporter.progress(**row | {"stage": stage, "bundle": at.bundle}, **clock.at(at.share))

    settings = spec.get("settings")
    done = make_network(
        spec["dataset"],
        out,
        budget_s=60.0 * spec["minutes"],
        config=from_settings(**settings) if settings else None,
        progress=report,
        warn=reporter.warn,
    )
    return {**done.to_json(), "out": str(done.evaluation)}


def _evaluate(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Evaluate; return the output folder, the report and the main scores, or the estimate for a dry run."""
    config = from_settings(**spec.get("settings", {}), split=spec.get("split") or None)
    if spec.get("dry"):
        from plushsense.workflow.estimate import preview_evaluation

        return preview_evaluation(spec["dataset"], config, warn=reporter.warn).to_json()
    reporter.progress(stage="reading", share=0.0)

    from plushsense.workflow.api import FoldsSpec, evaluate_run
    from plushsense.workflow.preparation import prepare
    from plushsense.workflow.reporting import PAGE, write_report

    dataset = open_dataset(spec["dataset"])
    made = prepare(dataset, config, reporter.warn)
    out = dataset.path / "evaluations" / made.name
    clock = Clock()

    def fold(at: JobProgress) -> None:
        row = at.message[2] if at.epoch else {}
        counts = {"done": at.done, "folds": at.total, "resumed": at.resumed, "fold": at.name}
        loss = {"train_loss": row.get("train_loss")}
        reporter.progress(stage="training", epoch=at.epoch, epochs=at.epochs, **counts, **loss, **clock.at(at.share))

    evaluate_run(made, FoldsSpec(out, int8=bool(spec.get("int8"))), progress=fold, warn=reporter.warn)
    write_report(out / PAGE, dataset, [out])
    return {"out": str(out)}


def _sweep(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Run a sweep; return the folder ``out`` and main values of the result, or the preview for a dry run."""
    from plushsense.experiments.sweep.run_sweep import SweepProgress, SweepSpec, preview, sweep

    asked = SweepSpec(spec["grid"], spec.get("changes", {}))
    if spec.get("dry"):
        return preview(spec["dataset"], asked, measure=True, warn=reporter.warn).to_json()
    reporter.progress(stage="reading", share=0.0)
    clock = Clock()

    def training(at: SweepProgress) -> None:
        row = at.best and at.best.row
        best = row and {key: row[key] for key in ("arch", "filters", "accuracy", "macro_f1")}
        counts: dict[str, Any] = {"done": at.done, "trainings": at.total, "resumed": at.resumed, "what": at.name}
        if at.rung:
            counts |= {"rung": at.rung, "rungs": at.rungs, "networks": at.networks}
        share = min(1.0, at.share)
        reporter.progress(stage="training", epoch=at.epoch, epochs=at.epochs, best=best, **counts, **clock.at(share))

    done = sweep(spec["dataset"], asked, progress=training, warn=reporter.warn)
    for lost in done.head["failed"]:
        network = f"{lost['arch']} {lost['filters']}"
        reporter.warn(Message("The network {network} was given up, because its training failed.", network=network))
    halving = done.head.get("halving", {})
    return {"out": str(done.out), "best": done.head["best"], "winner": halving.get("winner", {})}


def _profile(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Profile the exported code in the folder ``spec["place"]``."""
    return {"profile": _profile_of(Path(spec["place"]), reporter)}


def _profile_of(folder: Path, reporter: TaskReporter) -> dict[str, Any]:
    """Return the profile of an export, or the reason ``refused`` why there is none, with a ``digest`` of the files."""
    digest = folder_digest(folder)
    reporter.progress(stage="profile")
    try:
        return {"digest": digest, **profile(folder, progress=partial(reporter.stage, "profile")).to_json()}
    except ToolError as refusal:
        # Not an error: an export without a profile is valid.
        return {"digest": digest, "refused": refusal.message}


def _export(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Export ``bundle`` to ``place``, in the formats ``also`` too; calibrate it again if ``dataset`` is not ""."""
    reporter.progress(stage="export")
    done = export(
        spec["bundle"],
        spec["place"],
        dataset=spec.get("dataset") or None,
        also=spec.get("also", ()),
        warn=reporter.warn,
    )
    return {**done.to_json(), "profile": _profile_of(Path(spec["place"]), reporter)}


_SAMPLES = 100_000
# A few seconds on two cores.
_TRIAL_EPOCHS = 40
# The toy is at rest for two seconds between two takes, and nobody practises. See docs/measurements/live.md.
_TRIAL_IDLE = {"idle_share": 0.45, "busy_share": 0.1}


def _verify(spec: dict[str, Any], reporter: TaskReporter) -> dict[str, Any]:
    """Verify the export ``place`` on ``targets``, by default on all that are available.

    The input is recordings of ``dataset`` if given, else generated data. With ``trust``, also verify a folder with code
    that PlushSense does not write.
    """
    folder = Path(spec["place"])
    digest = folder_digest(folder)
    reporter.progress(stage="vectors")
    export = Export(folder)
    dataset = spec.get("dataset")
    vectors = export.recorded(open_dataset(dataset), [], _SAMPLES) if dataset else export.made_up(0)
    done = verify(
        export,
        spec.get("targets", ()),
        vectors,
        trust=bool(spec.get("trust")),
        progress=partial(reporter.stage, "verify"),
    )
    return {**done.to_json(), "digest": digest}


TASKS: dict[str, Callable[[dict[str, Any], TaskReporter], dict[str, Any]]] = {
    "check": _check,
    "trial": _try,
    "make": _make,
    "train": _train,
    "sweep": _sweep,
    "search": _sweep,
    "evaluate": _evaluate,
    "import": _import,
    "inspect": _inspect,
    "guess": _guess,
    "publish": _publish,
    "export": _export,
    "verify": _verify,
    "simulate": _simulate,
    "profile": _profile,
    "validate": _validate,
    "backup": _backup,
    "restore": _restore,
    "save": _save,
    "open": _open,
    "forget": _forget,
}
"""Functions of the tasks by name. Specs and results contain only JSON values."""


def main() -> int:
    """Run the requested task; return 0 if it succeeded, 1 if it was interrupted, and 2 if it failed."""
    # Libraries may print, but standard output is reserved for messages.
    out, sys.stdout = sys.stdout, sys.stderr
    reporter = TaskReporter(out)
    if warm := sys.argv[1:] == [WARM]:
        with contextlib.suppress(Exception):  # the task says what is wrong
            importlib.import_module("plushsense.training.fit")
        end = threading.Timer(WARM_S, os._exit, (0,))
        end.daemon = True
        end.start()
    line = sys.stdin.readline()
    if warm:
        end.cancel()
        if not line:
            return 0
    threading.Thread(target=_end_with_studio, daemon=True).start()
    try:
        request = json.loads(line)
        reporter.write(result=TASKS[request["task"]](request["spec"], reporter))
    except KeyboardInterrupt:
        return 1
    except PlushSenseError as refusal:
        reporter.write(refused=refusal.message.to_json())
        return 2
    except OSError as cause:
        reporter.write(refused=refusal_of(cause).to_json())
        return 2
    except Exception as cause:  # noqa: BLE001, RUF100
        what = f"{type(cause).__name__}: {cause}"
        message = Message("The work broke off: {what}. What was finished is kept.", what=what)
        reporter.write(refused=message.to_json())
        return 2
    return 0


def _end_with_studio() -> None:
    """Wait until the studio ends, which closes standard input; then end this process."""
    while sys.stdin.read(1):
        pass
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        # This also ends all processes that the task has started.
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
