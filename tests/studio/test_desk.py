"""The desk without a browser: sessions that are begun, taken up and ended, and commands that come late."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from plushsense.apps.studio.desk import NO_CONSENT, PSEUDO, Desk, Sitting
from plushsense.apps.studio.house import House
from plushsense.core.errors import ConfigError, DatasetError, DeviceError, PlushSenseError
from plushsense.devices.virtual.device import VirtualDevice
from plushsense.recording.beginning import Wanted
from plushsense.recording.session import OpenSession
from plushsense.recording.sessionfile import read_events
from recording_pages import CALM, until

SPEED = 30.0
QUICK = Wanted(CALM, "S01", "quick", speed=SPEED)


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    """An empty studio's."""
    house = House(tmp_path, toy=CALM, speed=SPEED)
    made = house.part(Desk)
    yield made
    house.close()
    assert made.sittings() == []


def press(sitting: Sitting, key: str = " ") -> bool:
    """Upon what is to be seen now."""
    return sitting.press(key, sitting.status().seen)


def take(sitting: Sitting) -> None:
    """One recording of two seconds."""
    until(lambda: sitting.status().signal not in ("none", "unreadable"))
    assert press(sitting)
    until(lambda: sitting.status().state == "recording" and sitting.status().elapsed_s > 2)
    assert press(sitting)
    until(lambda: sitting.status().state in ("idle", "finished"))


def test_a_session_from_its_beginning_to_its_end(desk: Desk, tmp_path: Path) -> None:
    rung: list[int] = []
    loop = asyncio.new_event_loop()
    # In a thread of its own, as Playwright's loop may run in this one.
    hearing = threading.Thread(target=loop.run_forever)
    hearing.start()
    end = desk.bell.hear(lambda: rung.append(1), loop)
    sitting = desk.begin(QUICK)
    assert (sitting.name, sitting.head.simulated, sitting.notices, sitting.mended) == ("S01/1", True, (), ())
    assert desk.begin(QUICK) is sitting, "a second tab sits down beside the first"
    assert desk.resume("S01/1") is sitting
    assert desk.get("S01/1") is sitting
    toy = sitting.device.inner
    assert isinstance(toy, VirtualDevice)
    until(lambda: bool(rung))
    begun = len(rung)
    for _ in range(4):
        take(sitting)
    assert sitting.status().state == "finished"
    until(lambda: len(rung) > begun)
    end()
    loop.call_soon_threadsafe(loop.stop)
    hearing.join(10)
    loop.close()
    # The person does what is asked for; the last one may have been stopped before the hand came.
    asked = ["Back stroke 1", "Head stroke 1", "Hold strong", "Tail tap 1"]
    assert [p.label for p in toy.performed][:3] == asked[:3]
    assert [bool(s.file) for s in sitting.steps()] == [True] * 4
    # The tap sees what the recorder gets.
    assert sitting.device.ring.count == pytest.approx(sitting.status().rows, abs=400)
    # The next session of this person makes the finished one way.
    again = desk.begin(QUICK)
    assert (again.name, [s.name for s in desk.sittings()]) == ("S01/2", ["S01/2"])
    desk.close_sitting("S01/2")
    desk.close_sitting("S01/2")
    assert [(s.folder.name, s.finished) for s in desk.sessions()] == [("2", False), ("1", True)]
    with pytest.raises(ConfigError, match="finished"):
        desk.resume("S01/1")


