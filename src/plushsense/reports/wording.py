"""Texts that all reports share, on splits, contexts, spread, leaks and simulations."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from plushsense.reports.table import DASH, count, percent, text

_TEXTS = tomllib.loads(resources.files("plushsense.reports").joinpath("wording.toml").read_text(encoding="utf-8"))
CONTEXT_WORDS: dict[str, str] = _TEXTS["contexts"]
CONTEXT_SHORT: dict[str, str] = _TEXTS["contexts_short"]

_NO_LEAK = "No training or validation window overlaps a recording that is scored."
_PAST_SHARED = (
    "No training or validation window overlaps a recording that is scored, but {share} of the scored windows contain "
    "samples that were trained on, from before the recording."
)
# The two ways to count of `plushsense.evaluation.scores`, where recordings at rest are scored apart.
REST_APART = "without recordings at rest"
MEAN = f"mean over people, {REST_APART}"
POOLED = "Pooled: over all windows at once, with recordings at rest."
# Splits by person, for evaluations without the key "over".
_SPLITS_BY_PERSON = ("leave-one-subject-out", "by-subject")


def describe_split(split: str, folds: int | None = None, decides: bool | None = None) -> tuple[str, str]:
    """Return sentences on how the data were divided and on who validates; an unknown split is quoted.

    ``decides`` tells whether validation ends the training (early stopping); None: unknown.
    """
    kind, _, given_folds = split.partition(":")
    if f"{kind}-{given_folds}" in _TEXTS["splits"]:
        kind = f"{kind}-{given_folds}"
    if kind not in _TEXTS["splits"]:
        return f"Split “{split}”.", "Who validates is not recorded."
    sentences = _TEXTS["splits"][kind]
    k = given_folds or (str(folds) if folds else "several")
    role = "" if decides is None else _TEXTS["roles"]["decides" if decides else "observed"]
    return sentences["how"].format(k=k), sentences["who"].format(role=role)


def describe_contexts(evaluation: Mapping[str, Any]) -> tuple[str, str]:
    """Return descriptions of the context of the training windows and of the scored windows."""
    scored = evaluation.get("context")
    trained = evaluation.get("train_context") or scored
    return CONTEXT_WORDS.get(str(trained), text(trained)), CONTEXT_WORDS.get(str(scored), text(scored))


def describe_protocol(evaluation: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the protocol of an evaluation as (question, answer) pairs."""
    folds = evaluation.get("folds") or []
    how, who = describe_split(
        str(evaluation.get("split", DASH)), len(folds) or None, evaluation.get("validation_decides")
    )
    if folds and not any(fold.get("validation_windows", 1) for fold in folds):
        who = "Nobody: every training runs its full length, so all others are trained on."
    trained, scored = describe_contexts(evaluation)
    seeds = evaluation.get("seeds")
    runs = f"{len(seeds)} runs averaged" if isinstance(seeds, list) and len(seeds) > 1 else "one run"
    sizes = [fold.get("test_windows") for fold in folds if isinstance(fold.get("test_windows"), int)]
    answers = [
        ("Split", how),
        ("Who validates", who),
        ("Trained on", trained),
        ("Scored on", scored),
        ("Seeds", f"{text(seeds)} ({runs})"),
        ("Folds", count(folds) + (f", {count(sum(sizes))} windows scored" if sizes else "")),
    ]
    if "trimmed" in (dataset := evaluation.get("dataset") or {}):
        answers.append(("Data", describe_marks(dataset)))
    if evaluation.get("nobody"):
        how = "reported apart" if averaged_over(evaluation) == "subjects" else "counted like all others"
        rest = f"Recordings of nobody (at rest) are spread over the folds by recording and {how}."
        answers.append(("At rest", rest))
    learning = evaluation.get("learning")
    if learning and learning.get("ci95"):
        answers.append(("More people", describe_learning(learning)))
    if not evaluation.get("leaky"):
        audit = evaluation.get("leakage") or {}
        shared = audit.get("overlapping", 0) / max(audit.get("windows", 0), 1)
        answers.insert(2, ("Leak", _PAST_SHARED.format(share=percent(shared)) if shared else _NO_LEAK))
    if evaluation.get("self_calibration"):
        how = "Offset and scale of accelerometers: causal, from the readings of the session so far, without labels."
        answers.append(("Self-calibration", how))
    if confidence := evaluation.get("confidence"):
        answers.append(("Confidence", describe_confidence(confidence)))
    if audit := evaluation.get("leakage"):
        answers.append(("Leakage audit", describe_leakage(audit)))
    return answers


def describe_marks(dataset: Mapping[str, Any]) -> str:
    """Describe what marks and the layout of a data set (`plushsense.dataset.store.Dataset.summary`) changed."""
    zeros = ", ".join(f"{name} {value:g}" for name, value in dataset["offsets"].items())
    return (
        f"Decisions on single recordings leave out {count(dataset['excluded'])} and trim {count(dataset['trimmed'])} "
        f"of {count(dataset['recordings'])}." + (f" Readings that stand for zero: {zeros}." if zeros else "")
    )


def describe_learning(learning: Mapping[str, Any]) -> str:
    """Describe a learning curve (`plushsense.workflow.learning`) in one sentence."""
    low, high = learning["ci95"]
    people = ", ".join(str(point["people"]) for point in learning["points"])
    return (
        f"Training with {learning['more']} more people would change the accuracy by {learning['gain']:+.3f} (95 % "
        f"interval {low:+.3f} to {high:+.3f}), by a learning curve over {people} people to train on."
    )


