"""Folds: who and what is kept apart, what leaks, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import ArrayError, BadInput, ConfigError
from plushsense.scoring.splits import EXAMPLES, Fold, Split, Splitter, make_folds, parse_split, purge

CLASSES = 4


def study(people: int, repetitions: int = 5, nobody: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Recordings of a study: each person makes each gesture some times; class 0 is nobody's."""
    subject = [f"P{p:02d}" for p in range(people) for _ in range(CLASSES * repetitions)] + ["none"] * nobody
    label = [k for _ in range(people) for k in range(CLASSES) for _ in range(repetitions)] + [0] * nobody
    return np.array(subject), np.array(label, dtype=np.int64)


def check_partition(folds: list[Fold], n: int, whole: bool = True) -> None:
    for fold in folds:
        parts = np.concatenate([fold.train, fold.validation, fold.test])
        assert sorted(parts) == list(range(n))
        assert min(len(fold.train), len(fold.validation), len(fold.test)) > 0
    if whole:
        tested = np.concatenate([fold.test for fold in folds])
        assert sorted(tested) == list(range(n))


@settings(max_examples=40)
@given(people=st.integers(3, 12), nobody=st.integers(0, 20), k=st.integers(2, 12), seed=st.integers(0, 99))
def test_subject_wise_folds_keep_whole_people_apart(people: int, nobody: int, k: int, seed: int) -> None:
    subject, label = study(people, repetitions=1, nobody=nobody)
    for text in ("leave-one-subject-out", f"by-subject:{k}"):
        split = parse_split(text)
        if (split.k or 2) > people or people - -(-people // (split.k or people)) < 2:
            with pytest.raises(BadInput):
                make_folds(split, subject, label, seed)
            continue
        folds = make_folds(split, subject, label, seed)
        check_partition(folds, len(subject))
        for fold in folds:
            sides = [set(subject[part]) - {"none"} for part in (fold.train, fold.validation, fold.test)]
            assert not (sides[0] & sides[1] or sides[0] & sides[2] or sides[1] & sides[2])
            assert sides[2] == set(fold.subjects)
            assert len(sides[1]) == max(1, round(0.15 * (people - len(fold.subjects))))


def test_leave_one_subject_out_names_each_person_once() -> None:
    subject, label = study(27)
    folds = make_folds(parse_split("leave-one-subject-out"), subject, label)
    assert [fold.name for fold in folds] == [f"P{p:02d}" for p in range(27)]
    assert all(len(set(subject[fold.validation])) == 4 for fold in folds)
    assert len({tuple(sorted(set(subject[fold.validation]))) for fold in folds}) > 20


def test_nobody_is_spread_over_train_validation_and_test() -> None:
    subject, label = study(25, nobody=51)
    folds = make_folds(parse_split("leave-one-subject-out"), subject, label)
    for fold in folds:
        rest = [int((subject[part] == "none").sum()) for part in (fold.train, fold.validation, fold.test)]
        assert rest[2] in (2, 3) and 6 <= rest[1] <= 9 and sum(rest) == 51
        assert "none" not in fold.subjects


def test_the_seed_decides_and_repeats() -> None:
    subject, label = study(10)
    for text in ("leave-one-subject-out", "by-subject:3", "by-recording:4", "windows:4", "windows:holdout"):
        split = parse_split(text)
        first, again, other = (make_folds(split, subject, label, seed) for seed in (1, 1, 2))
        assert all(np.array_equal(a.validation, b.validation) for a, b in zip(first, again, strict=True))
        assert not all(np.array_equal(a.validation, b.validation) for a, b in zip(first, other, strict=True))


def test_recordings_are_dealt_evenly_over_people_and_gestures() -> None:
    subject, label = study(6, repetitions=5)
    folds = make_folds(parse_split("by-recording:5"), subject, label)
    check_partition(folds, len(subject))
    for fold in folds:
        pairs = list(zip(subject[fold.test], label[fold.test], strict=True))
        assert len(set(pairs)) == len(pairs) == 6 * CLASSES
        assert set(label[fold.validation]) == set(range(CLASSES))


def test_windows_are_stratified_over_classes() -> None:
    rng = np.random.default_rng(0)
    label = rng.choice(CLASSES, size=1000, p=[0.7, 0.15, 0.1, 0.05]).astype(np.int64)
    subject = np.full(1000, "P01")
    split = parse_split("windows:5")
    assert split.leaky and not split.separates_people
    folds = make_folds(split, subject, label)
    check_partition(folds, 1000)
    share = np.bincount(label) / 5
    for fold in folds:
        assert np.abs(np.bincount(label[fold.test], minlength=CLASSES) - share).max() <= 1
        assert np.abs(np.bincount(label[fold.validation]) - 0.15 * 4 * share).max() <= 2


def test_holdout_is_the_papers_70_15_15() -> None:
    subject, label = study(10, repetitions=10)
    folds = make_folds(parse_split("windows:holdout"), subject, label)
    check_partition(folds, 400, whole=False)
    assert [len(p) for p in (folds[0].train, folds[0].validation, folds[0].test)] == [280, 60, 60]
    assert np.bincount(label[folds[0].test]).tolist() == [15] * CLASSES


def test_the_authors_script_takes_whole_recordings_in_the_order_of_the_files() -> None:
    subject, label = study(10, repetitions=10)
    numbers = np.random.default_rng(0).permutation(len(label))
    names = np.array([f"P01/Tail_{1_000_000 + n}_250" for n in numbers])
    fold = make_folds(parse_split("recordings:holdout"), subject, label, names=names)[0]
    check_partition([fold], len(label), whole=False)
    for one in range(CLASSES):
        parts = [np.sort(names[part[label[part] == one]]) for part in (fold.train, fold.validation, fold.test)]
        assert [len(part) for part in parts] == [70, 15, 15]
        assert parts[0][-1] < parts[1][0] and parts[1][-1] < parts[2][0]
    assert fold.name == "holdout, files by name"
    again, other = (make_folds(parse_split("recordings:holdout"), subject, label, s, names)[0] for s in (0, 1))
    assert again.test.tolist() == fold.test.tolist() == other.test.tolist()
    first, second = (make_folds(parse_split("recordings:random"), subject, label, seed, names)[0] for seed in (0, 1))
    check_partition([first], len(label), whole=False)
    assert np.bincount(label[first.test]).tolist() == [15] * CLASSES
    assert first.test.tolist() != second.test.tolist()


def test_a_class_of_two_recordings_is_not_scored() -> None:
    label = np.array([0] * 6 + [1] * 2, dtype=np.int64)
    fold = make_folds(parse_split("recordings:holdout"), np.full(8, "P01"), label)[0]
    assert fold.test.tolist() == [5] and fold.validation.tolist() == [4, 7]


def test_names_that_sort_by_person_are_shuffled_as_the_scripts_random_names_are() -> None:
    subject, label = study(25, repetitions=3)
    names = np.array([f"{who}/Tail_{1_700_000_000_000 + 60_000 * n}_250" for n, who in enumerate(subject)])
    split = parse_split("recordings:holdout")
    fold, again = (make_folds(split, subject, label, seed, names)[0] for seed in (0, 1))
    assert fold.name == "holdout, files shuffled" and fold.test.tolist() != again.test.tolist()
    both_sides = set(subject[fold.train]) & set(subject[fold.test])
    assert len(both_sides) > 20, "in the order of such names, nobody would be on both sides"


def test_every_member_of_the_authors_own_splits(authors_run: Path) -> None:
    made = np.load(authors_run / "outputs.npz")
    files = np.array([name.removesuffix(".csv") for name in made["files"].tolist()])
    gestures, nobody = np.unique(made["labels"]), np.full(300, "unknown")
    recordings = np.array([name.partition("/")[0] for name in files.tolist()])
    for split, names, labels, key in (
        ("windows:file-order", files[made["source"]], made["labels"], ""),
        ("recordings:holdout", files, recordings, "recordings_"),
    ):
        label = np.searchsorted(gestures, labels)
        fold = make_folds(parse_split(split), nobody[: len(label)], label, names=names)[0]
        for part in ("train", "validation", "test"):
            assert sorted(made[key + part].tolist()) == getattr(fold, part).tolist()


def test_the_sizes_that_the_authors_printed_of_their_own_recordings() -> None:
    counts = [51, 72, 73, 73, 75, 74, 74, 73, 74, 73, 75, 72, 72, 73, 74, 74, 74, 75]
    label = np.repeat(np.arange(18), counts)
    fold = make_folds(parse_split("recordings:holdout"), np.full(1301, "P01"), label)[0]
    assert [len(part) for part in (fold.train, fold.validation, fold.test)] == [912, 194, 195]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("by-subjekt:5", "Did you mean 'by-subject:5'"),
        ("leave-one-out", "leave-one-subject-out"),
        ("leave-one-subject-out:3", "leave-one-subject-out"),
        ("by-subject", "by-subject:5"),
        ("by-recording:1", "from 2"),
        ("windows:x", "windows:5"),
        ("windows:-2", "windows:5"),
        ("windows:²", "windows:5"),
        ("", "accepted are"),
    ],
)
def test_bad_splits_say_what_is_accepted(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match="accepted|needs a number") as refusal:
        parse_split(text)
    assert says in str(refusal.value) and f"'{text}'" in str(refusal.value)


