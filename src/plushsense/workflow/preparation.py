"""Choose the gestures and cut the windows that a network is trained on."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.gestures import NOBODY, GestureSet, merge_names
from plushsense.core.layouts import Layout
from plushsense.core.sentences import Message
from plushsense.dataset.index import as_dataset
from plushsense.dataset.quality.outliers import far_inputs
from plushsense.dataset.statistics import fitting_window_s, median_gesture_s
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset, RecordingInfo
from plushsense.deploy.quantize import refuse_undeployable
from plushsense.evaluation.crossval import fold_windows
from plushsense.jobs.journal import job_id
from plushsense.models.arch import (
    DEFAULT_FILTERS,
    DEFAULT_SYMBOL,
    VECTOR_FILTERS,
    VECTOR_SYMBOL,
    Arch,
    default_pooling,
    parse_symbol,
    symbol_at_rate,
    symbol_within,
)
from plushsense.reports.table import text
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.splits import VALIDATION_SHARE, Fold, Split, parse_split
from plushsense.training.spec import ANYWHERE_EPOCHS, PADDING, PRESETS, VECTOR_TRAINING, TrainSpec, preset_for
from plushsense.windows.anywhere import AnywhereSpec, add_idle_gesture, cut_anywhere
from plushsense.windows.cut import (
    ANYWHERE,
    ROWS,
    WindowSet,
    WindowSpec,
    constant_windows,
    cut_windows,
    shared_gestures,
)
from plushsense.workflow.config import ALL, SHARED, EvaluationSpec, ModelSpec, RunConfig

Warn = Callable[[str], None]


def silent(_: str) -> None:
    """Ignore a warning."""


@dataclass(frozen=True)
class Run:
    """Everything that a training or an evaluation needs, resolved once by `prepare`.

    Attributes:
        dataset: the data set as the network reads it: with its inputs and, if the classes are merged gestures, these.
        gestures: the classes.
        network: the network for the inputs and the number of classes.
        model: the settings of ``network``, with symbol, filters, padding and pooling.
        training: the settings of the training, with the augmentations.
        windows: the settings of the windows (see `trained_on` and `scored_on`).
        evaluation: its ``classes`` are labels if merged gestures were given.
    """

    dataset: Dataset
    gestures: GestureSet
    network: Arch
    preset: str
    windows: WindowSpec
    model: ModelSpec
    training: TrainSpec
    evaluation: EvaluationSpec
    live: DecideSpec
    anywhere: AnywhereSpec

    @property
    def split(self) -> Split:
        """The split of the evaluation."""
        return parse_split(self.evaluation.split)

    @property
    def trained_on(self) -> WindowSpec:
        """Settings of the training windows."""
        return replace(self.windows, context=self.evaluation.train_context or self.windows.context)

    @property
    def scored_on(self) -> WindowSpec:
        """Settings of the scored windows; the context "stream" (gestures with their real past) replaces "anywhere"."""
        return replace(self.windows, context="stream") if self.windows.context == ANYWHERE else self.windows

    @property
    def holds_back(self) -> bool:
        """Whether an evaluation holds people back for validation: not if nothing depends on them."""
        return self.training.patience is not None or not self.split.separates_people

    def training_windows(self, warn: Warn = silent) -> WindowSet:
        """Cut the windows to train on (see `windows_for`)."""
        return windows_for(self.dataset, self.network, self.trained_on, self.gestures, warn, self.anywhere)

    def scored_windows(self, warn: Warn = silent) -> WindowSet:
        """Cut the windows to score (see `windows_for`)."""
        return windows_for(self.dataset, self.network, self.scored_on, self.gestures, warn)

    def to_json(self) -> dict[str, object]:
        """Return all settings as plain values for JSON."""
        names = ("windows", "model", "training", "evaluation", "live", "anywhere")
        tables = {name: asdict(getattr(self, name)) for name in names}
        return {"preset": self.preset, **tables, "model": self.model.to_dict(), "training": self.training.to_dict()}

    def outcome(self) -> dict[str, dict[str, object]]:
        """Return the settings that an evaluation's scores depend on, as plain values for JSON."""
        evaluation = asdict(self.evaluation) | {"train_context": self.trained_on.context}
        del evaluation["workers"]
        anywhere = {"anywhere": asdict(self.anywhere)} if self.trained_on.context == ANYWHERE else {}
        return {
            **anywhere,
            "windows": asdict(self.windows),
            "model": self.model.to_dict(),
            "training": _outcome_of(self.training),
            "evaluation": evaluation,
        }

    @property
    def changes(self) -> str:
        """The settings of windows, network and training that differ from the preset's for this network, as a text.

        The symbol of the network, its filters and padding, the context and the seed are left out.
        """
        has_vectors, own = self.network.vector is not None, self.outcome()
        own["model"] = {**own["model"], "pooling": self.network.pooling}
        training = _usual(self.preset, self.trained_on.context, has_vectors)
        usual = {
            "windows": asdict(WindowSpec()),
            "model": asdict(ModelSpec(pooling=default_pooling(self.network))),
            "training": _outcome_of(training),
        }
        apart = ("arch", "filters", "padding", "seed", "context")
        return ", ".join(
            f"{key} {text(value)}"
            for table, values in usual.items()
            for key, value in own[table].items()
            if value != values.get(key) and key not in apart
        )

    @property
    def id(self) -> str:
        """Identifier of 20 hexadecimal digits of an evaluation, equal for equal settings and data."""
        return job_id({"settings": self.outcome(), "data": self.dataset.hash})

    @property
    def name(self) -> str:
        """Name of a folder for the evaluation: the main settings and the start of `id`."""
        evaluation, model = self.evaluation, self.model
        context = self.windows.context
        if evaluation.train_context not in (None, context):
            context = f"{evaluation.train_context}-to-{context}"
        filters = "-".join(map(str, model.filters or ()))
        parts = (evaluation.split.replace(":", "-"), str(model.arch), filters, str(model.padding), model.norm, context)
        words = "_".join(parts) + f"_{self.preset}_e{self.training.epochs}_seed{self.training.seed}"
        return f"{words[:180]}_{self.id[:8]}"


