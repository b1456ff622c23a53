"""The words and numbers of a report: a protocol as sentences, a figure with its spread, a count with unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

DASH = "—"

CONTEXT_WORDS = {
    "stream": "real context: what the session's stream held before the gesture",
    "loop": "looped windows: a short recording repeated until the window is full, which no toy ever sends",
    "inside": "windows that lie wholly inside a recording",
}
CONTEXT_SHORT = {"stream": "real context", "loop": "loops", "inside": "windows inside the recording"}

_NOT_LEAKY = "No training or validation window overlaps a recording that is scored."
_PEOPLE_VALIDATE = "Whole other people validate{role}; in that fold they are neither trained on nor scored."
_SPLITS = {
    "leave-one-subject-out": (
        "Leave one subject out: each person in turn is held out, and the network is trained anew on the "
        "others; it never saw the person it is scored on.",
        _PEOPLE_VALIDATE,
    ),
    "by-subject": (
        "By subject, {k} folds: the people are dealt into groups; each group in turn is held out whole, and "
        "the network never saw the people it is scored on.",
        _PEOPLE_VALIDATE,
    ),
    "by-recording": (
        "By recording, {k} folds: each recording stands whole on one side, but the people are known: other "
        "recordings of the same person are trained on. It answers how well the network reads people it was "
        "trained for.",
        "Other recordings validate{role}.",
    ),
    "windows": (
        "Random windows, {k} folds: windows are dealt at random, without regard to recording or person.",
        "Other random windows validate{role}.",
    ),
    "holdout": (
        "Hold-out, as in the paper: windows are dealt at random, even over the gestures: 70 % train, 15 % validate, "
        "15 % are scored, without regard to recording or person.",
        "Other random windows validate{role}.",
    ),
}

_ROLES = {
    True: " (they decide when training stops)",
    False: " (they are only watched: training runs its full length)",
    None: "",
}

LEAKY_WORDS = (
    "Windows of the same recording, which overlap, and recordings of the same person stand on both sides of "
    "the split. The figures tell how well the network recognises what it has partly seen; they say little "
    "about a person it never met, and cannot be compared with a split by person."
)
SIMULATED_TITLE = "These scores are of a simulation."
SIMULATED_RECORDINGS_TITLE = "These recordings are of a simulation."
SIMULATED_WORDS = "They were made on a virtual toy with virtual people and say nothing about a real toy."
PARTLY_SIMULATED_TITLE = "A part of this page is of a simulation."
PARTLY_SIMULATED_WORDS = (
    "What bears the mark SIMULATION was made on a virtual toy with virtual people and says nothing about a real toy."
)
# The splits that keep people apart, for evaluations that do not say over what their mean is.
_OVER_PEOPLE = ("leave-one-subject-out", "by-subject")


def number(value: Any, digits: int = 3) -> str:
    """A fraction or another real number with fixed digits; a dash for what is missing or not a number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return DASH
    return f"{value:.{digits}f}"