@pytest.mark.parametrize("text", ["leave-one-subject-out", "by-recording:5", *EXAMPLES])
def test_a_split_says_itself(text: str) -> None:
    assert parse_split(text).text == text


def test_too_few_people_and_unknown_people_are_refused() -> None:
    subject, label = study(2)
    with pytest.raises(BadInput, match="needs at least 3 people.*there are 2 .P0.*by-recording"):
        make_folds(parse_split("leave-one-subject-out"), subject, label)
    subject, label = study(4)
    with pytest.raises(BadInput, match="needs at least 9 people"):
        make_folds(parse_split("by-subject:9"), subject, label)
    subject = subject.astype("U10")
    subject[:7] = "unknown"
    with pytest.raises(BadInput, match="7 lack it.*map.csv"):
        make_folds(parse_split("by-subject:3"), subject, label)
    assert make_folds(parse_split("by-recording:3"), subject, label)


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000))
def test_purge_keeps_exactly_what_touches_no_tested_row(seed: int) -> None:
    rng = np.random.default_rng(seed)
    streams = np.array(["a", "b", ""])

    def spans(n: int) -> tuple[np.ndarray, np.ndarray]:
        first = rng.integers(0, 60, n)
        rows = np.stack([first, first + rng.integers(1, 12, n)], axis=1)
        name = streams[rng.integers(0, 3, n)]
        rows[name == ""] = -1
        return name, rows

    stream, rows = spans(30)
    tested, tested_rows = spans(5)
    keep = purge(stream, rows, tested, tested_rows)
    for i in range(30):
        mine = set(range(*rows[i]))
        touches = any(
            stream[i] == tested[j] and mine & set(range(*tested_rows[j])) for j in range(5) if tested[j] != ""
        )
        assert keep[i] == (not touches)