def test_a_command_counts_once(desk: Desk, tmp_path: Path) -> None:
    sitting = desk.begin(QUICK)
    until(lambda: sitting.status().signal not in ("none", "unreadable"))
    seen = sitting.status().seen
    answers: list[bool] = []
    threads = [threading.Thread(target=lambda: answers.append(sitting.press(" ", seen))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [False] * 7 + [True]
    until(lambda: sitting.status().state == "recording")
    for stale in (seen, "", "recording.1.0.0.0"):
        assert not sitting.press(" ", stale)
    assert sitting.status().state == "recording"
    for key in ("x", "", "go:", "go:4", "go:-1", "q"):
        with pytest.raises(ConfigError, match="no command"):
            sitting.press(key, sitting.status().seen)
    assert press(sitting, "r")
    assert press(sitting, "go:2")
    assert sitting.status().step.number == 2
    assert press(sitting, "b")
    assert press(sitting, "p")
    assert sitting.status().state == "paused"
    assert press(sitting, "p")
    assert press(sitting, "s")
    assert [e.what for e in read_events(tmp_path / "recordings" / "S01" / "1")].count("countdown") <= 1


def test_two_tabs_begin_one_session(desk: Desk) -> None:
    made: list[Sitting] = []
    threads = [threading.Thread(target=lambda: made.append(desk.begin(QUICK, anew=True))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 4
    assert {id(s) for s in made} == {id(made[0])}
    assert len(desk.sessions()) == 1


def test_an_unfinished_session_is_gone_on_with(desk: Desk, tmp_path: Path) -> None:
    sitting = desk.begin(QUICK)
    take(sitting)
    press(sitting)
    until(lambda: sitting.status().state == "recording")
    desk.close_sitting("S01/1")
    with pytest.raises(ConfigError, match="S01 has an unfinished session, 1"):
        desk.begin(QUICK)
    assert desk.sittings() == []
    again = desk.resume("S01/1")
    assert (again.status().done, again.wanted.speed, again.wanted.device) == (1, SPEED, CALM)
    desk.close_sitting("S01/1")
    assert desk.begin(QUICK, anew=True).name == "S01/2"


def test_what_is_refused_leaves_nothing(desk: Desk, tmp_path: Path) -> None:
    outside = tmp_path.parent / "outside.toml"
    outside.write_text('name = "x"\ngesture_set = "plush-18"\n', encoding="utf-8")
    refused: list[tuple[Wanted, str]] = [
        (Wanted(CALM, "Anna", "quick"), "no code"),
        (Wanted(CALM, "../S01", "quick"), "no code"),
        (Wanted(CALM, "", "quick"), "Whose session"),
        (Wanted(CALM, "S01", str(outside)), "no protocol of this studio"),
        (Wanted(CALM, "S01", "quick", layout=str(outside)), "no layout of this studio"),
        (Wanted(CALM, "S01", "quick", words="xx"), "no wording"),
        (Wanted(f"{CALM}&layout={outside}", "S01"), "names a file"),
        (Wanted("replay:///etc/passwd", "S01"), "names a file"),
        (Wanted("/etc/passwd", "S01"), "names a file"),
        (Wanted("serial:///dev/nowhere", "S01"), "there is no port"),
        (Wanted("telepathy://x", "S01"), "no scheme"),
        (Wanted(CALM, "S01", speed=-1.0), "0 .* to 1000"),
    ]
    for wanted, said in refused:
        with pytest.raises(PlushSenseError, match=said):
            desk.begin(wanted)
    for name in ("S01/1", "../x", "..", "/etc", "S01", ""):
        with pytest.raises(ConfigError):
            desk.resume(name)
    assert desk.sittings() == []
    assert desk.sessions() == []


def test_a_users_own_protocol_and_layout(desk: Desk, tmp_path: Path) -> None:
    (tmp_path / "protocols").mkdir()
    own = tmp_path / "protocols" / "mine.toml"
    own.write_text('name = "mine"\ngesture_set = "plush-18"\ngestures = ["Tail pull"]\nrepetitions = 2\n', "utf-8")
    assert next(iter(desk.protocols())) == "plush-17"
    assert desk.protocols()[str(own)] == "mine.toml"
    assert "plush-14" in desk.layouts()
    sitting = desk.begin(Wanted(CALM, "S02", str(own), layout="plush-14", speed=SPEED))
    assert [s.step.gesture for s in sitting.steps()] == ["Tail pull"] * 2
    assert sitting.device.layout.name == "plush-14"
    desk.close_sitting("S02/1")
    # The protocol and the layout are the session's: the files may be gone.
    own.unlink()
    assert desk.resume("S02/1").device.layout.name == "plush-14"


def test_a_real_session_never_goes_on_with_a_virtual_toy(desk: Desk, tmp_path: Path) -> None:
    from plushsense.devices.toy import serve_tcp

    stop, ready, urls = threading.Event(), threading.Event(), list[str]()

    def on_ready(url: str) -> None:
        urls.append(url)
        ready.set()

    toy = threading.Thread(target=lambda: serve_tcp(0, on_ready=on_ready, stop=stop), daemon=True)
    toy.start()
    assert ready.wait(10)
    try:
        assert desk.speed_for(urls[0], False) == 1.0
        assert desk.speed_for(urls[0], True) == SPEED
        assert desk.speed_for("virtual://?speed=3", False) == 3.0
        sitting = desk.begin(Wanted(urls[0], "S03", "quick"))
        assert (sitting.head.simulated, sitting.notices) == (False, (NO_CONSENT,))
        desk.close_sitting("S03/1")
        with pytest.raises(DatasetError, match="begun with a real toy"):
            desk.resume("S03/1", CALM)
        assert desk.sittings() == []
        assert desk.resume("S03/1").name == "S03/1"
        desk.close_sitting("S03/1")
    finally:
        stop.set()
        toy.join(10)
    with pytest.raises(DeviceError):
        desk.resume("S03/1")
    assert PSEUDO == "pseudo"


def test_a_session_that_another_program_has(desk: Desk, tmp_path: Path) -> None:
    desk.begin(QUICK)
    desk.close_sitting("S01/1")
    held = OpenSession(tmp_path / "recordings" / "S01" / "1")
    try:
        with pytest.raises(DatasetError, match="Another program is recording"):
            desk.resume("S01/1")
        assert desk.sittings() == []
    finally:
        held.close()
    assert desk.resume("S01/1").status().state == "idle"
