"""People who can be told apart, people who cannot, and what the report says of both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.store import Dataset
from plushsense.evaluation.reidentification import SEES, features, reidentify, report, verdict

pytestmark = [pytest.mark.usefixtures("publish_tools"), pytest.mark.apart("reidentification")]

ACCEL = load_layout("accel-3")


def people(
    folder: Path, *, style: float, hold: float, rates_ms: tuple[int, ...] = (10,) * 4, sessions: int = 1
) -> Dataset:
    """Four people; ``style`` is how much their tempo and force differ, ``hold`` how much the way they hold the toy."""
    rng = np.random.default_rng(7)
    for person in range(4):
        # Two groups of recordings stand in for two sessions: the same person, another way of holding.
        for number in range(24):
            session = number % sessions
            held = hold * np.random.default_rng([person, session]).normal(size=3)
            place = folder / "src" / f"P{person + 1}"
            place.mkdir(parents=True, exist_ok=True)
            rows = 1500 // rates_ms[person]
            t = np.arange(rows) * rates_ms[person] / 1000
            hz = 1 + 0.5 * style * person
            wave = (2000 + 900 * style * person) * np.sin(2 * np.pi * hz * t + rng.uniform(0, 6))
            noise = rng.normal(0, 200, (rows, 3))
            values = np.round(wave[:, None] * [1, 0.5, 0.2] + held + noise).astype(np.int64)
            clock = np.arange(rows, dtype=np.int64) * rates_ms[person] + 10_000 * number
            label = ("Pat", "Rub", "Shake")[number % 3]
            write_recording(
                place / recording_filename(label, 10**12 + number, rows), Frames(values, clock, clock + 10**12), ACCEL
            )
    made = import_recordings(folder / "src", folder / "DS", layout="accel-3").dataset
    if sessions > 1:
        for path in sorted((folder / "DS" / "recordings").rglob("*.csv")):
            number = int(path.stem.split("_")[-2]) - 10**12
            target = path.parent / f"s{number % sessions}" / path.name
            target.parent.mkdir(exist_ok=True)
            path.rename(target)
        (folder / "DS" / "index.json").unlink()
        made = open_dataset(folder / "DS")
    return made


def test_people_of_their_own_style_are_found_and_the_words_say_so(tmp_path: Path) -> None:
    found = reidentify(people(tmp_path, style=1.0, hold=0.0), trees=30)
    everything = found.find("recordings", "everything")
    assert everything is not None
    assert everything.top1["mean"] > 0.9
    assert (everything.people, everything.recordings, everything.chance) == (4, 96, 0.25)
    assert found.find("recordings", "movement").top1["mean"] > 0.9  # type: ignore[union-attr]
    said = verdict(found)
    assert "one more recording of a session and of gestures that it knows" in said
    assert "the right one of 4 people" in said
    assert "Of a gesture that it never saw, it is" in said
    assert "guessing would be right in 25" in said
    assert "must be treated as personal data" in said
    assert "nobody has more than one session" in said
    text = report(found)
    assert "P1 1.00" in text


def test_people_who_do_the_same_are_not_found(tmp_path: Path) -> None:
    found = reidentify(people(tmp_path, style=0.0, hold=0.0), trees=30)
    everything = found.find("recordings", "everything")
    assert everything is not None
    assert everything.top1["mean"] < 0.5
    assert everything.top5["mean"] == everything.chance5 == 1.0
    if everything.top1["ci95"][0] <= everything.chance:
        assert "no better than guessing, which is no proof of anonymity" in verdict(found)


def test_the_clock_alone_may_tell_and_movement_does_not_see_it(tmp_path: Path) -> None:
    found = reidentify(people(tmp_path, style=0.0, hold=0.0, rates_ms=(10, 11, 12, 13)), trees=30)
    assert found.find("recordings", "clock").top1["mean"] == 1.0  # type: ignore[union-attr]
    assert found.find("recordings", "movement").top1["mean"] < 0.6  # type: ignore[union-attr]
    assert "The sampling clock alone, nothing of the touch, tells 100 of 100" in verdict(found)
    assert "4 of them almost surely (P1, P2, P3, P4)" in verdict(found)


def test_people_of_one_clock_are_not_named_by_the_order_of_their_codes(tmp_path: Path) -> None:
    found = reidentify(people(tmp_path, style=0.0, hold=0.0, rates_ms=(10, 10, 10, 13)), trees=30)
    clock = found.find("recordings", "clock")
    assert clock is not None
    assert clock.clear == ["P4"]
    assert 0.4 < clock.top1["mean"] < 0.6
    assert max(clock.by_person[p] for p in ("P1", "P2", "P3")) < 0.7


@pytest.mark.exhaustive
def test_across_sessions_the_way_of_holding_does_not_help(tmp_path: Path) -> None:
    dataset = people(tmp_path, style=0.0, hold=4000.0, sessions=2)
    assert {r.session for r in dataset.recordings} == {"s0", "s1"}
    found = reidentify(dataset, trees=30)
    assert found.skipped == {}
    assert found.sessions == 8
    within, across = found.find("recordings", "everything"), found.find("sessions", "everything")
    assert within is not None
    assert across is not None
    assert within.top1["mean"] > 0.95
    assert across.top1["mean"] < 0.6
    assert "In a session that the program never saw it is right in" in verdict(found)
    assert "tried on those who came more than once: 4 of 4 people" in verdict(found)
    other = replace(found, gestures_of_one_person=("01",)).under({"P1": "PX"}, "gesture {}".format)
    assert other.gestures_of_one_person == ("gesture 01",)
    assert set(other.trials[0].by_person) == set(other.trials[0].precision) == {"PX", "P2", "P3", "P4"}
    assert "PX" in report(other)
    assert "P1 " not in report(other)


def test_the_same_seed_gives_the_same_figures(tmp_path: Path) -> None:
    dataset = people(tmp_path, style=0.3, hold=0.0)
    assert reidentify(dataset, trees=10).to_dict() == reidentify(dataset, trees=10).to_dict()


def test_excluded_recordings_and_a_single_person(tmp_path: Path) -> None:
    dataset = people(tmp_path, style=1.0, hold=0.0)
    append_marks(dataset.path, [Mark(r.id, "exclude", "me") for r in dataset.recordings if r.subject != "P1"])
    with pytest.raises(BadInput, match="--no-reidentification"):
        reidentify(open_dataset(dataset.path))


def test_features_of_a_known_wave() -> None:
    t = np.arange(400) / 100
    wave = np.round(1000 + 500 * np.sin(2 * np.pi * 2 * t)).astype(np.int64)
    frames = Frames(np.stack([wave, wave * 0 + 7, -wave], axis=1), np.arange(400, dtype=np.int64) * 10)
    seen = features(frames, ACCEL)
    assert seen is not None
    assert {k: len(v) for k, v in seen.items()} == {"everything": 28, "touch": 24, "movement": 24, "clock": 4}
    assert set(seen) == set(SEES)
    mean, sd, low, high, rms, energy, slow, quick = seen["touch"].reshape(8, 3)
    assert mean == pytest.approx([1000, 7, -1000], abs=0.1)
    assert sd == pytest.approx([500 / np.sqrt(2), 0, 500 / np.sqrt(2)], rel=1e-3)
    assert (low[0], high[0]) == (501, 1499)
    assert rms[1] == 7
    assert energy[1] == 400 * 49
    assert slow[0] < 1e-3 * quick[0]
    # The mean square of a sine.
    assert quick[0] == pytest.approx(500**2 / 2, rel=1e-3)
    assert np.abs(seen["movement"].reshape(8, 3)[0]).max() < 1e-6, "no level"
    assert features(frames.slice(0, 3), ACCEL) is None


def test_a_gesture_of_one_person_is_told(tmp_path: Path) -> None:
    dataset = people(tmp_path, style=1.0, hold=0.0)
    for number in range(2):
        target = dataset.path / "recordings" / "P2" / f"Salute_{10**12 + 900 + number}_150.csv"
        some = next(iter((dataset.path / "recordings" / "P2").glob("*.csv")))
        target.write_bytes(some.read_bytes().replace(b", 1", b", 2", 1 + number))
    found = reidentify(open_dataset(dataset.path), trees=10)
    assert found.gestures_of_one_person == ("Salute",)
    assert "that label alone names a person" in verdict(found)
