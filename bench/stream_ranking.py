"""Rank systems on whole streams of people left out: the section "Ranking" of docs/streams.md.

    plushsense import ../shared/data/makeability-gestures DS --layout accel-3
    plushsense trim DS --accept-above 0.5 --who K
    python bench/stream_ranking.py DS

Every model gives probabilities along the streams. Three decision rules make events of them, and the settings of each
rule are tuned on the validation people of the fold, by the code of ``stream-eval --split`` and on the same folds.
Finished folds are kept in DS/cache/ranking, so that the same command resumes. With trained networks in the cache,
"anywhere", "forest", "rocket" and "continual" took 42 minutes on half of a core. The models "rocket" and "continual"
need aeon 1.6 and continual-inference 1.2, in an environment of their own: aeon holds NumPy below constraints.txt.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

import plushsense as ps
from plushsense.dataset.files import CACHE
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams.replay import EventCounts, StreamTrace, count_events, read_streams
from plushsense.experiments.streams.run import Recipe, TrainStreams, recipes_for
from plushsense.experiments.streams.score import PeopleFold, people_folds
from plushsense.experiments.streams.systems import ANYWHERE, SYSTEMS, TARGETS, WINDOWS, balanced, fewest, searched
from plushsense.jobs.journal import job_id
from plushsense.models.arch import Arch, ConvLayer
from plushsense.runtime.fixed import LOGIT_LIMIT
from plushsense.runtime.trace import TraceReplayer
from plushsense.scoring.calibration import fit_temperature
from plushsense.scoring.events import at_recall
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import Scaler, statistics
from plushsense.workflow.config import from_settings
from plushsense.workflow.preparation import network_inputs_of, outside_streams, windows_for
from plushsense.workflow.reporting import journal_of

Values = NDArray[Any]  # floats or integers

SPLIT = "by-subject:5"
AXES = ("x", "y", "z")
RATE_HZ = 100.0
WINDOW, EVERY = 250, 20  # samples: the window models read 2.5 s, every 0.2 s
KERNELS, FILTERS, POOL, STEP = 40, (6, 10, 16), 125, 5  # the continual network; it has no dilation
RULES = {"argmax": "plain argmax", "smoothed": "smoothed argmax", "hysteresis": "hysteresis"}
RECALLS = (0.4, 0.5, 0.6)
RESAMPLES = 1000
VERSION = 1


@dataclass(frozen=True)
class Reader:
    """A fitted model.

    ``read`` returns the logits (n, K) of each ``step`` of samples (T, 3), from the first ``span`` of them on.
    ``macs`` is the number of multiply-adds for one second of signal, None where it is not counted.
    """

    read: Callable[[Values], Values]
    span: int
    step: int
    size: str
    macs: float | None = None


@dataclass(frozen=True)
class Model:
    """A model to rank; ``fit`` trains it on windows. ``whole``: on all of the streams instead of the usual share."""

    title: str
    fit: Callable[[WindowSet, WindowSet, int], Reader] | None = None
    whole: bool = False


def with_magnitude(x: Values) -> Values:
    """Add the magnitude of the axes to windows (N, 3, T), as a fourth channel."""
    return np.concatenate([x, np.sqrt((x.astype(np.float64) ** 2).sum(axis=1, keepdims=True))], axis=1)


def by_windows(scores: Callable[[Values], Values], size: str) -> Reader:
    """Return a reader that computes the logits of windows (N, 3, T) with ``scores``."""

    def read(x: Values) -> Values:
        cut = np.lib.stride_tricks.sliding_window_view(x, WINDOW, axis=0)[::EVERY]
        return np.concatenate([scores(cut[at : at + 1000]) for at in range(0, len(cut), 1000)])

    return Reader(read, WINDOW, EVERY, size)


def fit_forest(train: WindowSet, watch: WindowSet, seed: int) -> Reader:
    """Fit a random forest to the statistics of the axes and their magnitude; ``watch`` is not used."""
    from sklearn.ensemble import RandomForestClassifier

    def features(x: Values) -> Values:
        return statistics(with_magnitude(x), RATE_HZ)

    model = RandomForestClassifier(200, min_samples_leaf=5, class_weight="balanced_subsample", random_state=seed)
    model.fit(features(train.integers), train.y)
    nodes = sum(tree.tree_.node_count for tree in model.estimators_)
    return by_windows(lambda x: np.log(np.maximum(model.predict_proba(features(x)), 1e-3)), f"{nodes} nodes")


def fit_rocket(train: WindowSet, watch: WindowSet, seed: int) -> Reader:
    """Fit MiniRocket and a ridge classifier; the log loss of ``watch`` chooses the scale of its decision values."""
    from aeon.transformations.collection.convolution_based import MiniRocket  # type: ignore[import-not-found]
    from sklearn.linear_model import RidgeClassifierCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    scaler = Scaler.fit(with_magnitude(train.integers))
    ridge = RidgeClassifierCV(np.logspace(-3, 3, 10))
    model = make_pipeline(MiniRocket(random_state=seed, n_jobs=1), StandardScaler(with_mean=False), ridge)

    def scaled(x: Values) -> Values:
        return np.ascontiguousarray(scaler.apply(with_magnitude(x)))

    model.fit(scaled(train.integers), train.y)
    factor = 5.0 / fit_temperature(np.exp(5.0 * model.decision_function(scaled(watch.integers))), watch.y)
    return by_windows(lambda x: factor * model.decision_function(scaled(x)), f"{ridge.coef_.size} weights")


def fit_continual(train: WindowSet, watch: WindowSet, seed: int) -> Reader:
    """Fit a causal network of continual-inference, as the preset trains raw axes; ``watch`` is not used."""
    import continual as co  # type: ignore[import-not-found]
    import torch
    from torch.nn import functional as F

    from plushsense.training.augment import Channels, augmentations
    from plushsense.training.engine import Adam

    torch.manual_seed(seed)
    scaler, layers, macs, channels = Scaler.fit(train.integers), [], 0, len(AXES)
    for filters in FILTERS:
        layers += [co.Conv1d(channels, filters, KERNELS), torch.nn.ReLU(), torch.nn.BatchNorm1d(filters)]
        macs, channels = macs + channels * filters * KERNELS, filters
    net = co.Sequential(*layers, co.AvgPool1d(POOL, stride=1), co.Conv1d(channels, len(train.labels), 1))
    span = net.receptive_field
    x, y = torch.from_numpy(scaler.apply(train.integers)[:, :, -span:]), torch.from_numpy(train.y)
    turn = augmentations(("random-rotation:45",), Channels(((0, 1, 2),), scaler, torch.device("cpu")))
    adam, order = Adam(net.parameters()), torch.Generator().manual_seed(seed)
    for epoch in range(30):
        for batch in torch.randperm(len(x), generator=order).split(64):
            if len(batch) > 1:
                adam.zero_grad()
                F.cross_entropy(net(turn(x[batch], order))[:, :, -1], y[batch]).backward()
                adam.step(0.003 * 0.5 ** (epoch // 8))
    net.eval()

    @torch.no_grad()
    def read(values: Values) -> Values:
        samples = torch.from_numpy(scaler.apply(values.T[None]))
        return np.asarray(net(samples)[0].T[::STEP].numpy())

    with torch.no_grad():  # one sample at a time gives the same logits
        some = torch.from_numpy(scaler.apply(train.integers[:1].repeat(2, axis=2)))
        net.clean_state()
        steps = [net.forward_step(some[:, :, at]) for at in range(some.shape[2])][span - 1 :]
        torch.testing.assert_close(torch.stack(steps, dim=2), net(some))
    return Reader(read, span, STEP, f"{sum(p.numel() for p in net.parameters())} parameters", macs * RATE_HZ)


MODELS = {
    ANYWHERE: Model("our network, trained anywhere"),
    WINDOWS: Model("our network, trained on recordings"),
    "forest": Model("random forest (scikit-learn)", fit_forest),
    "forest-whole": Model("the same, trained on whole streams", fit_forest, whole=True),
    "rocket": Model("MiniRocket (aeon)", fit_rocket),
    "continual": Model("continual-inference, raw axes", fit_continual),
}


def read_with(streams: Iterable[StreamTrace], reader: Reader, axes: list[int]) -> list[StreamTrace]:
    """Return streams with the logits of another model, so that all that is not the model stays the same."""
    traces = []
    for stream in streams:
        trace = stream.replayer.trace
        layer = ConvLayer(reader.span - reader.step + 1, 1, 1)
        arch = Arch((layer,), 3, len(trace.gestures), window=reader.span, step=reader.step, pool=reader.step)
        parts = []
        for part in trace.parts:
            logits = np.empty((0, arch.classes), dtype=np.int64)
            if len(part.inputs) >= reader.span:
                logits = np.rint(256 * reader.read(part.inputs[:, axes])).astype(np.int64)
            parts.append(replace(part, logits=np.clip(logits, -LOGIT_LIMIT, LOGIT_LIMIT)))
        trace = replace(trace, arch=arch, parts=tuple(parts))
        traces.append(StreamTrace(stream.truth, TraceReplayer(trace)))
    return traces


def tuned(tuning: list[StreamTrace], testing: list[StreamTrace], rule: str) -> dict[str, Any]:
    """Choose the settings of a rule on ``tuning``; return the counts on ``testing``: of each target, of each person."""
    points = searched(tuning, SYSTEMS[rule])
    curve = [vars(count_events(testing, fewest(points, target).spec)) for target in TARGETS]
    best = balanced(points)
    people: dict[str, EventCounts] = {}
    for stream in testing:
        people.setdefault(stream.truth.subject, EventCounts()).add(count_events([stream], best.spec))
    for stream in (*tuning, *testing):
        stream.replayer.clear_cache()
    return {"curve": curve, "people": {person: vars(counts) for person, counts in people.items()}}


@cache
def training_windows(dataset: Dataset, recipe: Recipe, whole: bool) -> WindowSet:
    """Return the windows of all people on which our network is trained, or all of the streams; raw axes only."""
    anywhere = recipe.anywhere
    if whole and anywhere is not None:
        anywhere = replace(anywhere, every_s=EVERY / RATE_HZ, idle_share=0.95, busy_share=0.0)
    return windows_for(dataset, recipe.arch, recipe.windows, recipe.gestures, anywhere=anywhere).only(AXES)


def scored(dataset: Dataset, recipes: dict[str, Recipe], name: str, fold: PeopleFold, seed: int) -> dict[str, Any]:
    """Return the counts of a model in a fold, for each rule, from the journal if they are there."""
    keys = {network: recipe.key() for network, recipe in recipes.items()}
    model = {"version": VERSION, "model": name, "seed": seed, "networks": keys}
    job = job_id({**model, "data": dataset.hash, "fold": vars(fold)})
    journal = journal_of(dataset, "ranking")
    if (known := journal.find(job)) is not None:
        return known
    began, own = time.perf_counter(), name if name in recipes else ANYWHERE
    train_own = TrainStreams({own: recipes[own]}, False, dataset.path / CACHE / "stream-networks")
    bundle = train_own(dataset, fold, lambda *_: None).networks[own]
    tuning, testing = (read_streams(dataset, bundle, people) for people in (fold.validation, fold.test))
    macs: float | None = bundle.arch.macs_per_sample * RATE_HZ
    size = f"{bundle.arch.parameters} parameters"
    if (fit := MODELS[name].fit) is not None:
        cut = training_windows(dataset, recipes[ANYWHERE], MODELS[name].whole)
        others = sorted({*fold.validation, *fold.test})
        mine = outside_streams(cut, dataset, others) & ~np.isin(cut.subject, others)
        watch = cut.take(np.flatnonzero(np.isin(cut.subject, fold.validation)))
        reader = fit(cut.take(np.flatnonzero(mine)), watch, seed)
        axes = [dataset.layout.inputs.index(axis) for axis in AXES]
        tuning, testing = (read_with(streams, reader, axes) for streams in (tuning, testing))
        size, macs = reader.size, reader.macs
    result = {"size": size, "macs": macs, "rules": {rule: tuned(tuning, testing, rule) for rule in RULES}}
    journal.save(job, result)
    print(f"{name}, {fold.name}: {time.perf_counter() - began:.0f} s", flush=True)
    return result


def pooled(counts: Iterable[dict[str, Any]]) -> EventCounts:
    """Return the sum of stored counts."""
    total = EventCounts()
    for each in counts:
        total.add(EventCounts(**each))
    return total


def line(title: str, rule: str, folds: list[dict[str, Any]], ours: list[dict[str, Any]]) -> tuple[float, str]:
    """Return the F1 and the line of the table of one model and rule; ``ours`` are the folds of our system."""
    mine = [fold["rules"][rule] for fold in folds]
    curve = [pooled(fold["curve"][at] for fold in mine) for at in range(len(TARGETS))]
    false = [at_recall([(counts.recall, counts.false_per_hour) for counts in curve], recall) for recall in RECALLS]
    people = {p: c for fold in mine for p, c in fold["people"].items()}
    others = {p: c for fold in ours for p, c in fold["rules"]["hysteresis"]["people"].items()}
    whole, random = pooled(people.values()), np.random.default_rng(0)
    draws = [random.choice(sorted(people), len(people)) for _ in range(RESAMPLES)]
    gaps = [pooled(people[p] for p in draw).f1 - pooled(others[p] for p in draw).f1 for draw in draws]
    gap = "" if people == others else "{:+.2f} to {:+.2f}".format(*np.percentile(gaps, [2.5, 97.5]))
    cells = [
        title, RULES[rule], " / ".join("–" if f is None else f"{f:.0f}" for f in false), f"{whole.f1:.2f}", gap,
        f"{whole.recall:.2f}", f"{whole.false_per_hour:.0f}", f"{np.median(whole.latencies):.2f} s",
        folds[0]["size"], f"{folds[0]['macs'] / 1e6:.2f} M" if folds[0]["macs"] else "–",
    ]  # fmt: skip
    return whole.f1, f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", metavar="DS")
    parser.add_argument("--models", default=",".join(MODELS), help="models to rank, joined by commas")
    parser.add_argument("--seed", type=int, default=0, help="of the folds and of the trainings")
    args = parser.parse_args()
    chosen = list(dict.fromkeys([ANYWHERE, *args.models.split(",")]))
    if unknown := [name for name in chosen if name not in MODELS]:
        parser.error(f"there is no model {', '.join(unknown)}: accepted are {', '.join(MODELS)}")
    for name, module, package in (("rocket", "aeon", "aeon"), ("continual", "continual", "continual-inference")):
        if name in chosen and find_spec(module) is None:
            parser.error(f"the model {name} needs {package}: install it with  pip install {package}")
    dataset, config = network_inputs_of(ps.open_dataset(args.dataset), from_settings(seed=args.seed))
    recipes, folds = recipes_for(dataset, config, {ANYWHERE, WINDOWS}, None), people_folds(dataset, SPLIT, args.seed)
    done = {name: [scored(dataset, recipes, name, fold, args.seed) for fold in folds] for name in chosen}
    rows = [line(MODELS[name].title, rule, done[name], done[ANYWHERE]) for name in chosen for rule in RULES]
    print("| model | rule | false events per hour at recall 0.4 / 0.5 / 0.6 | F1 | minus ours, 95 % | recall "
          "| false per hour | latency, median | size | multiply-adds per second |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|")
    print(*(text for _, text in sorted(rows, reverse=True)), sep="\n")


if __name__ == "__main__":
    main()