def count(value: Any, unit: str = "") -> str:
    """A whole number in groups of three (a list is counted), with its unit; a dash for what is missing."""
    if isinstance(value, Sequence | Mapping) and not isinstance(value, str):
        value = len(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return DASH
    grouped = f"{round(value):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return f"{grouped} {unit}".rstrip()


def text(value: Any) -> str:
    """A value as text: lists joined by commas, a dash for what is missing."""
    if value is None or value == "":
        return DASH
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {text(item)}" for key, item in value.items()) or DASH
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(text(item) for item in value) or DASH
    return str(value)


def mean_sd(metric: Any) -> str:
    """``0.561 ± 0.126`` from a metric of an evaluation ({mean, sd, ci95})."""
    if not isinstance(metric, Mapping) or number(metric.get("mean")) == DASH:
        return DASH
    return f"{number(metric.get('mean'))} ± {number(metric.get('sd'))}"


def interval(metric: Any) -> str:
    """``0.512 to 0.607``, the 95 % interval of a metric of an evaluation."""
    ends = metric.get("ci95") if isinstance(metric, Mapping) else None
    if not isinstance(ends, Sequence) or len(ends) != 2 or DASH in (number(ends[0]), number(ends[1])):
        return DASH
    return f"{number(ends[0])} to {number(ends[1])}"


def split_words(split: str, folds: int | None = None, decides: bool | None = None) -> tuple[str, str]:
    """How the data were divided, and who validates, as two sentences; an unknown split is quoted as it is.

    ``decides`` says whether validation ends the training or is only watched; None: not known.
    """
    kind, _, wanted = split.partition(":")
    if split == "windows:holdout":
        kind = "holdout"
    if kind not in _SPLITS:
        return f"Split “{split}”.", "Who validates is not recorded."
    how, who = _SPLITS[kind]
    k = wanted or (str(folds) if folds else "several")
    return how.format(k=k), who.format(role=_ROLES[decides])


def context_words(evaluation: Mapping[str, Any]) -> tuple[str, str]:
    """What stood before the gesture in training and in scoring, as two texts."""
    scored = evaluation.get("context")
    trained = evaluation.get("train_context") or scored
    return CONTEXT_WORDS.get(str(trained), text(trained)), CONTEXT_WORDS.get(str(scored), text(scored))


def protocol(evaluation: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The protocol of an evaluation as (question, answer) pairs in plain words."""
    folds = evaluation.get("folds") or []
    how, who = split_words(str(evaluation.get("split", DASH)), len(folds) or None, evaluation.get("validation_decides"))
    trained, scored = context_words(evaluation)
    seeds = evaluation.get("seeds")
    sizes = [fold.get("test_windows") for fold in folds if isinstance(fold.get("test_windows"), int)]
    answers = [
        ("Split", how),
        ("Who validates", who),
        ("Trained on", trained),
        ("Scored on", scored),
        (
            "Seeds",
            text(seeds)
            + (f" ({len(seeds)} runs averaged)" if isinstance(seeds, list) and len(seeds) > 1 else " (one run)"),
        ),
        ("Folds", count(folds) + (f", {count(sum(sizes))} windows scored" if sizes else "")),
    ]
    if evaluation.get("nobody"):
        rest = "Recordings of nobody (at rest) are spread over the folds by recording and reported apart."
        answers.append(("At rest", rest))
    if not evaluation.get("leaky"):
        answers.insert(2, ("Leak", _NOT_LEAKY))
    return answers


def over(evaluation: Mapping[str, Any]) -> str:
    """Of what a mean has one value each: "subjects" or "folds"."""
    kept = evaluation.get("over")
    if kept in ("subjects", "folds"):
        return str(kept)
    return "subjects" if str(evaluation.get("split")).partition(":")[0] in _OVER_PEOPLE else "folds"


def number_of(evaluation: Mapping[str, Any], units: str) -> str:
    """How many ``units`` ("subjects" or "folds") an evaluation has, in words: "25 people", "1 fold"."""
    n = len(evaluation.get(units) or [])
    one, many = ("person", "people") if units == "subjects" else ("fold", "folds")
    return f"{n or 'the'} {one if n == 1 else many}"


def spread_words(evaluation: Mapping[str, Any]) -> str:
    """Over what the mean, the deviation and the interval are taken, and what that interval is worth."""
    units = over(evaluation)
    taken = number_of(evaluation, units)
    pooled = "Pooled: over all windows at once."
    if len(evaluation.get(units) or []) == 1:
        return f"Of {taken}: there is no spread and no interval. {pooled}"
    words = (
        f"Mean ± standard deviation over {taken}; the 95 % interval is of the mean (percentile bootstrap over "
        f"{'people' if units == 'subjects' else 'folds'}). {pooled}"
    )
    if units == "folds":
        words += (
            f" These are folds, not people: an interval over so few ({taken}), which share most of what they were "
            "trained on, is too narrow, and says nothing about another person."
        )
    return words


def over_words(trials: Sequence[Mapping[str, Any]]) -> str:
    """Over how many seeds and folds the scores of a sweep's trials are, and what their spread is of."""
    seeds, folds = (max((int(t.get(key) or 1) for t in trials), default=1) for key in ("seeds", "folds"))
    if seeds * folds == 1:
        return "one seed, no spread"
    if seeds == 1:
        return f"one seed, mean of {folds} folds"
    return f"mean of {seeds} seeds" + (f" × {folds} folds" if folds > 1 else "")


def simulated(evaluation: Mapping[str, Any], page: bool) -> bool:
    """Whether an evaluation's scores are of a simulation; one that does not say is as its ``page``'s data set."""
    for table in (evaluation, evaluation.get("dataset")):
        if isinstance(table, Mapping) and isinstance(table.get("simulated"), bool):
            return bool(table["simulated"])
    return page


def foreign_words(evaluation: Mapping[str, Any], dataset: Mapping[str, Any]) -> str | None:
    """A sentence for an evaluation of other data than the page's data set; None for one of the same data."""
    made = evaluation.get("dataset")
    theirs, ours = (table.get("hash") if isinstance(table, Mapping) else None for table in (made, dataset))
    if not theirs or not ours or theirs == ours:
        return None
    return (
        f"This evaluation was made on “{text(made.get('name') if isinstance(made, Mapping) else None)}” with the hash "
        f"{str(theirs)[:12]}…; the data set of this page has the hash {str(ours)[:12]}…. Its scores are not of the "
        "data described here."
    )


def title_of(evaluation: Mapping[str, Any]) -> str:
    """The name of an evaluation: its own ``title``, or one made of model, split and contexts."""
    if evaluation.get("title"):
        return str(evaluation["title"])
    scored = str(evaluation.get("context", DASH))
    trained = str(evaluation.get("train_context") or scored)
    on, of = CONTEXT_SHORT.get(scored, scored), CONTEXT_SHORT.get(trained, trained)
    context = f"trained and scored on {on}" if trained == scored else f"trained on {of}, scored on {on}"
    parts = [str(evaluation["model"])] if evaluation.get("model") else []
    return ", ".join([*parts, str(evaluation.get("split", DASH)), context])
