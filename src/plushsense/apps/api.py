"""The Python face: what the command line does, as calls. A result shows itself in a notebook.

This is where training and evaluation meet; neither knows of the other.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plushsense import __version__
from plushsense.apps.config import ALL, SHARED, RunConfig, resolve
from plushsense.core.errors import BadInput, ConfigError, DatasetError
from plushsense.core.gestures import GestureSet
from plushsense.core.signal import load_layout
from plushsense.dataset.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import Evaluation, FoldOutput, FoldProgress
from plushsense.evaluation.crossval import evaluate as crossvalidate
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.runs.journal import Journal
from plushsense.scoring.metrics import accuracy, confusion, macro_f1
from plushsense.scoring.splits import by_recording, by_subject, holdout, parse_split
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet, WindowSpec, cut_windows, shared_gestures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EpochProgress = Callable[[int, int, dict[str, Any]], None]
Warn = Callable[[str], None]


def _silent(_: str) -> None:
    return None


def choose_classes(dataset: Dataset, wanted: str | Sequence[str], warn: Warn = _silent) -> GestureSet:
    """The classes to tell apart: "shared", "all", or labels (a list, or text with commas)."""
    if wanted == SHARED:
        gestures, left_out = shared_gestures(dataset)
        if left_out:
            reasons = "; ".join(f"{label} ({why})" for label, why in left_out.items())
            warn(f"left out of the shared gestures: {reasons}")
    elif wanted == ALL:
        made = {r.gesture for r in dataset.used}
        gestures = dataset.gestures.subset([g for g in dataset.gestures.labels if g in made])
    else:
        labels = wanted.split(",") if isinstance(wanted, str) else wanted
        gestures = dataset.gestures.subset([label.strip() for label in labels])
    if len(gestures) < 2:
        raise DatasetError(
            f"Only {len(gestures)} gesture is left to tell apart ({', '.join(gestures.labels) or 'none'}): "
            "choose others with --classes all or --classes LABEL,LABEL."
        )
    return gestures


def windows_for(
    dataset: Dataset, arch: Arch, spec: WindowSpec, gestures: GestureSet, warn: Warn = _silent
) -> WindowSet:
    """Windows as ``arch`` needs them: with as much past as a decision sees."""
    span_s = arch.span / dataset.layout.rate_hz
    cut = cut_windows(dataset, replace(spec, span_s=span_s if span_s > spec.window_s else 0.0), gestures)
    for line in cut.left_out:
        warn(f"left out: {line}")
    return cut


@dataclass(frozen=True)
class TrainAndPredict:
    """One training and its predictions: what a cross-validation is given."""

    arch: Arch
    spec: TrainSpec

    def __call__(
        self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: EpochProgress, /
    ) -> FoldOutput:
        from plushsense.training.fit import fit, predict

        fitted = fit(train, validation, self.arch, self.spec, progress)
        probabilities = predict(self.arch, fitted.weights, fitted.scaler, test, self.spec.device)
        return FoldOutput(probabilities, fitted.history, fitted.seconds, fitted.best_epoch)


@dataclass(frozen=True)
class Trained:
    """A trained network: ``bundle``, the ``history`` of its epochs, and ``scores`` with what they were taken on."""

    bundle: Bundle
    history: list[dict[str, Any]]
    scores: dict[str, Any]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Save the bundle."""
        return self.bundle.save(Path(path))

    def figure(self) -> Figure:
        """Loss and accuracy over the epochs."""
        from plushsense.reports.figures import training_curves

        return training_curves([self.history], title=self.bundle.arch.symbol)

    def __repr__(self) -> str:
        return f"Trained({self.bundle!r}; {self.scores['said']})"


