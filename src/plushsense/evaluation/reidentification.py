"""Measure how well a simple program recognises people by their touch (re-identification), before data are published.

The program is trained on recordings labelled with people's codes, and predicts the person of a new recording. It uses
statistics of each recording (those of the paper's baselines, see `windows.features.statistics`) and extremely
randomised trees (Geurts, Ernst & Wehenkel 2006). A stronger program may do better, so that the scores are a lower bound
of the risk and never prove anonymity.

All people have equal weight: top-1 and top-5 are averaged over people, so that chance is 1 / people and 5 / people.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, need
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.templates import fill_text
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset
from plushsense.scoring.metrics import summary
from plushsense.windows.clock import resample
from plushsense.windows.features import magnitude, statistics

Floats = NDArray[np.float64]
Texts = NDArray[np.str_]
Progress = Callable[[int, int], None]

COARSE_HZ = 25.0
FOLDS = 5
FEWEST_RECORDINGS = 2
CLEARLY = 0.8

# The programs by name, each with a description of its features and of what they leave out.
SEES = {
    "everything": "statistics of every channel, and the clock's rate and jitter",
    "touch": "statistics of every channel, not the clock",
    "movement": (
        f"only how the channels change: no level (so not how the toy is held), averaged to {COARSE_HZ:g} Hz (so not "
        "the device's noise and sampling rate)"
    ),
    "clock": "only the clock's rate and jitter, nothing of the touch",
}
DESIGNS = {
    "recordings": "a new recording of the same sessions and gestures",
    "gestures": "a recording of a gesture that the program never saw",
    "sessions": "a recording of a session that the program never saw",
}
_PLAN = (
    ("recordings", ("everything", "touch", "movement", "clock")),
    ("gestures", ("everything", "movement")),
    ("sessions", ("everything", "movement")),
)


@dataclass(frozen=True)
class ReidentificationTrial:
    """The result of one program (``sees``, a key of `SEES`) in one design (a key of `DESIGNS`).

    ``top1`` and ``top5`` are ``{mean, sd, ci95}`` over people (bootstrap over people); ``by_person`` is the top-1 of
    each person; ``precision`` is the share of correct predictions among those of that person; ``chance`` and
    ``chance5`` are the scores of guessing.
    """

    design: str
    sees: str
    people: int
    recordings: int
    top1: dict[str, Any]
    top5: dict[str, Any]
    chance: float
    chance5: float
    by_person: dict[str, float]
    precision: dict[str, float]

    @property
    def clear(self) -> list[str]:
        """People whose top-1 and precision are both at least `CLEARLY`."""
        return [p for p, share in self.by_person.items() if min(share, self.precision[p]) >= CLEARLY]


@dataclass(frozen=True)
class ReidentificationResult:
    """The results of a re-identification; ``skipped`` has the reason for each design that the data do not allow.

    ``gestures_of_one_person`` are gestures that only one person made, so that the label alone identifies the person.
    """

    people: int
    recordings: int
    sessions: int
    trials: tuple[ReidentificationTrial, ...]
    skipped: dict[str, str]
    gestures_of_one_person: tuple[str, ...]
    seed: int
    trees: int
    simulated: bool

    def find(self, design: str, sees: str) -> ReidentificationTrial | None:
        """Return the trial of a design and a program; None if it was skipped."""
        return next((t for t in self.trials if (t.design, t.sees) == (design, sees)), None)

    def under(self, codes: Mapping[str, str], label: Callable[[str], str]) -> ReidentificationResult:
        """Return the results with the public code of each person (a code not in ``codes`` is kept) and gesture."""

        def renamed(shares: dict[str, float]) -> dict[str, float]:
            return {codes.get(p, p): share for p, share in shares.items()}

        trials = [replace(t, by_person=renamed(t.by_person), precision=renamed(t.precision)) for t in self.trials]
        return replace(
            self, trials=tuple(trials), gestures_of_one_person=tuple(map(label, self.gestures_of_one_person))
        )

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return asdict(self)


def reidentify(
    dataset: Dataset, *, seed: int = 1, trees: int = 150, progress: Progress | None = None
) -> ReidentificationResult:
    """Measure how well the people of a data set can be recognised by their recordings.

    Excluded recordings, those of `NOBODY` or unknown people, and people with a single recording are left out.

    Args:
        seed: the same seed gives the same scores.
        trees: number of trees of the classifier.
        progress: called with the number of finished fits and of all fits.

    Raises:
        BadInput: with fewer than two people of at least two recordings each.
        MissingExtraError: without scikit-learn.
    """
    forest = need("sklearn.ensemble", "baselines")
    seen = _read(dataset)
    groups = {
        "recordings": _at_random(seen.person, seed),
        "gestures": np.asarray(np.unique(seen.gesture, return_inverse=True)[1] % FOLDS, dtype=np.int64),
        "sessions": _turns(seen.person, seen.session),
    }
    skipped = {}
    if len(np.unique(seen.gesture)) < 2:
        skipped["gestures"] = "there is only one gesture"
    if not (groups["sessions"] >= 0).any():
        skipped["sessions"] = "nobody has more than one session"
    plan = [(design, sees) for design, names in _PLAN if design not in skipped for sees in names]
    trials = []
    for done, (design, sees) in enumerate(plan):
        if progress is not None:
            progress(done, len(plan))
        model = forest.ExtraTreesClassifier(trees, class_weight="balanced", random_state=seed, n_jobs=1)
        ranked = _ranked(model, seen.features[sees], seen.person, groups[design], seed)
        trials.append(_trial(design, sees, seen.person, ranked))
    if progress is not None:
        progress(len(plan), len(plan))
    alone = [g for g in np.unique(seen.gesture) if len(np.unique(seen.person[seen.gesture == g])) == 1]
    return ReidentificationResult(
        people=len(np.unique(seen.person)),
        recordings=len(seen.person),
        sessions=len(set(zip(seen.person.tolist(), seen.session.tolist(), strict=True))),
        trials=tuple(trials),
        skipped=skipped,
        gestures_of_one_person=tuple(map(str, alone)),
        seed=seed,
        trees=trees,
        simulated=dataset.head.simulated,
    )


@dataclass(frozen=True)
class _Recordings:
    """The recordings that are used: features (n, F) for each program in `SEES`, and person, gesture, session (n,)."""

    features: dict[str, Floats]
    person: Texts
    gesture: Texts
    session: Texts


def _read(dataset: Dataset) -> _Recordings:
    """Read the recordings of people with at least `FEWEST_RECORDINGS`; those that are too short are left out."""
    used = [r for r in dataset.used if r.subject not in (NOBODY, UNKNOWN_SUBJECT)]
    counts = Counter(r.subject for r in used)
    used = [r for r in used if counts[r.subject] >= FEWEST_RECORDINGS]
    if len({r.subject for r in used}) < 2:
        raise BadInput(
            f"Re-identification needs two people with at least {FEWEST_RECORDINGS} recordings each: leave it out with "
            "--no-reidentification."
        )
    seen = [(r, found) for r in used if (found := features(dataset.read(r), dataset.layout)) is not None]
    return _Recordings(
        {name: np.stack([found[name] for _, found in seen]) for name in SEES},
        *(np.array([getattr(r, key) for r, _ in seen]) for key in ("subject", "gesture", "session")),
    )


def features(frames: Frames, layout: Layout) -> dict[str, Floats] | None:
    """Return the features of one recording for each program in `SEES`; None for a recording that is too short.

    Statistics are those of the longest part without a gap, resampled at a constant rate.
    """
    segments = resample(frames, layout)
    longest = max(segments, key=len, default=None)
    if longest is None or len(longest) < 4:
        return None
    parts = [magnitude(longest.data[:, [layout.index(n) for n in d.of]])[:, None] for d in layout.derived]
    x = np.concatenate([longest.data, *parts], axis=1).astype(np.float64)
    touch = statistics(x.T[None], layout.rate_hz)[0]
    block = max(1, round(layout.rate_hz / COARSE_HZ))
    rows = len(x) // block
    coarse = x[: rows * block].reshape(rows, block, -1).mean(axis=1) if rows >= 4 else x
    movement = statistics((coarse - coarse.mean(axis=0)).T[None], layout.rate_hz / block)[0]
    clock = _clock(frames.device_ms)
    return {"everything": np.concatenate([touch, clock]), "touch": touch, "movement": movement, "clock": clock}


def _clock(device_ms: NDArray[np.int64]) -> Floats:
    steps = np.diff(device_ms)
    steps = steps[(steps >= 0) & (steps <= 1000)]
    if not len(steps):
        return np.zeros(4)
    return np.array([steps.mean(), np.median(steps), steps.std(), float(np.mean(steps == np.median(steps)))])


def _at_random(person: Texts, seed: int) -> NDArray[np.int64]:
    """Divide each person's recordings among the folds at random, (n,)."""
    rng = np.random.default_rng([seed, 0x1D])
    group = np.zeros(len(person), dtype=np.int64)
    for name in np.unique(person):
        mine = rng.permutation(np.flatnonzero(person == name))
        group[mine] = np.arange(len(mine)) % FOLDS
    return group