def _outcome_of(training: TrainSpec) -> dict[str, Any]:
    return {key: value for key, value in training.key().items() if key not in ("device", "threads")}


def _usual(name: str, context: str, has_vectors: bool) -> TrainSpec:
    """Return a preset as it trains a network, with a vector layer or without, on windows of a context."""
    usual = preset_for(name, has_vectors)
    if not has_vectors or context != ANYWHERE:
        return usual
    return replace(usual.with_epochs(ANYWHERE_EPOCHS.get(name, usual.epochs)), stride=PRESETS[name].stride)


def with_preset(config: RunConfig, symbol: str) -> RunConfig:
    """Return the settings with those of the preset for the network of a symbol, as far as they were not given.

    Values that differ from the preset's were given, too.
    """
    has_vectors = parse_symbol(symbol).vector is not None
    context = config.evaluation.train_context or config.windows.context
    usual = _usual(config.preset, context, has_vectors)
    keys, plain = (*VECTOR_TRAINING, "epochs", "halve_every"), PRESETS[config.preset]
    given = config.given | {key for key in keys if getattr(config.training, key) != getattr(plain, key)}
    # The learning rate falls with the epochs.
    given |= {"halve_every"} if "epochs" in given else set()
    changes = {key: getattr(usual, key) for key in keys if key not in given}
    return replace(config, training=replace(config.training, **changes))