def train(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    arch: str | None = None,
    filters: Sequence[int] | str | None = None,
    progress: EpochProgress | None = None,
    warn: Warn = _silent,
    **settings: Any,
) -> Trained:
    """Train one network on a data set.

    Whole people validate (15 % of them, chosen by the seed), and the scores are theirs. Under presets with early
    stopping they also decide when to stop, which flatters a little; ask `evaluate` for a figure over everybody.
    The preset ``search`` splits windows as the paper does (70/15/15), which is leaky, and says so.

    Args:
        config: resolved settings; or give ``arch``, ``filters`` and settings such as ``preset="loso"``,
            ``context="loop"``, ``epochs=20``, ``seed=1``, ``classes="all"``, ``padding``, ``norm``.
        progress: called with (epoch, epochs at most, the epoch's row).
        warn: called with one sentence for everything that was left out.
    """
    dataset = _opened(dataset)
    config = config or _from_settings(arch, filters, settings)
    gestures = choose_classes(dataset, config.evaluation.classes, warn)
    network = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    windows = windows_for(dataset, network, config.windows, gestures, warn)
    split, train_at, validation_at, test_at = _divide(windows, config)
    from plushsense.training.fit import fit, predict

    fitted = fit(windows.take(train_at), windows.take(validation_at), network, config.training, progress)
    held = windows.take(test_at)
    probabilities = predict(network, fitted.weights, fitted.scaler, held, config.training.device)
    counts = confusion(held.y, probabilities.argmax(axis=1), len(gestures))
    scores = {
        **split,
        "windows": len(held),
        "accuracy": accuracy(counts),
        "macro_f1": macro_f1(counts),
        "best_epoch": fitted.best_epoch,
        "simulated": dataset.head.simulated,
    }
    bundle = Bundle(
        arch=network,
        weights=fitted.weights,
        layout=dataset.layout,
        scaler=fitted.scaler,
        gestures=gestures,
        windowing=config.to_dict()["windows"],
        decision=config.live.to_dict(),
        provenance={
            "dataset": dataset.head.name,
            "dataset_hash": dataset.hash,
            "simulated": dataset.head.simulated,
            "subjects": sorted({str(s) for s in windows.take(train_at).subject}),
            "validation_subjects": sorted({str(s) for s in windows.take(validation_at).subject}),
            "split": split["split"],
            "context": _context_said(windows),
            "preset": config.preset,
            "training": config.training.to_dict(),
            "seconds": round(fitted.seconds, 1),
            "scores": scores,
            "code_version": __version__,
        },
    )
    return Trained(bundle, fitted.history, scores)


def _divide(windows: WindowSet, config: RunConfig) -> tuple[dict[str, Any], Any, Any, Any]:
    """What the scores of a single training are taken on, and the windows to train on, to validate on, to score."""
    seed = config.evaluation.seed
    stopped = "" if config.training.patience is None else " but decided when to stop"
    if config.preset == "search":
        fold = holdout(windows.subject, windows.y, seed)[0]
        said = "15 % of the windows, drawn at random: leaky, windows of one recording stand on both sides"
        return {"split": "windows:holdout", "leaky": True, "said": said}, fold.train, fold.validation, fold.test
    people = sorted(set(windows.subject.tolist()) - {"none", "unknown"})
    if len(people) >= 2:
        groups = max(2, min(len(people), round(1 / 0.15)))
        fold = by_subject(windows.subject, groups, seed)[0]
        kind = "validation-subjects"
        said = f"people who were not trained on{stopped}: {', '.join(fold.subjects)}"
    else:
        fold = by_recording(windows.recording.astype(str), windows.y, 6, seed)[0]
        kind = "validation-recordings"
        said = f"recordings that were not trained on{stopped}; of the same people: flattering"
    rest = np.sort(np.concatenate([fold.train, fold.validation]))
    return {"split": kind, "leaky": False, "said": said}, rest, fold.test, fold.test