def _turns(person: Texts, session: Texts) -> NDArray[np.int64]:
    """Number each person's sessions and return that of each recording, (n,); −1 for people with one session."""
    group = np.full(len(person), -1, dtype=np.int64)
    for name in np.unique(person):
        mine = person == name
        names, which = np.unique(session[mine], return_inverse=True)
        if len(names) > 1:
            group[mine] = which
    return group


def _ranked(model: Any, x: Floats, person: Texts, group: NDArray[np.int64], seed: int) -> NDArray[np.int64]:
    """Return the likeliest five people of each recording, (n, 5), as indices of the sorted codes.

    A group at a time is left out of the training. −1 stands for recordings that are not tested (group −1, or people
    without training recordings, who cannot be named), and fills the row where fewer than five people are known.
    """
    _, truth = np.unique(person, return_inverse=True)
    ranked = np.full((len(truth), 5), -1)
    rng = np.random.default_rng([seed, 0x7E])
    for turn in np.unique(group[group >= 0]):
        test, train = np.flatnonzero(group == turn), np.flatnonzero(group != turn)
        test = test[np.isin(truth[test], truth[train])]
        if not len(test):
            continue
        model.fit(x[train], truth[train])
        # Break ties at random (for example of people with equal clocks), and not in favour of the first code.
        chances = np.round(model.predict_proba(x[test]), 9)
        likely = model.classes_[np.argsort(-(chances + 1e-10 * rng.random(chances.shape)), axis=1)][:, :5]
        ranked[test, : likely.shape[1]] = likely
    return ranked


