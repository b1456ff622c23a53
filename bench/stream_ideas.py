"""Measure ideas for fewer false events on whole streams of people left out, with one resumable command.

    python bench/stream_ideas.py DS                 # after bench/streams.py DS --rows easy --seeds 0
    python bench/stream_ideas.py DS --rows easy,max-pooling

The data set, the folds, the networks and the decision settings are those of the row ``easy`` of bench/streams.py, whose
networks in DS/cache are used again. Finished folds are kept in DS/cache/stream-ideas.

``verified``: a logistic regression on running statistics of an event (after 10.1109/ICASSP.2018.8462227).
For at most `DELAY_S` after the network would report an event, it withholds the event until its score is high enough.
``max-pooling``: the network is trained further, in each gesture recording only at its most probable position.
``refined``: successive refinement (arXiv 2304.03416), with three factors: moved, like a gesture, which gesture.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from streams import RECALLS, ROWS, config_of
from torch import Tensor
from torch.nn import functional as F

import plushsense as ps
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY, Gesture, GestureSet
from plushsense.dataset.files import CACHE
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams import replay, systems
from plushsense.experiments.streams.replay import EventCounts, StreamTrace, read_streams
from plushsense.experiments.streams.run import Recipe, TrainStreams, recipes_for
from plushsense.experiments.streams.score import PeopleFold, people_folds
from plushsense.experiments.streams.systems import ANYWHERE, TARGETS, TunedPoint
from plushsense.jobs.journal import job_id
from plushsense.models.bundle import Bundle
from plushsense.models.net import Net
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import NO_GESTURE, ONE
from plushsense.runtime.fixed import integer_logits, smoothing_weight
from plushsense.runtime.trace import ReportedEvent, TraceReplayer
from plushsense.scoring.events import at_recall, overlaps
from plushsense.training.augment import Channels, augmentations
from plushsense.training.engine import Adam, Engine, Fast, Windows, slices
from plushsense.training.fast.net import FastNet, Fill
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import WindowSet
from plushsense.workflow.preparation import network_inputs_of, outside_streams, windows_for

Floats = NDArray[np.float64]
Scored = tuple[ReportedEvent, Floats, Floats]
VERSION = 1  # part of the name of a stored fold
CPU = torch.device("cpu")

# Verifier: time of the statistics before an event is reported, longest delay, settings of the events to learn from.
BEFORE_S, DELAY_S = 0.5, 0.3
LEARN_FROM = tuple(
    DecideSpec(0.3, enter, enter / 2, 2.0, least_s=0.0, end_s=0.3, hold_s=0.3) for enter in (0.25, 0.5, 0.75)
)
LEAST = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98)
LOW = 0.35
# Max-pooling: epochs, learning rate, distance of the positions in a recording.
EPOCHS, RATE, EVERY_S = 10, 0.0003, 0.2
# Refinement: an idle window is moved if an axis varies by more counts (standard deviation) in its last second.
MOVED = 250.0


class Verifier:
    """Scores of events by a logistic regression on their running statistics, learnt from the events of ``streams``."""

    def __init__(self, streams: Sequence[StreamTrace]) -> None:
        rows: list[Floats] = []
        right: list[bool] = []
        for stream in streams:
            truths, gestures = stream.truth.truths, stream.replayer.trace.gestures
            labels = np.array([t.label for t in truths])[:, None]
            for spec in LEARN_FROM:
                events = named_events(stream, spec)
                intervals = replay.gesture_intervals(events, gestures)
                same = overlaps(truths, intervals) & (labels == np.array([i.label for i in intervals])[None])
                rows += statistics(stream, spec, events)[1]
                right += same.any(axis=0).tolist()
            stream.replayer.clear_cache()
        self.learnt = f"{len(rows)} events, {np.mean(right):.2f} right"
        self._model = make_pipeline(StandardScaler(), LogisticRegression(C=0.1, max_iter=2000))
        self._model.fit(np.concatenate(rows), np.repeat(right, [len(r) for r in rows]))

    def scored(self, stream: StreamTrace, spec: DecideSpec) -> list[Scored]:
        """Return the events with the times at which each can be accepted, and the scores at these times."""
        events = named_events(stream, spec)
        if not events:
            return []
        times, rows = statistics(stream, spec, events)
        scores = self._model.predict_proba(np.concatenate(rows))[:, 1]
        return list(zip(events, times, np.split(scores, np.cumsum([len(r) for r in rows])[:-1]), strict=True))

    def count(self, stream: StreamTrace, spec: DecideSpec) -> EventCounts:
        """Return the counts with the least score in ``fitted`` of the settings; without one, those of all events."""
        if "least" not in spec.fitted:
            return count(stream, stream.replayer.events(spec))
        return count(stream, accepted(self.scored(stream, spec), spec.fitted["least"]))


def named_events(stream: StreamTrace, spec: DecideSpec) -> list[ReportedEvent]:
    """Return the counted events that name a gesture; the verifier withholds all others."""
    events = replay.counted_events(stream.truth, stream.replayer.events(spec))
    return [event for event in events if event.gesture != NO_GESTURE]


def accepted(scored: Sequence[Scored], least: float) -> list[ReportedEvent]:
    """Return the events whose score reaches ``least``, named at the first time at which it does."""
    return [replace(e, named_s=float(t[np.argmax(s >= least)])) for e, t, s in scored if (s >= least).any()]


def count(stream: StreamTrace, events: Sequence[ReportedEvent]) -> EventCounts:
    return replay.count_matches(stream.truth, events, stream.replayer.trace.gestures)


def statistics(
    stream: StreamTrace, spec: DecideSpec, events: Sequence[ReportedEvent]
) -> tuple[list[Floats], list[Floats]]:
    """Return times (n,) and statistics (n, S) of each event, for its first steps up to `DELAY_S`.

    The statistics are of the steps since `BEFORE_S` before the event was reported. Of the smoothed probability of its
    gesture: maximum, mean and last value; of its lead over the next class and of the idle probability: mean and last
    value; of the highest logit: mean and last value; mean entropy; number of steps since the report, and of those in
    which the gesture is the most probable; mean and variance of every logit; and the gesture.
    """
    replayer = stream.replayer
    trace, step_s = replayer.trace, replayer.step_s
    idle = next(k for k, g in enumerate(trace.gestures.gestures) if g.idle)
    before, most = round(BEFORE_S / step_s), round(DELAY_S / step_s)
    parts = [
        (trace.step_times_us(part) / 1e6, smoothed.shares / ONE, part.logits / 256)
        for part, smoothed in zip(
            trace.parts, replayer.smoothed(smoothing_weight(spec.smoothing_s, step_s)), strict=True
        )
    ]
    when, rows = [], []
    for event in events:
        times, shares, logits = next(p for p in parts if len(p[0]) and p[0][0] - 1e-6 <= event.named_s <= p[0][-1] + 1)
        at = int(np.searchsorted(times, event.named_s - 1e-6))
        stop = max(at + 1, min(at + most + 1, int(np.searchsorted(times, event.stop_s + 1e-6))))
        first = max(0, at - before)
        p, z, g = shares[first:stop], logits[first:stop], event.gesture
        lead = p[:, g] - np.delete(p, g, axis=1).max(axis=1)
        entropy = -(p * np.log(p + 1e-9)).sum(axis=1)
        best = p.argmax(axis=1) == g
        averaged = np.column_stack([p[:, g], lead, p[:, idle], z.max(axis=1), entropy, best, z, z**2])
        n = np.arange(1, len(p) + 1)[:, None]
        means = np.cumsum(averaged, axis=0) / n
        k = z.shape[1]
        means[:, -k:] -= means[:, -2 * k : -k] ** 2
        last = np.column_stack(
            [np.maximum.accumulate(p[:, g]), p[:, g], lead, p[:, idle], z.max(axis=1), n - at + first]
        )
        gesture = np.tile(np.eye(k)[g], (len(p), 1))
        rows.append(np.hstack([means, last, gesture])[at - first :])
        when.append(times[at:stop])
    return when, rows


def verified_points(
    tuning: Sequence[StreamTrace], specs: Sequence[DecideSpec], verifiers: Sequence[Verifier]
) -> list[TunedPoint]:
    """Score every setting with every least score of the verifier; ``verifiers`` has one for each stream.

    The least score is stored in ``fitted`` of the settings.
    """
    points = []
    for spec in specs:
        scored = [v.scored(stream, spec) for v, stream in zip(verifiers, tuning, strict=True)]
        for least in LEAST:
            n = EventCounts()
            for stream, events in zip(tuning, scored, strict=True):
                n.add(count(stream, accepted(events, least)))
            points.append(TunedPoint(replace(spec, fitted={"least": least}), n.recall, n.false_per_hour, n.f1))
    return points


def outcome(
    testing: Sequence[StreamTrace], points: Sequence[TunedPoint], verifier: Verifier | None = None
) -> dict[str, dict[str, Any]]:
    """Return the counts by person of the settings chosen from ``points`` for each target recall and the highest F1."""
    chosen = {str(target): systems.fewest(points, target) for target in TARGETS}
    chosen["balanced"] = systems.balanced(points)
    people: dict[int, dict[str, EventCounts]] = {}
    for point in {id(p): p for p in chosen.values()}.values():
        mine = people[id(point)] = {}
        for stream in testing:
            events = stream.replayer.events
            n = count(stream, events(point.spec)) if verifier is None else verifier.count(stream, point.spec)
            mine.setdefault(stream.truth.subject, EventCounts()).add(n)
    return {name: {person: vars(n) for person, n in people[id(p)].items()} for name, p in chosen.items()}


class _RefinedNet(FastNet):
    """A network whose loss is that of `refined_loss`."""

    @torch.no_grad()
    def step(self, fill: Fill, y: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        self._cut(len(y))
        passes, pooled = self._forward(fill)
        features = pooled * passes[-1].a + passes[-1].b
        logits = torch.addmm(self._dense_bias, features, self._dense.t())
        with torch.enable_grad():
            leaf = logits.clone().requires_grad_()
            loss = refined_loss(leaf, y)
            (slope,) = torch.autograd.grad(loss, leaf)
        self._dense.grad, self._dense_bias.grad = slope.t() @ features, slope.sum(0)
        self._backward(passes, pooled, slope @ self._dense)
        inputs = torch.cat([self._gradient(0, i) for i in range(len(self._edges))], dim=1) if self._passes_on else None
        return loss.detach(), logits, inputs


def refined_loss(logits: Tensor, y: Tensor) -> Tensor:
    """Return the mean of the three cross-entropies, each over the windows that reach its level.

    ``logits`` (N, K + 2): K gestures, moved, like a gesture; ``y``: K is idle and not moved, K + 1 idle and moved.
    """
    k = logits.shape[1] - 2
    moved, gesture = y != k, y < k
    level1 = F.binary_cross_entropy_with_logits(logits[:, k], moved.float(), reduction="sum")
    level2 = F.binary_cross_entropy_with_logits(logits[moved, k + 1], gesture[moved].float(), reduction="sum")
    return (level1 + level2 + F.cross_entropy(logits[gesture, :k], y[gesture], reduction="sum")) / len(y)


def combined(stream: StreamTrace, gestures: GestureSet) -> StreamTrace:
    """Return the stream with logits that give each gesture the product of its three factors, and idle the rest."""
    trace, k = stream.replayer.trace, len(gestures) - 1
    parts = []
    for part in trace.parts:
        z = torch.from_numpy(part.logits / 256)
        like = F.logsigmoid(z[:, k]) + F.logsigmoid(z[:, k + 1])
        rest = torch.log1p(-like.exp().clamp(max=1 - 1e-12))
        logs = torch.cat([like[:, None] + F.log_softmax(z[:, :k], dim=1), rest[:, None]], dim=1)
        parts.append(replace(part, logits=integer_logits(logs.numpy())))
    arch = replace(trace.arch, classes=k + 1)
    return replace(stream, replayer=TraceReplayer(replace(trace, arch=arch, gestures=gestures, parts=tuple(parts))))


def trained(
    windows: WindowSet, bundle: Bundle, recipe: Recipe, rates: Sequence[float], make: Callable[[Net], Engine],
    start: bool, choose: Callable[[Tensor], Tensor] | None = None,
) -> Bundle:  # fmt: skip
    """Train the network of ``bundle``, an epoch at each learning rate, on all windows or those that ``choose`` returns.

    ``start`` tells whether to begin with the weights of the bundle. ``choose`` gets the probabilities (N, K) of all
    windows.
    """
    spec, arch, scaler = recipe.training, bundle.arch, bundle.scaler
    x = Windows(scaler.apply(windows.integers[:, :, windows.integers.shape[2] - arch.span :]), arch, CPU)
    y = torch.from_numpy(windows.y.astype(np.int64))
    augment = augmentations(spec.augment, Channels(windows.vectors, scaler, CPU, arch.vector is not None))
    torch.manual_seed(spec.seed)
    net = Net(arch)
    if start:
        net.import_weights(bundle.weights)
    engine, order = make(net), torch.Generator().manual_seed(spec.seed)
    adam = Adam(engine.parameters, fused=True)
    for rate in rates:
        index = torch.arange(len(x)) if choose is None else choose(F.softmax(engine.logits(x), dim=1))
        index = index[torch.randperm(len(index), generator=order)]
        for at in slices(len(index), spec.batch):
            if len(index[at]) >= 8:
                engine.step(x, index[at], y[index[at]], augment, order)
                adam.step(rate)
    weights = engine.export_weights()
    engine.close()
    return replace(bundle, weights=weights)


def training_windows(dataset: Dataset, recipe: Recipe, fold: PeopleFold) -> WindowSet:
    cut = windows_for(dataset, recipe.arch, recipe.windows, recipe.gestures, anywhere=recipe.anywhere)
    mine = np.isin(cut.subject, [*fold.train, NOBODY])
    return cut.take(np.flatnonzero(mine & outside_streams(cut, dataset, {*fold.validation, *fold.test})))


def max_pooling(dataset: Dataset, recipe: Recipe, fold: PeopleFold, bundle: Bundle) -> Bundle:
    idle = next(k for k, g in enumerate(recipe.gestures.gestures) if g.idle)
    coarse = training_windows(dataset, recipe, fold)
    dense = replace(recipe.anywhere or AnywhereSpec(), every_s=EVERY_S)
    fine = training_windows(dataset, replace(recipe, anywhere=dense), fold)
    windows = fine.take(np.flatnonzero(fine.y != idle)).joined(coarse.take(np.flatnonzero(coarse.y == idle)))
    gestures, negatives = (np.flatnonzero(mask) for mask in (windows.y != idle, windows.y == idle))

    def choose(shares: Tensor) -> Tensor:
        right = shares.numpy()[gestures, windows.y[gestures]]
        by = gestures[np.lexsort((-right, windows.recording[gestures]))]
        _, first = np.unique(windows.recording[by], return_index=True)
        return torch.from_numpy(np.concatenate([by[first], negatives]))

    recordings = len(np.unique(windows.recording[gestures]))
    print(f"  {len(gestures)} positions of {recordings} recordings, {len(negatives)} idle", flush=True)
    rates = [RATE] * EPOCHS
    return trained(windows, bundle, recipe, rates, lambda net: Fast(net, recipe.training.batch, 1), True, choose)


def refined(dataset: Dataset, recipe: Recipe, fold: PeopleFold, bundle: Bundle) -> Bundle:
    k = len(recipe.gestures) - 1
    windows = training_windows(dataset, recipe, fold)
    moved = windows.integers[:, :3, -round(windows.rate_hz) :].std(axis=2).max(axis=1) > MOVED
    more = (Gesture("Moved", "none"), Gesture("Like a gesture", "none"))
    gestures = GestureSet(recipe.gestures.name, (*recipe.gestures.gestures[:k], *more), recipe.gestures.inferred)
    idle = windows.y == k
    print(f"  {len(windows)} windows, {idle.mean():.2f} idle, {moved[idle].mean():.2f} of these moved", flush=True)
    windows = replace(windows, y=np.where(idle & moved, k + 1, windows.y))
    untrained = Net(replace(bundle.arch, classes=k + 2)).export_weights()
    wide = replace(bundle, arch=replace(bundle.arch, classes=k + 2), gestures=gestures, weights=untrained)

    def make(net: Net) -> Engine:
        engine = Fast(net, recipe.training.batch, 1)
        engine._net = _RefinedNet(net, recipe.training.batch, 1)
        return engine

    rates = [recipe.training.learning_rate_at(epoch) for epoch in range(1, recipe.training.epochs + 1)]
    return trained(windows, wide, recipe, rates, make, False)


def fold_of(dataset: Dataset, name: str, recipe: Recipe, fold: PeopleFold, bundle: Bundle) -> dict[str, Any]:
    """Return the outcomes of a row in one fold, by the name of the choice of settings."""
    if name == "max-pooling":
        bundle = max_pooling(dataset, recipe, fold, bundle)
    if name == "refined":
        bundle = refined(dataset, recipe, fold, bundle)
    tuning, testing = (read_streams(dataset, bundle, people) for people in (fold.validation, fold.test))
    if name == "refined":
        tuning, testing = ([combined(s, recipe.gestures) for s in streams] for streams in (tuning, testing))
    points = systems.searched(tuning, systems.SYSTEMS[ANYWHERE])
    if name != "verified":
        return {name: outcome(testing, points)}
    result = {}
    learnt = {
        "training people": Verifier(read_streams(dataset, bundle, fold.train)),
        "validation people": Verifier(tuning),
    }
    for who, verifier in learnt.items():
        print(f"  {who}: {verifier.learnt}", flush=True)
        verifiers = [verifier] * len(tuning)
        if who == "validation people":
            verifiers = [Verifier([o for o in tuning if o.truth.subject != s.truth.subject]) for s in tuning]
        found = verified_points(tuning, [p.spec for p in points], verifiers)
        low = [p for p in found if p.spec.enter <= LOW]
        result[f"{name}, {who}, low threshold"] = outcome(testing, low, verifier)
        result[f"{name}, {who}"] = outcome(testing, [*points, *found], verifier)
    return result


def lines(title: str, folds: Sequence[dict[str, Any]], base: Sequence[dict[str, Any]]) -> str:
    """Return the figures of a row, and the ratio of its false events at recall 0.5 to ``base`` (95 % interval)."""
    best = EventCounts()
    for fold in folds:
        for n in fold["balanced"].values():
            best.add(EventCounts(**n))
    one, other = counts_of(folds), counts_of(base)
    false = [false_at(one, recall) for recall in RECALLS]
    people, ratios = one.shape[1], []
    for draw in np.random.default_rng(0).integers(0, people, size=(500, people)):
        values = [false_at(counts[:, draw], 0.5) for counts in (one, other)]
        ratios += [values[0] / values[1]] if values[0] and values[1] else []
    low, high = np.percentile(ratios, [2.5, 97.5]) if len(ratios) > 450 else (np.nan, np.nan)
    return (
        f"{title}: false an hour at recall {RECALLS}: {' / '.join('–' if v is None else f'{v:.0f}' for v in false)}; "
        f"ratio at 0.5 to easy {low:.2f} to {high:.2f}; best F1 {best.f1:.3f} (recall {best.recall:.2f}, "
        f"{best.false_per_hour:.0f} false an hour, median {np.median(best.latencies):.2f} s)"
    )


def counts_of(folds: Sequence[dict[str, Any]]) -> Floats:
    """Return hits, true gestures, false events and hours (targets, people, 4)."""
    names = ("hits", "truths", "insertions", "hours")
    rows = [
        [[n[name] for name in names] for fold in folds for _, n in sorted(fold[str(target)].items())]
        for target in TARGETS
    ]
    return np.array(rows, dtype=np.float64)


def false_at(counts: Floats, recall: float) -> float | None:
    """Return the false events per hour at a recall, over all people, interpolated between the targets."""
    hits, truths, false, hours = counts.sum(axis=1).T
    return at_recall(list(zip((hits / truths).tolist(), (false / hours).tolist(), strict=True)), recall)


def main() -> None:
    rows = ("easy", "verified", "max-pooling", "refined")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", metavar="DS")
    parser.add_argument("--rows", default=",".join(rows), help="rows to compute, joined by commas")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    chosen = ["easy", *(name for name in args.rows.split(",") if name != "easy")]
    if unknown := [name for name in chosen if name not in rows]:
        parser.error(f"there is no row {', '.join(unknown)}: accepted are {', '.join(rows)}")
    torch.set_num_threads(1)
    dataset, config = network_inputs_of(ps.open_dataset(args.dataset), config_of(ROWS["easy"], args.seed))
    recipe = recipes_for(dataset, config, {ANYWHERE}, None)[ANYWHERE]
    networks = TrainStreams({ANYWHERE: recipe}, False, dataset.path / CACHE / "stream-networks")
    base: list[dict[str, Any]] = []
    for name in chosen:
        folds = []
        for fold in people_folds(dataset, "by-subject:5", args.seed):
            key = {"version": VERSION, "row": name, "fold": vars(fold), "data": dataset.hash, **recipe.key()}
            path = dataset.path / CACHE / "stream-ideas" / f"{job_id(key)}.json"
            if not path.is_file():
                print(f"{name}, {fold.name}", flush=True)
                bundle = networks(dataset, fold, lambda *_: None).networks[ANYWHERE]
                result = fold_of(dataset, name, recipe, fold, bundle)
                path.parent.mkdir(parents=True, exist_ok=True)
                write_file(path, json.dumps(result))
            folds.append(json.loads(path.read_text(encoding="utf-8")))
        base = base or [fold[name] for fold in folds]
        for title in folds[0]:
            print(lines(title, [fold[title] for fold in folds], base), flush=True)


if __name__ == "__main__":
    main()