def network_for(config: RunConfig, layout: Layout) -> tuple[str, tuple[int, ...], str]:
    """Return symbol, filters and padding of the network for a layout: those of ``config``, or the defaults.

    With the preset ``people`` and a layout of vectors alone, one of them an acceleration, the default network has a
    vector layer. Beside other sensors it was no better (on the virtual toy; no real recordings were at hand). Kernels
    of default networks are scaled below 67 and above 150 Hz, so that they last as long.
    """
    padding = config.model.padding or PADDING[config.preset]
    axes = {axis for vector in layout.vectors for axis in vector}
    turns = layout.has_gravity and set(layout.inputs) <= axes
    default = VECTOR_SYMBOL if turns and config.preset == "people" and padding == "stream" else DEFAULT_SYMBOL
    symbol = config.model.arch or symbol_at_rate(default, layout.rate_hz)
    usual = DEFAULT_FILTERS if parse_symbol(symbol).vector is None else VECTOR_FILTERS
    return symbol, config.model.filters or usual, padding


def prepare(dataset: Dataset | str | os.PathLike[str], config: RunConfig, warn: Warn = silent) -> Run:
    """Choose the classes and the network for a data set, and all settings that depend on them.

    With context "anywhere", there is a class for idleness.

    Raises:
        ArchError, DatasetError: for an invalid network, or fewer than two gestures.
    """
    dataset, classes = named_classes(as_dataset(dataset), config.evaluation.classes)
    symbol, filters, padding = network_for(config, dataset.layout)
    has_vectors = parse_symbol(symbol).vector is not None
    if has_vectors:
        dataset = dataset.with_inputs(dataset.layout.for_vectors())
    layout, model = dataset.layout, config.model
    gestures = classes_for(dataset, classes, config.evaluation.train_context or config.windows.context, warn)
    network = Arch.parse(
        symbol,
        filters,
        channels=layout.n_inputs,
        classes=len(gestures),
        padding=padding,
        norm=model.norm,
        window=layout.samples(config.windows.window_s),
        step=layout.samples(model.step_s),
        pool=None if model.pool_s is None else layout.samples(model.pool_s),
        vectors=len(layout.vectors),
        pooling=model.pooling,
    )
    return Run(
        dataset,
        gestures,
        network,
        config.preset,
        config.windows,
        replace(model, arch=symbol, filters=filters, padding=padding, pooling=network.pooling),
        with_preset(config, symbol).training,
        replace(config.evaluation, classes=classes),
        config.live,
        config.anywhere,
    )


def require_people_left_out(run: Run, option: str) -> None:
    """Raise ConfigError if the split of a run does not leave people out, which ``option`` needs."""
    if not run.split.separates_people:
        raise ConfigError(
            "{option} needs a split that leaves people out, and '{split}' does not: use leave-one-subject-out or "
            "by-subject:K.",
            option=option,
            split=run.split.text,
        )


def named_classes(dataset: Dataset, choice: str | Sequence[str]) -> tuple[Dataset, str | tuple[str, ...]]:
    """Return the data set and the classes; for merged gestures (`GestureSet.merged_by`), the data set has these.

    Of merged gestures, the classes are those that were recorded.
    """
    if not isinstance(choice, str):
        return dataset, tuple(choice)
    if choice not in merge_names() and not choice.endswith(".toml"):
        return dataset, choice
    gestures = dataset.gestures.merged_by(choice)
    dataset = dataset.with_gestures(gestures)
    recorded = {r.gesture for r in dataset.used}
    return dataset, tuple(label for label in gestures.labels if label in recorded)


