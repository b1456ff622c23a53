"""People left out, before and after a personal touch: which recordings adapt, which test, and what is counted."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.experiments.adaptation import AdaptingResult, Predictor, try_adapting
from plushsense.live.adaptation import PersonalSpec
from plushsense.windows.cut import WindowSet
from support.fakes import plain_units

LABELS = ("hold", "tap", "hit")


def made(each: int = 4, people: tuple[str, ...] = ("A", "B"), rows: int = 100) -> tuple[WindowSet, dict[str, int]]:
    """One window a recording; the later a recording was made, the smaller its name. ``x`` holds its class."""
    ids, y, subject, begin = [], [], [], []
    for person in people:
        for k, label in enumerate(LABELS):
            for n in range(each):
                ids.append(f"{person}/{label}_{9 - n}")
                y.append(k)
                subject.append(person)
                begin.append(1000 * k + 200 * n)
    order = np.argsort(ids)
    ids, y, subject, begin = ([each[i] for i in order] for each in (ids, y, subject, begin))
    n = len(ids)
    place = np.array([(b, b + rows) for b in begin])
    windows = WindowSet(
        integers=np.repeat(np.array(y, dtype=np.int32)[:, None, None], 5, axis=2),
        units=plain_units(1),
        y=np.array(y, dtype=np.int64),
        labels=LABELS,
        affects=("none",) * 3,
        families=LABELS,
        recording=np.arange(n),
        recording_ids=tuple(ids),
        subject=np.array(subject),
        context=np.full(n, "stream"),
        stream=np.array([f"{s}/stream" for s in subject]),
        window_rows=place,
        recording_rows=np.array([(b + 50, b + 100) for b in begin]),
        rate_hz=100.0,
        inputs=("a",),
    )
    return windows, {i: 9 - int(i[-1]) for i in ids}


def says(classes: np.ndarray) -> np.ndarray:
    return np.eye(3)[classes]


def always_hold(windows: WindowSet) -> np.ndarray:
    return says(np.zeros(len(windows), dtype=int))


def truth(windows: WindowSet) -> np.ndarray:
    return says(windows.integers[:, 0, 0])


class Recorder:
    """An adaptation that remembers what it was given."""

    def __init__(self, reader: Predictor = truth, accepted: bool = True) -> None:
        self.given: list[WindowSet] = []
        self.reader, self.accepted = reader, accepted

    def __call__(self, own: WindowSet) -> Predictor | None:
        self.given.append(own)
        return self.reader if self.accepted else None


def tried(people: dict[str, tuple[Predictor, Recorder]]) -> AdaptingResult:
    windows, times = made()
    gains = [try_adapting(windows, who, *readers, times, 2) for who, readers in people.items()]
    return AdaptingResult("by-subject:2", False, "stream", 2, PersonalSpec(), tuple(g for g in gains if g is not None))


def test_all_choices_and_what_is_gained() -> None:
    adapt = Recorder()
    found = tried({"A": (always_hold, adapt), "B": (always_hold, adapt)})
    assert found.choices == 12 and len(adapt.given) == 12 and found.refused == 0.0
    assert all(len(own) == 6 and len(set(own.subject)) == 1 for own in adapt.given)
    means = {when: spread.mean for when, spread in found.score("accuracy").items()}
    assert means == pytest.approx({"before": 1 / 3, "after": 1.0, "gain": 2 / 3, "first": 2 / 3})
    assert found.score("macro_f1")["after"].mean == 1.0
    assert found.right == {"mean": 4.0, "worst_mean": 4.0, "worst": 4, "worse_people": 0, "worse_choices": 0.0}
    assert [row.subject for row in found.people] == ["A", "B"] and found.people[0].recordings == 6.0
    # The first choice is the first recordings by the clock.
    ids = made()[0].recording_ids
    assert {ids[r] for r in adapt.given[0].recording} == {f"A/{label}_{n}" for label in LABELS for n in (9, 8)}


def test_a_loss_is_counted_person_by_person_and_choice_by_choice() -> None:
    found = tried({"A": (truth, Recorder(always_hold)), "B": (always_hold, Recorder(truth))})
    assert found.right == {"mean": 0.0, "worst_mean": -4.0, "worst": -4, "worse_people": 1, "worse_choices": 0.5}


def test_what_is_refused_changes_nothing() -> None:
    found = tried({"A": (truth, Recorder(always_hold, False))})
    assert found.refused == 1.0 and found.right["mean"] == 0.0


def test_no_adapting_window_touches_a_tested_recording() -> None:
    windows, times = made(rows=300)  # windows reach into the next recording
    adapt, tested = Recorder(), []

    def reads(test: WindowSet) -> np.ndarray:
        tested.append(test)
        return always_hold(test)

    try_adapting(windows, "A", reads, adapt, times, 2)
    for own, test in zip(adapt.given, tested, strict=True):
        for first, last in test.recording_rows:
            assert not ((own.window_rows[:, 0] < last) & (first < own.window_rows[:, 1])).any()
    assert any(len(own) < 6 for own in adapt.given)


def test_too_few_recordings_to_test() -> None:
    windows, times = made(each=2)
    assert try_adapting(windows, "A", truth, Recorder(), times, 2) is None