def evaluate(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    split: str | None = None,
    arch: str | None = None,
    filters: Sequence[int] | str | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[FoldProgress], None] | None = None,
    warn: Warn = _silent,
    **settings: Any,
) -> Evaluation:
    """How well a network does on what it was not trained on: train and score once a fold of ``split``.

    Finished folds are kept in the data set's ``cache`` folder; an evaluation that was stopped goes on from there.

    Args:
        config, arch, filters, settings, warn: as for `train`, and ``train_context``, ``workers``.
        split: "leave-one-subject-out" (default), "by-subject:5", "by-recording:5", "windows:5" (leaky).
        out: a folder for ``evaluation.json`` and ``predictions.parquet``.
    """
    dataset = _opened(dataset)
    config = config or _from_settings(arch, filters, settings)
    if split is not None:
        config = replace(config, evaluation=replace(config.evaluation, split=split))
    parse_split(config.evaluation.split)
    gestures = choose_classes(dataset, config.evaluation.classes, warn)
    network = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    score = windows_for(dataset, network, config.windows, gestures, warn)
    train_context = config.evaluation.train_context
    fit_on = score
    if train_context not in (None, config.windows.context):
        fit_on = windows_for(dataset, network, replace(config.windows, context=str(train_context)), gestures)
    result = crossvalidate(
        fit_on,
        score,
        config.evaluation.split,
        TrainAndPredict(network, config.training),
        journal=Journal(dataset.path / "cache" / "folds"),
        key={"arch": network.to_dict(), "training": config.training.to_dict()},
        workers=config.evaluation.processes,
        seed=config.evaluation.seed,
        progress=progress,
    )
    if out is not None:
        save_evaluation(result, dataset, config, network, Path(out))
    return result


def save_evaluation(result: Evaluation, dataset: Dataset, config: RunConfig, arch: Arch, out: Path) -> Path:
    """Write ``predictions.parquet`` and ``evaluation.json`` (scores, data set, network, settings) to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    result.write_predictions(out / "predictions.parquet")
    content = {
        **result.to_dict(),
        "predictions": "predictions.parquet",
        "validation_decides": config.training.patience is not None,
        "title": evaluation_title(result, arch),
        "model": card(arch, dataset.layout.rate_hz),
        "dataset": dataset.summary(),
        "config": config.to_dict(),
        "code_version": __version__,
    }
    path = out / "evaluation.json"
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(content, ensure_ascii=False, indent=1), encoding="utf-8")
    os.replace(part, path)
    return path


def evaluation_title(result: Evaluation, arch: Arch) -> str:
    """A line that tells one evaluation from another."""
    filters = "/".join(map(str, arch.filters))
    context = f"{result.context} context"
    if result.train_context != result.context:
        context += f", trained on {result.train_context}"
    return f"{arch.symbol} {filters} {arch.padding}, {context}"


def card(arch: Arch, rate_hz: float, **more: Any) -> dict[str, Any]:
    """The counts of a network, as a model card shows them."""
    return {
        **arch.to_dict(),
        "parameters": arch.parameters,
        "receptive_field": arch.receptive_field,
        "span": arch.span,
        "macs_per_window": arch.macs_per_window,
        "macs_per_step": arch.macs_per_step,
        "state_bytes_int8": arch.state_bytes_int8,
        "rate_hz": rate_hz,
        **more,
    }


def write_report(
    path: str | os.PathLike[str],
    dataset: Dataset | str | os.PathLike[str],
    evaluations: Sequence[Evaluation | Mapping[str, Any] | str | os.PathLike[str]] = (),
    models: Sequence[Bundle | str | os.PathLike[str]] = (),
    title: str | None = None,
) -> Path:
    """One self-contained HTML page: data set, protocol in words, scores, confusions, curves, model cards.

    Args:
        evaluations: results of `evaluate`, or folders (or files) where they were saved.
        models: bundles, or their paths.
    """
    from plushsense.reports.html import write_report as write_html

    dataset = _opened(dataset)
    summary = dataset.summary()
    bundles = [b if isinstance(b, Bundle) else Bundle.load(Path(b)) for b in models]
    cards = [
        card(
            b.arch,
            b.layout.rate_hz,
            name=str(b.provenance.get("name", f"{b.arch.symbol} trained on {b.provenance.get('dataset', '?')}")),
            provenance=dict(b.provenance),
        )
        for b in bundles
    ]
    shown = {
        "name": summary["name"],
        "layout": dataset.layout.title,
        "subjects": summary["subjects"],
        "recordings": summary["recordings"],
        "gestures": [f"{g['label']} ({g['recordings']})" for g in summary["gestures"]],
        "streams": summary["streams"],
        "recordings located in a stream": summary["located_in_stream"],
        "warnings": summary["with_warnings"],
        "excluded": summary["excluded"],
        "licence": summary["licence"],
        "hash": summary["hash"],
    }
    return write_html(
        Path(path),
        title=title or f"PlushSense: {summary['name']}",
        dataset=shown,
        evaluations=[_evaluation_table(e) for e in evaluations],
        models=cards,
        simulated=bool(summary["simulated"]) or any(b.provenance.get("simulated") for b in bundles),
    )


def _evaluation_table(given: Evaluation | Mapping[str, Any] | str | os.PathLike[str]) -> dict[str, Any]:
    if isinstance(given, Evaluation):
        return given.to_dict()
    if isinstance(given, Mapping):
        table = dict(given)
    else:
        path = Path(given)
        path = path / "evaluation.json" if path.is_dir() else path
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise BadInput(
                f"There is no evaluation at '{path}': make one with  plushsense evaluate ... --out DIR"
            ) from None
        except (OSError, ValueError) as cause:
            raise BadInput(
                f"'{path}' is not an evaluation ({cause}): give a folder that evaluate --out wrote."
            ) from None
    # The page has its own words for the network; the counts stand on the model card.
    table.pop("model", None)
    return table


def load(path: str | os.PathLike[str]) -> Bundle:
    """Load a model bundle (``*.plush``)."""
    return Bundle.load(Path(path))


def simulate(
    out: str | os.PathLike[str],
    *,
    people: int = 25,
    repetitions: int = 3,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Recordings of virtual people, as the authors' recorder would leave them; the paper's shape by default."""
    from plushsense.recording.simulate import simulate as run

    told = (lambda done, total, _: progress(done, total)) if progress is not None else None
    return dict(run(Path(out), people=people, repetitions=repetitions, seed=seed, progress=told).to_dict())