def choose_classes(dataset: Dataset, choice: str | Sequence[str], warn: Warn = silent) -> GestureSet:
    """Return the gestures to classify: "shared", "all", or labels (a list, or text with commas)."""
    if choice == SHARED:
        gestures, left_out = shared_gestures(dataset)
        if left_out:
            reasons = "; ".join(f"{label} ({why})" for label, why in left_out.items())
            warn(Message("left out of the shared gestures: {reasons}", reasons=reasons, gestures=list(left_out)))
    elif choice == ALL:
        recorded = {r.gesture for r in dataset.used}
        gestures = dataset.gestures.subset([g for g in dataset.gestures.labels if g in recorded])
    else:
        labels = choice.split(",") if isinstance(choice, str) else choice
        gestures = dataset.gestures.subset([label.strip() for label in labels])
    if len(gestures) < 2:
        raise DatasetError(
            "At least 2 gestures are needed, not {n} ({labels}): choose others with --classes all or --classes "
            "LABEL,LABEL.",
            n=len(gestures),
            labels=", ".join(gestures.labels) or "none",
        )
    return gestures


def classes_for(dataset: Dataset, choice: str | Sequence[str], context: str, warn: Warn = silent) -> GestureSet:
    """Return the chosen gestures, and with context "anywhere" one for idleness."""
    gestures = choose_classes(dataset, choice, warn)
    if context != ANYWHERE:
        return gestures
    with_idle = add_idle_gesture(gestures, dataset)
    if added := [g.label for g in with_idle.gestures if g not in gestures.gestures]:
        warn(Message("added a class for what happens between gestures: {added}", added=added[0], gesture=added[:1]))
    return with_idle


def windows_for(
    dataset: Dataset,
    arch: Arch,
    spec: WindowSpec,
    gestures: GestureSet,
    warn: Warn = silent,
    anywhere: AnywhereSpec | None = None,
) -> WindowSet:
    """Cut windows for a network, which are as long as the span that its decisions depend on.

    ``warn`` gets a sentence if that is longer than most recordings, and for everything that is left out.
    """
    warn_of_long_windows(dataset, arch, spec, gestures, warn)
    span_s = arch.span / dataset.layout.rate_hz
    spec = replace(spec, span_s=span_s if span_s > spec.window_s else 0.0)
    if spec.context == ANYWHERE:
        warn_of_untrimmed(dataset, gestures, warn)
        cut = cut_anywhere(dataset, spec, gestures, anywhere)
    else:
        cut = cut_windows(dataset, spec, gestures)
    for line in cut.left_out:
        warn(Message("left out: {line}", line=line))
    warn_of_far_readings(cut, warn)
    # Cells that nothing touches are constant without a fault.
    if not any(c.is_discrete for c in dataset.layout.channels) and (note := constant_windows(cut)) is not None:
        warn(note)
    return cut


def warn_of_far_readings(windows: WindowSet, warn: Warn) -> None:
    """Warn of each input whose scale is set by a few readings far from all others."""
    for at, far in far_inputs(windows.integers).items() if warn is not silent else ():
        name, n, percent = windows.inputs[at], int(far.sum()), 100 * float(far.mean())
        people = ", ".join(sorted(set(windows.subject[far.any(axis=1)].tolist())))
        warn(
            Message(
                "the scale of {channel} is set by {n} samples ({percent:.2g} %, of {people}) far from all others, so "
                "that everything else looks alike in it: if these readings failed, exclude their recordings, or give "
                "the layout a valid_min and valid_max without them",
                channel=name,
                n=n,
                percent=percent,
                people=people,
            )
        )


def warn_of_untrimmed(dataset: Dataset, gestures: GestureSet, warn: Warn) -> None:
    """Warn if most recordings of gestures in streams begin where they were started, not where the gesture begins."""
    active = [g.label for g in gestures.gestures if not g.idle]
    located = [r for r in dataset.used if r.gesture in active and r.stream_row >= 0]
    untrimmed = [r for r in located if not r.start]
    if not dataset.layout.is_labelled and 2 * len(untrimmed) > len(located):
        warn(
            Message(
                "Without those at rest, {n} of {of} recordings are not trimmed, so the network learns the time "
                "before a gesture as the gesture and reports it too early and too often: run "
                "'plushsense trim {path} --accept-above 0.5' first",
                n=len(untrimmed),
                of=len(located),
                path=dataset.path.name,
            )
        )


