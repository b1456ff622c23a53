"""Scenarios of the virtual toy: read strictly, and the same however they are played."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DeviceError
from plushsense.core.layouts import load_layout
from plushsense.devices.base import Frame, ReconnectingDevice
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.scenario import HumidityPoint, ScenarioPart, ToyScenario, load_scenario
from plushsense.devices.virtual.stream import Prompt, ToyLine, ToySpec, ToyStream, VirtualDevice
from plushsense.devices.virtual.world import CHANNELS

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
PLUSH = load_layout("plush-15")
QUIET = {"lost": 0.0, "garbled": 0.0, "glitch": 0.0}


def lines(scenario: ToyScenario, seed: int | None = None) -> list[ToyLine]:
    return list(ToyStream(ToySpec.of(scenario, seed), PLUSH))


def written(folder: Path, text: str) -> Path:
    path = folder / "own.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_same_seed_plays_the_same_and_another_does_not() -> None:
    scenario = load_scenario(EXAMPLES / "files" / "scenario.toml")
    one = lines(scenario)
    assert lines(scenario) == one
    assert b"".join(line.data for line in lines(scenario, seed=9)) != b"".join(line.data for line in one)


def test_people_take_turns_and_the_toy_goes_on() -> None:
    parts = (
        ScenarioPart("perform", 7, gestures=("Hold strong",)),
        ScenarioPart("idle", duration_s=2.0),
        ScenarioPart("handle", 12, repetitions=2),
        ScenarioPart("perform", gestures=("Tail hit 1",), repetitions=2),
    )
    scenario = ToyScenario(parts, repeat=2, **QUIET)
    assert scenario.people == (7, 7, 12, 12)
    played = lines(scenario)
    made = [line.begins for line in played if line.begins is not None]
    assert [(g.label, g.person) for g in made] == [("Hold strong", 7), ("Tail hit 1", 12), ("Tail hit 1", 12)] * 2
    assert set(np.diff([line.device_ms for line in played])) == {9, 10, 11}
    for gesture in made:
        inside = [line for line in played if gesture.start_ms <= line.device_ms <= gesture.end_ms]
        assert {line.person for line in inside} == {gesture.person}
        assert inside[0].begins == gesture
        assert (inside[0].passed_ms, inside[-1].passed_ms) == (
            round(1000 * gesture.start_s), round(1000 * gesture.end_s),
        )  # fmt: skip
    hands = [draw.person for draw in played]
    assert [hands[0], hands[-1]] == [7, 12] and sum(a != b for a, b in pairwise(hands)) == 3


def test_play_lasts_as_long_as_it_says_and_is_of_those_gestures() -> None:
    played = lines(ToyScenario((ScenarioPart("play", 3, 40.0, ("Back stroke 1", "Tail pull")),), **QUIET))
    made = [line.begins for line in played if line.begins is not None]
    assert [g.label for g in made] == (["Back stroke 1", "Tail pull"] * len(made))[: len(made)]
    assert 40.0 <= played[-1].passed_ms / 1000 < 60.0
    assert made[-1].start_s < 60.0
    mixed = lines(ToyScenario((ScenarioPart("play", 3, 120.0),), **QUIET))
    assert len({line.begins.label for line in mixed if line.begins is not None}) > 5


def test_the_weather_changes() -> None:
    def belly(*points: tuple[float, float]) -> np.ndarray:
        course = tuple(HumidityPoint(*point) for point in points)
        played = lines(ToyScenario((ScenarioPart("idle", duration_s=30.0),), humidity=course, **QUIET))
        return np.array([int(line.data.split()[CHANNELS.index("belly")]) for line in played])

    dry, humid = belly((0.0, -1.0)), belly((0.0, 1.0))
    assert np.median(humid) > np.median(dry) + 100
    rain = belly((0.0, -1.0), (10.0, -1.0), (20.0, 1.0))
    assert np.array_equal(rain[:900], dry[:900])
    assert np.array_equal(rain[2100:], humid[2100:])
    assert np.median(dry[1000:2000]) < np.median(rain[1000:2000]) < np.median(humid[1000:2000])


def read(device: VirtualDevice | ReconnectingDevice) -> list[tuple[int, tuple[int, ...]]]:
    return [(frame.device_ms, frame.values) for frame in device]


IDLE = "[[parts]]\ndo = 'idle'\n"
BREAKS = """
name = "breaks"
lost = 0.0
garbled = 0.0

[[parts]]
do = "perform"
gestures = ["Tail hit 1"]

[[parts]]
do = "idle"

[[faults]]
kind = "disconnect"
at_s = 2.0
duration_s = 2.0