def describe_confidence(confidence: Mapping[str, Any]) -> str:
    """Describe how well confidence and correctness agree (`plushsense.evaluation.confidence`) in a few sentences."""
    ci95, int8 = confidence.get("ci95"), confidence.get("error_int8")
    interval = f" (95 % interval over people {ci95[0]:.3f} to {ci95[1]:.3f})" if ci95 else ""
    deployed = f", in 8 bits {int8:.3f}" if int8 is not None else ""
    sentence = (
        f"The mean confidence is {confidence['mean']:.3f}; its expected calibration error over 15 bins is "
        f"{confidence['error']:.3f}{interval}{deployed}."
    )
    tempered, temperature = confidence["error_tempered"], confidence["temperature"]
    if temperature is not None:
        sentence += (
            f" With temperatures, each fitted to the people of the other folds, it is {tempered:.3f}; for a network of "
            f"everybody: train --temperature {temperature:.2f}."
        )
    elif tempered is not None:
        sentence += f" Temperatures do not clearly lower it ({tempered:.3f})."
    return sentence


def describe_leakage(audit: Mapping[str, Any]) -> str:
    """Describe a leakage audit (`plushsense.evaluation.leakage`) in one sentence."""
    shares = ", ".join(
        f"{noun} {percent(audit[key] / max(audit['windows'], 1))}"
        for key, noun in _TEXTS["leakage"].items()
        if key in audit
    )
    return f"Of the {count(audit['windows'])} scored windows, the share that was in some way trained on: {shares}."


def averaged_over(evaluation: Mapping[str, Any]) -> str:
    """Return "subjects" or "folds", the units over which the means of an evaluation are taken."""
    stored = evaluation.get("over")
    if stored in ("subjects", "folds"):
        return str(stored)
    return "subjects" if str(evaluation.get("split")).partition(":")[0] in _SPLITS_BY_PERSON else "folds"


def count_of(evaluation: Mapping[str, Any], units: str) -> str:
    """Return the number of ``units`` ("subjects" or "folds") of an evaluation in words: "25 people", "1 fold"."""
    n = len(evaluation.get(units) or [])
    one, many = ("person", "people") if units == "subjects" else ("fold", "folds")
    return f"{n or 'the'} {one if n == 1 else many}"


def describe_spread(evaluation: Mapping[str, Any]) -> str:
    """Return sentences on the units of mean, standard deviation and interval, and on the limits of the interval."""
    units = averaged_over(evaluation)
    number = count_of(evaluation, units)
    apart = bool(evaluation.get("nobody")) and units == "subjects"
    rest = f", {REST_APART}" if apart else ""
    pooled = POOLED if apart else "Pooled: over all windows at once."
    if len(evaluation.get(units) or []) == 1:
        return f"Of {number}: there is no spread and no interval. {pooled}"
    sentences = (
        f"Mean ± standard deviation over {number}{rest}; the 95 % interval is of the mean (percentile bootstrap over "
        f"{'people' if units == 'subjects' else 'folds'}). {pooled}"
    )
    if units == "folds":
        sentences += (
            f" These are folds, not people: an interval over so few ({number}), which share most of what they were "
            "trained on, is too narrow, and says nothing about another person."
        )
    return sentences


def describe_runs(trials: Sequence[Mapping[str, Any]]) -> str:
    """Return in words the numbers of seeds and folds over which the scores of a sweep's trials are averaged."""
    seeds, folds = (max((int(t.get(key) or 1) for t in trials), default=1) for key in ("seeds", "folds"))
    if seeds * folds == 1:
        return "one seed, no spread"
    if seeds == 1:
        return f"one seed, mean of {folds} folds"
    return f"mean of {seeds} seeds" + (f" × {folds} folds" if folds > 1 else "")


def is_simulated(evaluation: Mapping[str, Any], default: bool) -> bool:
    """Return whether an evaluation's scores are of a simulation; ``default`` if it does not contain this."""
    for table in (evaluation, evaluation.get("dataset")):
        if isinstance(table, Mapping) and isinstance(table.get("simulated"), bool):
            return bool(table["simulated"])
    return default


def describe_other_data(evaluation: Mapping[str, Any], dataset: Mapping[str, Any]) -> str | None:
    """Return a warning for an evaluation of other data than the page's data set; None for the same data."""
    source = evaluation.get("dataset")
    theirs, ours = (table.get("hash") if isinstance(table, Mapping) else None for table in (source, dataset))
    if not theirs or not ours or theirs == ours:
        return None
    return (
        f"This evaluation is of “{text(source.get('name') if isinstance(source, Mapping) else None)}” with the "
        f"hash {str(theirs)[:12]}…; the data set of this page has the hash {str(ours)[:12]}…. Its scores are not of "
        "the data described here."
    )


def evaluation_title(evaluation: Mapping[str, Any]) -> str:
    """Return the ``title`` of an evaluation, or if it has none, one made from model, split and contexts."""
    if evaluation.get("title"):
        return str(evaluation["title"])
    scored = str(evaluation.get("context", DASH))
    trained = str(evaluation.get("train_context") or scored)
    on, of = CONTEXT_SHORT.get(scored, scored), CONTEXT_SHORT.get(trained, trained)
    context = f"trained and scored on {on}" if trained == scored else f"trained on {of}, scored on {on}"
    parts = [str(evaluation["model"])] if evaluation.get("model") else []
    return ", ".join([*parts, str(evaluation.get("split", DASH)), context])