def warn_of_single_people(windows: WindowSet, warn: Warn) -> None:
    """Warn of each gesture that only one person made: without that person, there is nothing to learn it from."""
    for index, label in enumerate(windows.labels):
        people = set(windows.subject[windows.y == index].tolist())
        if len(people) == 1 and not people & {NOBODY, UNKNOWN_SUBJECT}:
            person = people.pop()
            warn(
                Message(
                    "only {person} made '{label}', so it cannot be learnt when that person is left out: leave it out "
                    "with --classes, or record it with more people",
                    person=person,
                    label=label,
                    gesture=[label],
                )
            )


def warn_of_files_twice(dataset: Dataset, gestures: GestureSet, warn: Warn) -> None:
    """Warn of recordings with the same file content, which teach two gestures, or score a person on another's."""
    same: dict[tuple[str, int, int], list[RecordingInfo]] = {}
    for recording in dataset.used:
        if recording.gesture in gestures.labels:
            same.setdefault((recording.sha256, recording.first_row, recording.rows), []).append(recording)
    pairs = [(first, other) for first, *others in same.values() for other in others]
    pairs.sort(key=lambda pair: pair[0].gesture == pair[1].gesture)
    for first, other in pairs[:1]:
        alike = first.gesture == other.gesture
        warn(
            Message(
                "the same file is in the data set {known}: {first} and {second}; exclude one of them",
                known=f"twice as '{first.gesture}'" if alike else "as two gestures",
                first=first.id,
                second=other.id,
            )
        )
    if len(pairs) > 1:
        warn(
            Message(
                "{n} more recordings have the same file as another one: plushsense check names them, and "
                '--exclude duplicate: --why "..." leaves them out',
                n=len(pairs) - 1,
            )
        )


_LOOPED_WINDOWS = (
    "a decision reads {reads:.1f} s (kernels {kernels:.1f} s, window {window:g} s), but half of the recordings last "
    "less than {usual:.1f} s, so most windows repeat their gesture: try {advice}"
)
_LONG_WINDOWS = (
    "a decision reads {reads:.1f} s (kernels {kernels:.1f} s, window {window:g} s), but half of the recordings last "
    "less than {usual:.1f} s, so most windows begin before their gesture: try {advice}"
)


def warn_of_long_windows(
    dataset: Dataset, arch: Arch, spec: WindowSpec, gestures: GestureSet, warn: Warn = silent
) -> None:
    """Warn if the window, or what the kernels read, is longer than half of the recordings of the gestures.

    Whoever follows the advice gets no other one.
    """
    usual_s = median_gesture_s(dataset, gestures.labels)
    layout, window_s = dataset.layout, spec.window_s
    field_s = arch.receptive_field / layout.rate_hz
    if usual_s is None:
        return
    shorter_s, advice = fitting_window_s(usual_s), []
    if field_s > usual_s:
        advice.append(f"--arch {symbol_within(arch.symbol, max(1, layout.samples(min(window_s, usual_s)) // 2))}")
    if window_s > max(usual_s, shorter_s):
        then = replace(arch, window=layout.samples(shorter_s), pool=None)
        still = f" (a decision then reads {then.span / layout.rate_hz:.1f} s)" if then.span > then.window else ""
        advice.append(f"--window-s {shorter_s:g}{still}")
    if not advice:
        return
    looped = spec.context in ("loop", ROWS)
    template = _LOOPED_WINDOWS if looped else _LONG_WINDOWS
    reads_s = max(window_s, arch.span / layout.rate_hz, field_s)
    values = {"reads": float(reads_s), "kernels": field_s, "window": window_s, "usual": float(usual_s)}
    warn(Message(template, **values, advice=" and ".join(advice)))


