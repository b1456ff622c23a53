"""Events against truths: cases by hand after Ward et al. 2011, and what must hold of any."""

from __future__ import annotations

import json
import random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from plushsense.scoring.events import (
    UNNAMED,
    ErrorCosts,
    Interval,
    Tally,
    at_recall,
    cost,
    front,
    outside_insertions,
    overlaps,
    pooled,
    tally,
    uncovered_s,
)

pytestmark = pytest.mark.slow

HUG, HIT = "hug", "hit"
FAMILIES = {"hug": "hold", "squeeze": "hold", "stroke": "stroke", "hit": "blow"}
AFFECTS = {"hug": "positive", "squeeze": "positive", "stroke": "positive", "hit": "negative"}
KINDS = {label: (family, AFFECTS[label]) for label, family in FAMILIES.items()}


def at(start: float, stop: float, label: str = HUG) -> Interval:
    return Interval(start, stop, label)


def total(truths: list[Interval], events: list[Interval], late_s: float = 0.0) -> Tally:
    return pooled(tally(truths, events, late_s).values())


def test_a_hit_a_deletion_and_an_insertion() -> None:
    t = total([at(0, 2), at(10, 12)], [at(0.5, 2.5), at(20, 21)])
    assert (t.truths, t.hits, t.deletions, t.events, t.matched, t.insertions, t.outside) == (2, 1, 1, 2, 1, 1, 1)
    assert t.latencies == [0.5] and t.recall == t.precision == t.f1 == 0.5


def test_fragmentation() -> None:
    t = total([at(0, 10)], [at(1, 2), at(4, 5), at(8, 9)])
    assert (t.hits, t.fragmented, t.merged, t.fragmented_merged) == (1, 1, 0, 0)
    assert (t.matched, t.fragmenting, t.merging, t.fragmenting_merging) == (3, 3, 0, 0)
    assert t.latencies == [1.0]


def test_merge() -> None:
    t = total([at(0, 2), at(4, 6)], [at(1, 5)])
    assert (t.hits, t.merged, t.fragmented, t.merging, t.matched) == (2, 2, 0, 1, 1)
    assert t.latencies == [1.0, 0.0] and t.early == 1  # it lasted into the second, whose onset came later


def test_fragmented_and_merged() -> None:
    t = total([at(0, 2), at(4, 6)], [at(1, 5), at(5.5, 7)])
    assert (t.merged, t.fragmented_merged, t.fragmented) == (1, 1, 0)
    assert (t.fragmenting_merging, t.fragmenting, t.merging) == (1, 1, 0)


def test_a_wrong_label_is_a_deletion_and_a_confused_insertion() -> None:
    found = tally([at(0, 2)], [at(0.5, 1.5, HIT)], 0.0)
    assert found[HUG].deletions == 1 and found[HIT].insertions == found[HIT].confused == 1
    assert found[HIT].outside == 0 and pooled(found.values()).f1 == 0.0


def test_an_answer_may_come_late_but_not_after_the_next_of_its_kind() -> None:
    late = [at(2.8, 3.5)]
    assert total([at(0, 2)], late, 1.0).hits == 1
    assert total([at(0, 2)], late, 0.5).hits == 0
    assert total([at(0, 2)], [at(3.0, 4)], 1.0).hits == 0
    second = total([at(0, 2), at(2.5, 5)], late, 1.0)
    assert (second.hits, second.deletions, second.merged) == (1, 1, 0)
    assert total([at(0, 2), at(2.5, 5, HIT)], late, 1.0).hits == 1


def test_an_instant_counts_where_it_falls() -> None:
    assert total([at(1, 2)], [at(1, 1)]).hits == 1
    assert total([at(1, 2)], [at(2, 2)]).hits == 0
    assert total([at(1, 2)], [at(0, 1)]).hits == 0


def test_unnamed_is_neither_right_nor_wrong_but_false_where_nothing_was() -> None:
    t = total([at(0, 2)], [at(0.5, 1, UNNAMED), at(9, 10, UNNAMED)])
    assert (t.unnamed, t.insertions, t.deletions, t.matched) == (1, 1, 1, 0)
    assert t.precision == 0.0


@pytest.mark.parametrize(
    ("event", "affect", "charge"),
    [
        (at(0, 1, "hug"), "positive", 0.0),
        (at(0, 1, "squeeze"), "positive", 1.0),
        (at(0, 1, "stroke"), "positive", 2.0),
        (at(0, 1, "hit"), "negative", 5.0),
        (at(0, 1, UNNAMED), "positive", 1.0),
        (at(0, 1, UNNAMED), "negative", 5.0),
        (at(0, 1, UNNAMED), "none", 2.0),
        (at(30, 31, "hug"), "positive", 3.0 + 2.0),  # said for no reason, and the hug missed
    ],
)
def test_an_affect_error_costs_more_than_a_confusion_in_the_family(event: Interval, affect: str, charge: float) -> None:
    assert cost([at(0, 2)], [event], [affect], KINDS, late_s=0.0) == charge