[[faults]]
kind = "disconnect"
at_s = 10.0
duration_s = 0.5
"""


def test_a_device_url_plays_it_and_comes_back_after_a_lost_connection(tmp_path: Path) -> None:
    url = f"virtual://?scenario={written(tmp_path, BREAKS)}&speed=0"
    with open_device(url) as device:
        assert isinstance(device, VirtualDevice)
        got: list[Frame] = []
        with pytest.raises(DeviceError, match="went away"):
            for frame in device:
                got.append(frame)
        assert 1800 < got[-1].device_ms - got[0].device_ms < 2000
    with open_device(url, reconnect=True) as again:
        assert isinstance(again, ReconnectingDevice)
        frames = read(again)
        assert again.counters.reconnects == 2
        assert again.counters.lost == 0
        gaps = [(gap.device_ms_after or 0) - (gap.device_ms_before or 0) for gap in again.gaps]
        assert [round(gap, -2) for gap in gaps] == [2000, 500]
        assert isinstance(again.inner, VirtualDevice)
        assert [made.label for made in again.inner.performed] == ["Tail hit 1"]
    whole = [line for line in lines(load_scenario(tmp_path / "own.toml")) if line.data]
    assert [ms for ms, _ in frames] == [line.device_ms for line in whole]


def test_a_scenario_that_ends_while_disconnected_is_not_played_again(tmp_path: Path) -> None:
    path = written(tmp_path, BREAKS.replace("duration_s = 0.5", "duration_s = 1000.0"))
    with open_device(f"virtual://?scenario={path}&speed=0", reconnect=True) as device:
        frames = []
        for frame in device:
            frames.append(frame.device_ms)
            assert len(frames) < 3000
    assert frames == sorted(frames)


def test_a_toy_with_an_end_is_played_ahead(tmp_path: Path) -> None:
    url = f"virtual://?scenario={written(tmp_path, IDLE)}&speed=0"
    read_of = []
    for ahead in (False, True):
        with open_device(url) as device:
            assert isinstance(device, VirtualDevice)
            if ahead:
                device.play_ahead()
            read_of.append(read(device))
    assert read_of[0] == read_of[1] and len(read_of[0]) > 900


def test_prompts_replace_the_parts_and_faults_go_on() -> None:
    scenario = load_scenario(EXAMPLES / "files" / "scenario.toml")
    asked = [Prompt("Tail pull")]
    stream = ToyStream(ToySpec.of(scenario), PLUSH, lambda: asked.pop() if asked else None)
    made, sent = [], 0
    for line in stream:
        made += [line.begins.label] if line.begins is not None else []
        sent += line.connected
        if line.passed_ms > 60_000:
            stream.prompts = None
            break
    assert made == ["Tail pull"]
    assert 5600 < sent < 5760, "disconnected for three seconds"


def test_a_prompted_gesture_begins_in_time_by_a_clock_that_was_reset() -> None:
    scenario = ToyScenario((ScenarioPart("idle"),), wrap_s=5.0, **QUIET)
    asked: list[Prompt] = []
    stream = ToyStream(ToySpec.of(scenario), PLUSH, lambda: asked.pop() if asked else None)
    begins = None
    for n, line in enumerate(stream):
        if n == 600:
            asked.append(Prompt("Tail tap 2", line.device_ms + 3000))
            asked_ms = line.device_ms
        if line.begins is not None:
            begins = line.begins
            break
    assert begins is not None
    assert 0 < begins.start_ms - asked_ms - 3000 < 2000


def test_worked_scenarios_are_whole() -> None:
    paths = sorted((EXAMPLES / "scenarios").glob("*.toml"))
    assert len(paths) == 3
    for path in paths:
        scenario = load_scenario(path)
        assert scenario.name == path.stem and scenario.title


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[part]]\ndo = 'idle'", "Unknown key 'part' in scenario '.*own.toml'.*Did you mean 'parts'"),
        ("parts = []", "there is no part: add"),
        ("[[parts]]\ndo = 'sleep'", r"parts\[0\]: do is 'sleep'; accepted are idle, perform, play, handle"),
        ("[[parts]]\ndo = 'idle'\ngestures = ['Tail pull']", "a part that does 'idle' has no gestures"),
        ("[[parts]]\ndo = 'play'\ngestures = ['Tail pul']", "no gesture 'Tail pul'.*Did you mean 'Tail pull'"),
        ("[[parts]]\ndo = 'idle'\nduration_s = 'long'", "accepted is a number"),
        ("[[parts]]\ndo = 'idle'\nhumid = 1", r"Unknown key 'humid' in scenario '.*', parts\[0\]"),
        ("[[parts]]\ndo = 'idle'\n[[faults]]\nkind = 'lost'", r"faults\[0\].at_s is missing"),
        ("[[parts]]\ndo = 'idle'\n[[humidity]]\nat_s = 3\nlevel = 9", "level is 9; accepted are -3 to 3"),
        ("parts = ", "is not valid TOML"),
    ],
)
def test_a_bad_file_is_one_sentence(text: str, words: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=words) as refusal:
        open_device(f"virtual://?scenario={path}")
    assert "\n" not in str(refusal.value)


def test_a_missing_file_and_settings_that_the_scenario_has(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="There is no scenario file"):
        open_device("virtual://?scenario=nowhere.toml")
    path = written(tmp_path, BREAKS)
    for key, value in (("person", "7"), ("gestures", "Tail pull"), ("session", "3")):
        with pytest.raises(ConfigError, match=f"the scenario says the {key}; leave {key} out"):
            open_device(f"virtual://?scenario={path}&{key}={value}")
    with open_device(f"virtual://?scenario={path}&speed=0&seed=4&lost=0.5&seconds=1.5") as device:
        assert 50 < len(read(device)) < 110  # type: ignore[arg-type]
