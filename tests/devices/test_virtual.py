"""The virtual toy: repeatable, plausible, with people who differ and look-alikes that look alike."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.devices.base import Frame
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.motions import AT_REST, MOTIONS, split_label
from plushsense.devices.virtual.session import GESTURES, VirtualSession
from plushsense.devices.virtual.stream import ToySpec, ToyStream, VirtualDevice
from plushsense.devices.virtual.world import CHANNELS, WORLD, ZONES, draw_person

pytestmark = pytest.mark.apart("real-recordings")

PLUSH = load_layout("plush-15")


def recording(label: str, person: int, number: int = 0) -> NDArray[np.int64]:
    """One recording as the recorder would cut it, (n, 13)."""
    episode = VirtualSession(draw_person(person), number=number).perform(label)
    mark = episode.marks[0]
    return episode.values[mark.record_start : mark.record_stop]


def zone(values: NDArray[np.int64], name: str) -> NDArray[np.int64]:
    return values[:, CHANNELS.index(name)]


def test_gestures_are_those_of_the_paper() -> None:
    labels = load_gestures("plush-18").labels
    assert (AT_REST, *GESTURES) == labels
    assert {split_label(g)[0] for g in GESTURES} == set(MOTIONS)
    assert PLUSH.names == CHANNELS


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    def head(spec: ToySpec) -> bytes:
        lines = iter(ToyStream(spec, PLUSH))
        return b"".join(next(lines).data for _ in range(1500))

    assert head(ToySpec(person=4, seed=9)) == head(ToySpec(person=4, seed=9))
    others = [ToySpec(person=5, seed=9), ToySpec(person=4, seed=8), ToySpec(person=4, seed=9, session=1)]
    assert len({head(s) for s in [ToySpec(person=4, seed=9), *others]}) == 4


def test_people_differ() -> None:
    people = [draw_person(n) for n in range(1, 60)]
    assert {p.group for p in people} == {"child", "teen", "adult"}
    children = [p.hand for p in people if p.group == "child"]
    adults = [p.hand for p in people if p.group == "adult"]
    assert np.mean(children) < 0.85 < 0.95 < np.mean(adults)
    for name in ("force", "tempo", "scratch_hz", "tap_hz", "grip", "lap"):
        assert np.std([getattr(p, name) for p in people]) / np.mean([getattr(p, name) for p in people]) > 0.1
    assert draw_person(7) == draw_person(7) != draw_person(7, seed=2)


def test_raw_integers_are_plausible() -> None:
    values = np.concatenate([recording(g, p) for g in GESTURES for p in (1, 2)])
    for name in ZONES:
        assert 100 < np.median(zone(values, name)) < 4000
        assert zone(values, name).max() < 12_000
    rest = VirtualSession(draw_person(1)).idle(5.0).values
    magnitude = np.sqrt((rest[:, 10:].astype(float) ** 2).sum(axis=1))
    assert abs(np.median(magnitude) - 16384) < 600


@pytest.mark.parametrize(
    ("label", "most", "least"),
    [
        ("Head stroke 1", "head", "tail"),
        ("Neck scratch 1", "neck", "tail"),
        ("Ear scratch 1", "ears", "tail"),
        ("Back stroke 1", "back", "nose"),
        ("Tail tap 1", "tail", "head"),
        ("Tail pull", "tail", "nose"),
        ("Hold strong", "belly", "tail"),
    ],
)
def test_the_touched_electrode_answers(label: str, most: str, least: str) -> None:
    for person in (2, 3):
        values = recording(label, person).astype(float)
        rise = {z: np.percentile(zone(values, z), 95) - WORLD.baseline[ZONES.index(z)] for z in (most, least)}
        assert rise[most] > 2 * max(rise[least], 50)


def test_hits_shake_and_taps_do_not() -> None:
    def shake(label: str) -> float:
        peaks = []
        for person in range(1, 11):
            acc = recording(label, person)[:, 10:].astype(float)
            peaks.append(np.abs(np.sqrt((acc**2).sum(axis=1)) / 16384 - 1).max())
        return float(np.median(peaks))

    assert shake("Tail hit 1") > 5 * shake("Tail tap 1")
    assert shake("Hold in hands") > 2 * shake("Head stroke 1")


def test_look_alikes_overlap_between_people() -> None:
    """Scratches press more evenly than taps on the whole, but one person's tap is another's scratch."""

    def evenness(label: str) -> NDArray[np.float64]:
        tails = []
        for person in range(1, 31):
            episode = VirtualSession(draw_person(person)).perform(label)
            mark = episode.marks[0]
            tails.append(zone(episode.values, "tail")[mark.start + 20 : mark.stop - 20])
        return np.array([np.percentile(t, 10) / np.percentile(t, 90) for t in tails])

    tap, scratch = evenness("Tail tap 1"), evenness("Tail scratch 1")
    assert np.median(tap) < np.median(scratch) - 0.03
    border = np.median(np.concatenate((tap, scratch)))
    assert 0.15 < np.mean(np.concatenate((tap > border, scratch < border))) < 0.45


def test_on_a_steadied_table_and_on_the_lap_feel_the_same() -> None:
    """The electrodes that a holding hand covers part most of 1 from 2, but not all."""

    def held(label: str) -> NDArray[np.float64]:
        return np.array([np.median(zone(recording(label, p), "belly")) for p in range(1, 41)])

    table, hands = held("Head stroke 1"), held("Head stroke 2")
    border = np.median(np.concatenate((table, hands)))
    assert 0.05 < np.mean(np.concatenate((table > border, hands < border))) < 0.4


def test_durations_and_reaction_times() -> None:
    rows: dict[str, list[int]] = {g: [] for g in GESTURES}
    for person in range(1, 16):
        session = VirtualSession(draw_person(person))
        for g in GESTURES:
            mark = session.perform(g).marks[0]
            assert mark.record_start < mark.start < mark.stop < mark.record_stop
            rows[g].append(mark.record_stop - mark.record_start)
    assert 350 < np.median(rows["Back stroke 1"]) < 550
    for short in ("Tail hit 1", "Tail hit 2", "Tail pull"):
        assert 120 < np.median(rows[short]) < 300


def test_the_room_drifts() -> None:
    session = VirtualSession(draw_person(1))
    belly = zone(session.idle(600.0).values, "belly").astype(float)
    minutes = belly.reshape(10, -1).mean(axis=1)
    assert np.ptp(minutes) > 4 * WORLD.noise_counts
    days = [zone(VirtualSession(draw_person(p)).idle(2.0).values, "belly").mean() for p in range(1, 30)]
    assert np.std(days) > 40


def test_the_clock_jitters_and_joins() -> None:
    session = VirtualSession(draw_person(1))
    episodes = [session.idle(1.0), session.perform("Tail hit 2", 2), session.handle(), session.perform(AT_REST)]
    clock = np.concatenate([e.device_ms for e in episodes])
    assert set(np.diff(clock)) == {9, 10, 11}
    assert [e.first for e in episodes] == list(np.cumsum([0] + [len(e) for e in episodes[:-1]]))
    delays = np.concatenate([e.delay_ms for e in episodes])
    assert np.array_equal(np.diff(clock), delays[1:])


def test_episodes_join_without_a_jump() -> None:
    """The toy stands after an episode as it stands before the next: gravity does not jump."""
    session = VirtualSession(draw_person(2))
    before = session.perform("Hold in hands", 2)
    for nxt in (session.perform("Tail tap 1"), session.perform("Back stroke 2"), session.handle(), session.idle(1)):
        a, b = before.values[-20:, 10:].mean(axis=0), nxt.values[:20, 10:].mean(axis=0)
        assert np.abs(a - b).max() < 250
        before = nxt


def test_glitches_are_garbage() -> None:
    world = dataclasses.replace(WORLD, glitch=0.05)
    values = VirtualSession(draw_person(1), world=world).idle(20.0).values
    assert 50 < np.sum(np.any(values[:, :10] < -2000, axis=1)) < 170


def test_device_runs_in_process() -> None:
    with open_device("virtual://?person=7&seed=1&speed=0&seconds=30&lost=0.01&garbled=0.01") as device:
        frames = list(device)
        assert isinstance(device, VirtualDevice)
        assert isinstance(frames[0], Frame)
        assert device.performed
    assert len(frames) == device.counters.frames == pytest.approx(3000 * 0.98, rel=0.02)
    assert device.counters.malformed > 5
    assert device.counters.frames + device.counters.lost == pytest.approx(3000, abs=10)


@pytest.mark.parametrize(("layout", "channels"), [("plush-14", 13), ("accel-3", 3)])
def test_other_layouts(layout: str, channels: int) -> None:
    with open_device(f"virtual://?speed=0&seconds=5&lost=0&garbled=0&layout={layout}") as device:
        frames = list(device)
    with open_device("virtual://?speed=0&seconds=5&lost=0&garbled=0") as device:
        whole = list(device)
    assert len(frames) == len(whole)
    assert [f.values for f in frames] == [f.values[-channels:] for f in whole]
    assert [f.device_ms - frames[0].device_ms for f in frames] == [f.device_ms - whole[0].device_ms for f in whole]


def test_real_time_pace_and_closing() -> None:
    import time

    start = time.monotonic()
    with open_device("virtual://?speed=1&seconds=0.5") as device:
        assert len(list(device)) == pytest.approx(50, abs=3)
    assert 0.4 < time.monotonic() - start < 1.5


def test_unknown_gesture() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'Tail pull'"):
        VirtualSession(draw_person(1)).perform("Tail pul")
    with pytest.raises(ConfigError, match="share"):
        ToySpec(lost=1.5)


def test_played_ahead_it_sends_the_same() -> None:
    heard = []
    for ahead in (False, True):
        with open_device("virtual://?person=4&seed=2&seconds=3&speed=0") as device:
            assert isinstance(device, VirtualDevice)
            if ahead:
                device.play_ahead()
            heard.append([frame.values for frame in device])
    assert heard[0] == heard[1]
    assert len(heard[0]) > 250


def test_a_toy_without_an_end_is_not_played_ahead() -> None:
    with open_device("virtual://?person=4") as device, pytest.raises(ConfigError, match="give it seconds="):
        assert isinstance(device, VirtualDevice)
        device.play_ahead()