def _trial(design: str, sees: str, person: Texts, ranked: NDArray[np.int64]) -> ReidentificationTrial:
    """Score the people named for each recording, (n, 5)."""
    names, truth = np.unique(person, return_inverse=True)
    tested = ranked[:, 0] >= 0
    named, truth = ranked[tested], truth[tested]
    hit = named == truth[:, None]
    people = np.unique(truth)
    first = {str(names[k]): float(hit[truth == k, 0].mean()) for k in people}
    five = [float(hit[truth == k].any(axis=1).mean()) for k in people]
    answers = {str(names[k]): named[:, 0] == k for k in people}
    return ReidentificationTrial(
        design=design,
        sees=sees,
        people=len(names),
        recordings=int(tested.sum()),
        top1=summary(list(first.values())).to_json(),
        top5=summary(five).to_json(),
        chance=1.0 / len(names),
        chance5=min(1.0, 5.0 / len(names)),
        by_person=first,
        precision={p: float(hit[at, 0].mean()) if at.any() else 0.0 for p, at in answers.items()},
    )


def verdict(results: ReidentificationResult) -> str:
    """Return a summary of the results as one Markdown paragraph.

    Raises:
        MissingExtraError: when jinja2 is not installed.
    """
    sentences = _fill("reidentification_verdict.md.j2", found=results, hundred=_hundred, interval=_range)
    return " ".join(sentences.splitlines())


def report(results: ReidentificationResult) -> str:
    """Return the whole report in Markdown."""
    trial = results.find("recordings", "everything")
    by_person = None if trial is None else sorted(trial.by_person.items(), key=lambda item: (-item[1], item[0]))
    return _fill(
        "reidentification.md.j2",
        found=results,
        verdict=verdict(results),
        by_person=by_person,
        designs=DESIGNS,
        sees=SEES,
        folds=FOLDS,
    )


def _fill(template: str, **values: Any) -> str:
    return fill_text("plushsense.evaluation", template, **values)


def _hundred(share: float | None) -> str:
    if share is None:
        return "an unknown number"
    return f"{100 * share:.0f}" if share >= 0.095 or share == 0 else f"{100 * share:.1f}"


def _range(trial: ReidentificationTrial) -> str:
    ci = trial.top1["ci95"]
    return f" (95 % interval {_hundred(ci[0])} to {_hundred(ci[1])})" if ci else ""