def simulated_dataset(
    dest: Path, raw: Path, *, people: int, repetitions: int, seed: int, progress: Callable[[str, int, int], None]
) -> Dataset:
    """A data set of virtual people, made as a real one would be: recorded, then imported. Kept when it is there."""
    if (dest / "dataset.toml").is_file():
        return open_dataset(dest)
    if not raw.exists():
        simulate(
            raw, people=people, repetitions=repetitions, seed=seed, progress=lambda a, b: progress("recording", a, b)
        )
    return import_recordings(
        raw,
        dest,
        layout=load_layout("plush-15"),
        name="virtual toy",
        licence="MIT",
        consent="nobody: a simulation",
        simulated=True,
        progress=lambda a, b: progress("importing", a, b),
    ).dataset


def _opened(dataset: Dataset | str | os.PathLike[str]) -> Dataset:
    return dataset if isinstance(dataset, Dataset) else open_dataset(Path(dataset))


def _context_said(windows: WindowSet) -> dict[str, int]:
    kinds, counts = np.unique(windows.context, return_counts=True)
    return {str(kind): int(n) for kind, n in zip(kinds, counts, strict=True)}


# Where each setting of `train` and `evaluate` belongs.
_SETTINGS: dict[str, tuple[str, ...]] = {
    "windows": ("context", "window_s", "step_s", "longest_factor"),
    "model": ("padding", "norm", "pool_s"),
    "training": ("preset", "epochs", "batch", "learning_rate", "halve_every", "patience", "device", "turn_deg"),
    "evaluation": ("classes", "train_context", "workers"),
    "live": ("smoothing_s",),
}


def _from_settings(arch: str | None, filters: Sequence[int] | str | None, settings: Mapping[str, Any]) -> RunConfig:
    known = [key for keys in _SETTINGS.values() for key in keys] + ["seed"]
    for key in settings:
        if key not in known:
            from plushsense.core.errors import nearest

            raise ConfigError(f"Unknown setting '{key}': accepted are {', '.join(known)}.{nearest(key, known)}")
    tables: dict[str, dict[str, Any]] = {
        table: {key: settings[key] for key in keys if key in settings} for table, keys in _SETTINGS.items()
    }
    tables["model"] |= {"arch": arch, "filters": filters}
    tables["training"]["seed"] = tables["evaluation"]["seed"] = settings.get("seed")
    return resolve(None, **tables)