def test_saying_it_again_costs_a_little() -> None:
    said = [at(0, 0.5), at(1, 1.5), at(1.6, 1.8)]
    assert cost([at(0, 2)], said, ["positive"] * 3, KINDS) == 1.0
    assert cost([at(0, 2)], said, ["positive"] * 3, KINDS, ErrorCosts(again=0.0)) == 0.0
    assert cost([at(0, 2)], [], [], KINDS) == ErrorCosts().missed


def test_uncovered_time() -> None:
    assert uncovered_s([(0, 10), (20, 30)], [(2, 4), (3, 5), (8, 22)]) == pytest.approx(20 - 3 - 2 - 2)
    assert uncovered_s([(0, 10)], []) == 10
    assert uncovered_s([(0, 10)], [(1, 6), (2, 3), (6, 7), (8, 9)]) == pytest.approx(3)


def test_front_and_what_stands_at_a_recall() -> None:
    points = [(0.5, 10.0), (0.7, 30.0), (0.6, 40.0), (0.4, 10.0), (0.9, 100.0)]
    assert [points[i] for i in front(points)] == [(0.5, 10.0), (0.7, 30.0), (0.9, 100.0)]
    assert at_recall(points, 0.6) == pytest.approx(20.0)
    assert at_recall(points, 0.5) == 10.0 and at_recall(points, 0.9) == 100.0
    assert at_recall(points, 0.45) is None and at_recall(points, 0.95) is None and at_recall([], 0.5) is None


def test_scores_of_a_tally_by_hand() -> None:
    t = Tally(truths=4, hits=3, fragmented=1, merged=1, fragmented_merged=2, events=7, matched=3, unnamed=1)
    t.insertions, t.confused, t.latencies = 3, 1, [0.1, 0.2, 0.9]
    assert (t.recall, t.precision, t.outside) == (0.75, 0.5, 2)
    assert t.f1 == pytest.approx(0.6)
    table = t.to_dict()
    assert (table["fragmentations"], table["merges"], table["outside"], table["truths"]) == (3, 3, 2, 4)
    assert (table["recall"], table["precision"], table["f1"]) == (t.recall, t.precision, t.f1)
    assert table["latency_s"] == {"median": 0.2, "p90": pytest.approx(0.2 + 0.8 * 0.7)}
    assert "latencies" not in table and json.dumps(table)
    assert Tally(events=2, unnamed=2).precision is None and Tally(events=2, unnamed=2).f1 == 0.0


def test_practice_is_matched_by_its_own_label_only() -> None:
    practice = [at(0, 5)]
    said = [at(1, 2), at(3, 4), at(2, 2.5, HIT), at(4, 4.5, UNNAMED), at(20, 21)]
    found = tally([], said, 0.0, practice)
    hug, hit, unnamed = found[HUG], found[HIT], found[UNNAMED]
    assert (hug.events, hug.matched, hug.practised, hug.insertions, hug.confused) == (3, 2, 2, 1, 0)
    assert (hug.truths, hug.hits, hug.deletions) == (0, 0, 0)
    assert (hit.insertions, hit.confused, hit.practised) == (1, 1, 0)
    assert (unnamed.events, unnamed.unnamed) == (1, 1)
    affects = ["positive", "positive", "negative", "none", "positive"]
    weights = ErrorCosts(confused=0.25, affect=0.5, outside=4.0, missed=100.0)
    assert cost([], said, affects, KINDS, weights, 0.0, practice) == 0.5 + 0.25 + 4.0
    assert cost([at(1, 2)], said[:2], affects[:2], KINDS, late_s=0.0, practice=practice) == 0.0


def test_each_category_of_error_has_its_cost() -> None:
    weights = ErrorCosts(again=1, family=2, confused=4, missed=8, outside=16, affect=32)

    def charge(event: Interval, affect: str, affect_of: dict[str, str] = AFFECTS) -> float:
        kinds = {label: (family, affect_of[label]) for label, family in FAMILIES.items()}
        return cost([at(0, 2)], [event], [affect], kinds, weights, 0.0)

    assert charge(at(0, 1, "stroke"), "none") == charge(at(0, 1, "hit"), "negative", AFFECTS | {"hug": "none"}) == 4
    assert charge(at(0, 1, "stroke"), "positive") == 4 and charge(at(0, 1, "squeeze"), "positive") == 2
    assert charge(at(0, 1, "hit"), "negative") == 32 and charge(at(0, 1, UNNAMED), "positive") == 2
    # The lowest cost over the truths to whose time an event belongs; a truth is right once.
    both = [at(0, 2), at(0, 2, HIT)]
    assert cost(both, [at(0, 1, HIT), at(1, 2, HIT)], ["negative"] * 2, KINDS, weights, 0.0) == 1


