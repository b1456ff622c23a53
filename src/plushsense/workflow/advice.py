"""Collect what is advised for a data set and not used, and measure by evaluations what it would bring.

There are up to three kinds of advice: a window that fits the gestures, settings of the layout that fit the recordings
(both of `plushsense.dataset.importing.proposals`), and to leave out the recordings that `check` marks.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from plushsense.core.errors import BadInput, ConfigError, DatasetError
from plushsense.core.sentences import Message, plural
from plushsense.core.version import __version__
from plushsense.dataset.importing.proposals import BY_LAYOUT, WINDOW, Proposal, adopt, propose_settings
from plushsense.dataset.index import as_dataset
from plushsense.dataset.marks import read_marks
from plushsense.dataset.quality.checking import check
from plushsense.dataset.store import Dataset, Progress
from plushsense.evaluation.crossval import EvaluationResult
from plushsense.evaluation.scores import votes_by_person
from plushsense.jobs.journal import Journal, job_id, keep_if_possible
from plushsense.jobs.progress import JobProgress
from plushsense.scoring.comparison import compare_pairs
from plushsense.workflow.api import FoldsSpec, evaluate_run
from plushsense.workflow.config import ALL, SHARED, RunConfig
from plushsense.workflow.preparation import Warn, choose_classes, prepare, silent
from plushsense.workflow.reporting import journal_of

RECORDINGS, LAYOUT = "recordings", "layout"


@dataclass(frozen=True)
class AdviceGain:
    """Gain from following a piece of advice: the accuracy with it minus that without it, averaged over people.

    The accuracy is that of the votes by recording, over the recordings that both evaluations score. ``ci95`` is over
    ``people``, ``p`` of a paired permutation test; ``split``, ``epochs`` and ``seed`` are those of both evaluations.
    """

    accuracy: float
    ci95: tuple[float, float]
    p: float
    people: int
    split: str
    epochs: int
    seed: int

    @property
    def text(self) -> str:
        """The gain in words."""
        low, high = self.ci95
        return (
            f"accuracy by recording {self.accuracy:+.3f}, 95 % interval over {self.people} people {low:+.3f} to "
            f"{high:+.3f}, p = {self.p:.2g}; {self.split}, epochs {self.epochs}, seed {self.seed}"
        )


@dataclass(frozen=True)
class Advice:
    """Advice that is not used.

    Attributes:
        kind: `WINDOW`, `LAYOUT` or `RECORDINGS`.
        text: the reason, and the command that follows the advice.
        settings: proposed settings, as pairs of key and value.
        recordings: ids of the recordings to leave out.
        gain: what it brings; None if that was not measured.
    """

    kind: str
    text: str
    settings: tuple[tuple[str, Any], ...] = ()
    recordings: tuple[str, ...] = ()
    gain: AdviceGain | None = None

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Advice:
        """Return the advice that `to_json` stored."""
        gain = stored["gain"] and AdviceGain(**{**stored["gain"], "ci95": tuple(stored["gain"]["ci95"])})
        settings = tuple((key, value) for key, value in stored["settings"])
        return cls(stored["kind"], stored["text"], settings, tuple(stored["recordings"]), gain)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)

    def follow(self, dataset: Dataset, config: RunConfig) -> tuple[Dataset, RunConfig]:
        """Return data set and settings as the advice has them; no file is changed."""
        if self.kind == RECORDINGS:
            return dataset.without(self.recordings), config
        if self.kind == WINDOW:
            return dataset, replace(config, windows=replace(config.windows, window_s=dict(self.settings)[WINDOW]))
        proposals = [Proposal(key, value, "") for key, value in self.settings]
        return dataset.with_inputs(adopt(dataset.layout, proposals)), config


@dataclass(frozen=True)
class _StoredAdvice:
    """The advice on a data set in its cache; another one as soon as the data or the decisions about them change."""

    journal: Journal
    job: str

    @classmethod
    def of(cls, dataset: Dataset) -> _StoredAdvice:
        accepted = sorted((about, *sorted(mark.accepted)) for about, mark in read_marks(dataset.path).items())
        job = job_id({"version": __version__, "data": dataset.hash, "accepted": accepted, "format": 2})
        return cls(journal_of(dataset, "advice"), job)

    def find(self) -> list[Advice] | None:
        stored = self.journal.find(self.job)
        return None if stored is None else [Advice.from_json(each) for each in stored["advice"]]

    def save(self, advice: list[Advice]) -> None:
        keep_if_possible(self.journal, self.job, {"advice": [each.to_json() for each in advice]})


def unused_advice(
    dataset: Dataset | str | os.PathLike[str], window_s: float, progress: Progress | None = None
) -> list[Advice]:
    """Return what the import and `check` advise but the data set, or a run with windows of ``window_s``, does not use.

    The checks read every file, so that the result is stored in the cache of the data set.
    """
    dataset = as_dataset(dataset)
    store = _StoredAdvice.of(dataset)
    advice = store.find()
    if advice is None:
        advice = list(_advice(dataset, progress))
        store.save(advice)
    return [each for each in advice if each.kind != WINDOW or dict(each.settings)[WINDOW] < window_s]


def _advice(dataset: Dataset, progress: Progress | None) -> Iterator[Advice]:
    """Yield the advice on a data set, without gains."""
    proposals = propose_settings(dataset)
    for p in proposals:
        if p.key == WINDOW:
            yield Advice(WINDOW, f"{p.reason}: {p.advice}", ((p.key, p.value),))
    if of_layout := [p for p in proposals if p.key != WINDOW]:
        reasons = "; ".join(dict.fromkeys(p.reason for p in of_layout))
        how = BY_LAYOUT.format(settings=", ".join(p.setting for p in of_layout))
        yield Advice(LAYOUT, f"{reasons}: {how}", tuple((p.key, p.value) for p in of_layout))
    findings = check(dataset, progress=progress)
    names = Counter(f.check for f in findings.undecided if f.recording)
    if names:
        # The command excludes every recording with a finding of these checks, also with those that are no errors.
        marked = {f.recording for name in names for f in findings.findings_of(name) if f.recording and not f.accepted}
        options = " ".join(f"--exclude {name}:" for name in names)
        count = plural(len(marked), "recording")
        text = f'check marks {count}: to leave them out, try  check {dataset.path} {options} --why "..."'
        yield Advice(RECORDINGS, text, recordings=tuple(sorted(marked)))


def measure_advice(
    dataset: Dataset,
    config: RunConfig,
    plain: EvaluationResult,
    cluster: str | None = None,
    progress: Callable[[JobProgress], None] | None = None,
    warn: Warn = silent,
) -> list[Advice]:
    """Evaluate each unused advice on a data set alone, with the folds of ``plain``; return the advice with its gains.

    The gains are stored, so that `unused_advice` has them. ``warn`` gets a sentence for advice that cannot be followed.

    Args:
        plain: the evaluation with ``config`` as it is.
    """
    choice = config.evaluation.classes
    if choice in (SHARED, ALL):
        # Without the recordings that are left out, others might be shared.
        choice = choose_classes(dataset, choice).labels
    same = replace(config, evaluation=replace(config.evaluation, classes=choice))
    found = []
    for advice in unused_advice(dataset, config.windows.window_s):
        try:
            run = prepare(*advice.follow(dataset, same))
            followed = evaluate_run(run, FoldsSpec(cluster=cluster), progress=progress, warn=silent)
            gain = advice_gain(plain, followed, run.training.epochs)
        except (BadInput, ConfigError, DatasetError) as problem:
            warn(Message("not measured: {advice}; {problem}", advice=advice.text, problem=str(problem)))
            found.append(advice)
        else:
            found.append(replace(advice, gain=gain))
    store, of_kind = _StoredAdvice.of(dataset), {advice.kind: advice for advice in found}
    store.save([of_kind.get(each.kind, each) for each in store.find() or ()])
    return found


def advice_gain(plain: EvaluationResult, followed: EvaluationResult, epochs: int) -> AdviceGain:
    """Compare an evaluation that follows an advice with the ``plain`` one, person by person.

    Raises:
        BadInput: if they have fewer than two people in common.
    """
    both = np.intersect1d(plain.predictions.recording, followed.predictions.recording)
    votes = [votes_by_person(each.predictions.of_recordings(both)) for each in (followed, plain)]
    table = [[vote[person].metrics["accuracy"] for vote in votes] for person in votes[1]]
    pair = compare_pairs(("followed", "plain"), np.array(table, dtype=np.float64).reshape(-1, 2))[0]
    mean, ci95 = pair.difference.mean, pair.difference.ci95
    assert mean is not None and ci95 is not None, "two people or more"
    return AdviceGain(mean, ci95, pair.p, len(table), plain.split.text, epochs, plain.seeds[0])