def test_a_splitter_keeps_people_and_recordings_apart_and_says_what_it_lacks() -> None:
    people = np.repeat(["none", "P1", "P2", "P3"], 8)
    recordings, x, y = np.arange(32) // 2, np.zeros((32, 1, 9)), np.array(["a", "b"])[np.arange(32) // 2 % 2]
    splitter = Splitter("leave-one-subject-out", people, recordings)
    folds = list(splitter.split(x, y))
    assert len(folds) == splitter.get_n_splits() == 3
    for train, test in folds:
        assert sorted([*train, *test]) == list(range(32))
        assert not set(recordings[train]) & set(recordings[test])
        assert set(people[test]) - {"none"} and not set(people[train]) & set(people[test]) - {"none"}
    assert Splitter("by-recording:4", recordings=recordings).get_n_splits() == 4
    given = list(Splitter("by-subject:3").split(x[8:], groups=people[8:]))
    assert all(len(set(people[8:][test])) == 1 for _, test in given), "people that only the call names"
    for match, splitter, groups in (
        (r"groups has the shape \(31,\): expected \(32,\)", Splitter(groups=people[1:]), None),
        (r"recordings has the shape", Splitter(groups=people, recordings=recordings[1:]), None),
        (r"by-recording:4 must know which windows", Splitter("by-recording:4"), people),
        (r"leave-one-subject-out must know which windows", Splitter(), people),
        (r"needs to know who made each recording", Splitter(), None),
    ):
        with pytest.raises((ArrayError, BadInput), match=match):
            list(splitter.split(x, y, groups))


def test_a_split_knows_what_it_splits_and_what_it_needs() -> None:
    assert [parse_split(text).unit for text in ("windows:5", "by-recording:5")] == ["window", "recording"]
    assert [len(make_folds(Split(kind), *study(6))) for kind in ("by-subject", "by-recording")] == [5, 5]
    assert {text for text in EXAMPLES if parse_split(text).separates_people} == set(EXAMPLES[:2])
    assert parse_split("by-subject:2").k == 2 and parse_split("windows:1000").k == 1000
    with pytest.raises(ConfigError, match="from 2 to 1000"):
        parse_split("windows:1001")
    subject, label = study(3, repetitions=1)
    with pytest.raises(BadInput, match="got 12 people and 11 classes"):
        make_folds(parse_split("by-recording:5"), subject, label[1:])
    with pytest.raises(BadInput, match=r"by-subject:2 leaves one person to train and validate") as left:
        make_folds(parse_split("by-subject:2"), subject, label)
    assert "leaves one person" in str(left.value)
    for text, units in (("by-recording:5", 4), ("windows:4", 3), ("windows:holdout", 2), ("recordings:holdout", 2)):
        needed = int(text[-1]) if text[-1].isdigit() else 3
        split = parse_split(text)
        with pytest.raises(BadInput, match=f"{text} needs at least {needed} (windows|recordings); there are {units}"):
            make_folds(split, subject[:units], label[:units])
        assert make_folds(split, subject[:needed], label[:needed])
    with pytest.raises(BadInput, match="needs at least 3 recordings"):
        make_folds(parse_split("by-recording:2"), subject[:2], label[:2])


def test_folds_have_names_and_their_people() -> None:
    subject, label = study(4, repetitions=2)
    pairs = make_folds(parse_split("by-subject:2"), subject, label)
    assert [fold.name for fold in pairs] == ["fold 1", "fold 2"] and {len(fold.subjects) for fold in pairs} == {2}
    by_recording = make_folds(parse_split("by-recording:2"), subject, label)
    assert [(fold.name, len(fold.subjects)) for fold in by_recording] == [("fold 1", 4), ("fold 2", 4)]
    assert [fold.name for fold in make_folds(parse_split("windows:holdout"), subject, label)] == ["holdout"]