def test_events_beside_all_truths_are_listed() -> None:
    said = [at(0.5, 1), at(2.5, 3, HIT), at(20, 21)]
    assert outside_insertions([at(0, 2)], said, late_s=1.0) == said[2:]
    assert outside_insertions([at(0, 2)], said, late_s=0.0) == said[1:]
    assert outside_insertions([], said) == said


LABELS = st.sampled_from(["hug", "squeeze", "stroke", "hit"])
STARTS = st.integers(0, 60).map(lambda n: n / 2)


def intervals(labels: st.SearchStrategy[str], most: int = 9) -> st.SearchStrategy[list[Interval]]:
    one = st.tuples(STARTS, st.integers(0, 8), labels).map(lambda v: Interval(v[0], v[0] + v[1] / 2, v[2]))
    return st.lists(one, max_size=most)


TRUTHS = intervals(LABELS).map(lambda ts: [Interval(t.start_s, t.stop_s + 0.5, t.label) for t in ts])
EVENTS = intervals(st.one_of(LABELS, st.just(UNNAMED)))
LATE = st.sampled_from([0.0, 0.5, 1.0])


@given(TRUTHS, EVENTS, LATE)
def test_every_truth_and_every_event_is_counted_once(
    truths: list[Interval], events: list[Interval], late_s: float
) -> None:
    t = total(truths, events, late_s)
    assert t.hits + t.deletions == t.truths == len(truths)
    assert t.matched + t.insertions + t.unnamed == t.events == len(events)
    assert t.fragmented + t.merged + t.fragmented_merged <= t.hits == len(t.latencies)
    assert t.fragmenting + t.merging + t.fragmenting_merging <= t.matched
    assert (t.fragmented + t.fragmented_merged > 0) == (t.fragmenting + t.fragmenting_merging > 0)
    assert (t.merged + t.fragmented_merged > 0) == (t.merging + t.fragmenting_merging > 0)
    assert 0 <= t.outside <= t.insertions and min(t.latencies, default=0.0) >= 0.0


@example(
    [Interval(6.5, 7.0, "squeeze"), Interval(6.5, 9.0, "squeeze")], [Interval(9.0, 9.0, "")], 0.5, random.Random(0)
)
@given(TRUTHS, EVENTS, LATE, st.randoms())
def test_order_does_not_matter(
    truths: list[Interval], events: list[Interval], late_s: float, chance: random.Random
) -> None:
    def all_of(ts: list[Interval], es: list[Interval]) -> tuple[object, float]:
        found = {k: {**vars(t), "latencies": sorted(t.latencies)} for k, t in tally(ts, es, late_s).items()}
        said = [AFFECTS.get(e.label, "none") for e in es]
        return found, cost(ts, es, said, KINDS, late_s=late_s)

    before = all_of(truths, events)
    shuffled = chance.sample(truths, len(truths)), chance.sample(events, len(events))
    assert all_of(*shuffled) == before


def test_the_first_of_overlapping_truths_is_taken_first_in_whatever_order_they_are_given() -> None:
    truths = [Interval(0.0, 0.5, HUG), Interval(0.0, 1.5, HUG)]
    events = [Interval(0.2, 0.3, HUG), Interval(1.0, 1.1, HUG)]
    for given_truths in (truths, truths[::-1]):
        assert cost(given_truths, events, ["positive"] * 2, KINDS, late_s=0.0) == 0.0


@given(st.lists(st.tuples(st.integers(1, 6), LABELS), max_size=8))
def test_a_perfect_answer_has_no_error(pieces: list[tuple[int, str]]) -> None:
    truths, now = [], 0.0
    for length, label in pieces:
        truths.append(Interval(now, now + length, label))
        now += length + 2.5
    t = total(truths, truths, 1.0)
    assert t.hits == t.matched == len(truths) and t.deletions == t.insertions == 0
    assert t.fragmented == t.merged == t.fragmented_merged == t.early == 0
    assert set(t.latencies) <= {0.0}
    assert cost(truths, truths, [AFFECTS[t.label] for t in truths], KINDS) == 0.0


@given(TRUTHS, EVENTS, LATE)
def test_pooling_streams_is_adding_them(truths: list[Interval], events: list[Interval], late_s: float) -> None:
    far = 1000.0
    moved = (
        [Interval(i.start_s + far, i.stop_s + far, i.label) for i in truths],
        [Interval(i.start_s + far, i.stop_s + far, i.label) for i in events],
    )
    one = total(truths, events, late_s)
    both = total([*truths, *moved[0]], [*events, *moved[1]], late_s)
    twice = pooled([one, one])
    assert {**vars(both), "latencies": 0} == {**vars(twice), "latencies": 0}
    assert sorted(both.latencies) == pytest.approx(sorted(twice.latencies))
    assert Tally(**one.kept()) == one


@given(TRUTHS, EVENTS)
def test_more_patience_never_loses_an_overlap(truths: list[Interval], events: list[Interval]) -> None:
    assert (overlaps(truths, events, 0.0) <= overlaps(truths, events, 1.0)).all()