def outside_streams(windows: WindowSet, dataset: Dataset, people: Collection[str]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the windows that lie in no stream of ``people``.

    Recordings at rest belong to `NOBODY` and are used for training in every fold, but may lie in a person's stream.
    Streams that are scored as a whole must not contribute any training window.
    """
    theirs = [s.id for s in dataset.streams if s.subject in people]
    return ~np.isin(windows.stream, np.array(theirs, dtype=np.str_))


WHOLE_PEOPLE = "validation-subjects"
_FEWEST_APART = 3  # people; with fewer, recordings are held out for validation


def count_people(dataset: Dataset) -> int:
    """Return the number of people with a recording that is not excluded."""
    return len({r.subject for r in dataset.used} - {NOBODY, UNKNOWN_SUBJECT})


def refit_epochs(config: RunConfig | Run, people: int) -> int:
    """Return for how many epochs `api.train` trains further on everybody; 0 if it does not.

    It does where whole people are held out for nothing else: with early stopping, they determine when to stop.
    """
    spec = config.training
    apart = people >= _FEWEST_APART and spec.patience is None and config.preset != "search"
    return spec.continued().epochs if apart else 0


@dataclass(frozen=True)
class PreparedTraining:
    """All that a single training starts from: the run, the windows, and which of them are held out for validation.

    Attributes:
        windows: windows to train on, at the indices ``train``.
        scored: windows of the same recordings, perhaps cut with other settings; those of validation are at the indices
            ``validation``, and at ``fold.test`` those that the network is scored on.
        kind: `WHOLE_PEOPLE`, "validation-recordings" or the name of the leaky split; ``description`` as a sentence.
        refit: whether the network is trained further on everybody after it was scored.
    """

    run: Run
    windows: WindowSet
    scored: WindowSet
    split: Split
    kind: str
    description: str
    fold: Fold
    train: NDArray[np.int64]
    validation: NDArray[np.int64]
    refit: bool


def prepare_training(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, warn: Warn = silent, *, deployable: bool = False
) -> PreparedTraining:
    """Choose the gestures and the network, cut the windows and divide them; a ``train_context`` is ignored.

    People are held out for validation; with fewer than three, recordings; with the preset ``search``, windows, which is
    leaky. Otherwise no scored recording is trained on.

    Args:
        deployable: refuse a network that cannot run in 8 bits.
    """
    run = prepare(dataset, replace(config, evaluation=replace(config.evaluation, train_context=None)), warn)
    if deployable:
        refuse_undeployable(run.network)
    warn_of_files_twice(run.dataset, run.gestures, warn)
    windows = scored = run.training_windows(warn)
    if run.scored_on != run.trained_on:
        scored = run.scored_windows()
    people = set(windows.subject.tolist()) - {NOBODY, UNKNOWN_SUBJECT}
    refit = refit_epochs(run, len(people)) > 0
    stops = "" if run.training.patience is None else " but decided when to stop"
    groups = round(1 / VALIDATION_SHARE)
    if run.preset == "search":
        split = parse_split("windows:holdout")
        kind = split.text
        description = "15 % of the windows, drawn at random: leaky, windows of one recording are on both sides"
    elif len(people) >= _FEWEST_APART:
        split = parse_split(f"by-subject:{min(len(people), groups)}")
        kind, description = WHOLE_PEOPLE, f"people who were not trained on{stops}: "
        if refit:
            description = "people who were held back from the first part of the training: "
    else:
        split = parse_split(f"by-recording:{max(2, min(len(np.unique(windows.recording)) // 2, groups))}")
        kind = "validation-recordings"
        description = f"recordings that were not trained on{stops}; of people who were, so the scores are too high"
    fold = fold_windows(windows, scored, split, run.evaluation.seed)[0]
    train, validation = fold.train, fold.validation
    if run.preset != "search":
        train, validation = np.sort(np.concatenate([train, validation])), fold.test
    if split.separates_people:
        description += ", ".join(fold.subjects)
    return PreparedTraining(run, windows, scored, split, kind, description, fold, train, validation, refit)
