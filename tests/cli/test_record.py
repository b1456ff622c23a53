"""``plushsense record`` as a person and as a script meet it."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.recording.writer import SessionHead, read_events

Cli = Callable[..., Any]
COMMAND = [sys.executable, "-m", "plushsense", "record"]
URL = "virtual://?speed=0&lost=0&garbled=0&glitch=0"
KEYS = {
    "folder", "subject", "session", "recordings", "skipped", "redone", "rows", "lost", "malformed", "garbage",
    "reconnects", "gaps", "finished", "resumed",
}  # fmt: skip


def scripted(out: Path, keys: str, *words: str) -> subprocess.CompletedProcess[str]:
    """The verb with keys from a script."""
    return subprocess.run(
        [*COMMAND, str(out), "--device", "virtual://", "--speed", "20", "--subject", "S01", "--json", *words],
        input=keys, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip


def test_it_records_by_itself_and_says_what_came_of_it(cli: Cli, tmp_path: Path) -> None:
    ran = cli("record", tmp_path, "--device", URL, "--subject", "S01", "--protocol", "quick", "--auto", "1", "--json")
    assert ran.status == 0, ran.err
    assert set(ran.json) == KEYS
    assert {k: ran.json[k] for k in ("recordings", "skipped", "gaps", "finished", "resumed", "session")} == {
        "recordings": 4, "skipped": 0, "gaps": [], "finished": True, "resumed": False, "session": "1",
    }  # fmt: skip
    head = SessionHead.read(tmp_path / "S01" / "1")
    assert head is not None
    assert (head.simulated, head.protocol["name"], head.layout["name"]) == (True, "quick", "plush-15")
    assert "Stroke the toy's back" in ran.err
    ran = cli("record", tmp_path, "--device", URL, "--subject", "S01", "--protocol", "quick", "--auto", "1")
    assert "S01/2: 4 of 4 recorded." in ran.out.replace("\\", "/")


def test_keys_from_a_script(tmp_path: Path) -> None:
    done = scripted(tmp_path, " .. ntoo soft\nr . s . ", "--protocol", "quick")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    # One of two seconds, set aside and made again, the next skipped, then one more.
    assert (said["recordings"], said["redone"], said["skipped"], said["finished"]) == (2, 1, 1, False)
    events = list(read_events(tmp_path / "S01" / "1"))
    assert [e.details["text"] for e in events if e.kind == "note"] == ["too soft"]
    rows = [e.details["rows"] for e in events if e.kind == "take"]
    assert rows[0] >= 200
    done = scripted(tmp_path, " . ")
    said = json.loads(done.stdout)
    assert (said["recordings"], said["finished"], said["resumed"], said["session"]) == (3, True, True, "1")


def test_a_pause_from_a_script_breaks_the_recording_off(tmp_path: Path) -> None:
    done = scripted(tmp_path, " .pp . ", "--protocol", "quick")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["recordings"] == 1
    events = [e for e in read_events(tmp_path / "S01" / "1") if e.kind in ("abandon", "pause", "resume", "take")]
    assert [e.kind for e in events] == ["abandon", "pause", "resume", "take"]
    assert {e.details["gesture"] for e in events if e.kind in ("abandon", "take")} == {"Back stroke 1"}


def test_an_input_that_never_ends_does_not_hold_it_up(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*COMMAND, str(tmp_path), "--device", URL, "--subject", "S01", "--protocol", "quick", "--auto", "1", "--json"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None and process.stderr is not None
    assert process.wait(30) == 0
    assert json.loads(process.stdout.read())["finished"] is True
    assert "Fatal" not in process.stderr.read()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lets a pipe be made small")
def test_a_log_that_nobody_reads_holds_up_no_recording(tmp_path: Path) -> None:
    import fcntl

    out, err = os.pipe()
    fcntl.fcntl(err, 1031, 4096)  # F_SETPIPE_SZ, which Python 3.11 does not name on every system
    process = subprocess.Popen(
        [*COMMAND, str(tmp_path), "--device", URL, "--subject", "S01", "--auto", "1", "--json"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=err, text=True,
    )  # fmt: skip
    os.close(err)
    until = time.monotonic() + 60
    folder = tmp_path / "S01" / "1"
    while not any(e.kind == "finished" for e in read_events(folder)):
        assert time.monotonic() < until, f"only {len(list(folder.glob('*_*.csv')))} recordings"
        time.sleep(0.05)
    with os.fdopen(out, "rb") as log:
        said = log.read()
    assert len(said) > 4096, "there was too little to fill the pipe"
    assert json.loads(process.communicate(timeout=30)[0])["recordings"] == 51


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
def test_a_person_at_a_terminal(tmp_path: Path, pty_possible: None) -> None:
    import pty
    import termios

    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (24, 100))
    before = termios.tcgetattr(slave)
    process = subprocess.Popen(
        [*COMMAND, str(tmp_path), "--device", "virtual://", "--speed", "5", "--subject", "S01", "--protocol", "quick",
         "--words", "default", "--json"],
        stdin=slave, stderr=slave, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    shown = b""

    def until(text: str) -> None:
        nonlocal shown
        limit = time.monotonic() + 20
        while text.encode() not in shown:
            assert time.monotonic() < limit, shown[-2000:].decode("utf-8", "replace")
            if select.select([master], [], [], 0.1)[0]:
                shown += os.read(master, 65536)

    def press(keys: str) -> None:
        nonlocal shown
        shown = b""
        os.write(master, keys.encode())

    until("READY")
    until("Stroke the toy's back")
    press(" ")
    until("GET READY")
    until("RECORDING   1.")
    press(" ")
    until("1 of 4 recorded")
    press("nmöchte nicht\r")
    until("Note saved.")
    press("p")
    until("PAUSED")
    press("p\x1b[A")
    until("READY")
    press(" ")
    until("RECORDING")
    press("q")
    until("press q again to quit")
    press("q")
    assert process.stdout is not None
    said = json.loads(process.stdout.read())
    assert process.wait(10) == 0
    assert (said["recordings"], said["finished"]) == (1, False)
    assert termios.tcgetattr(slave) == before, "the terminal is as it was"
    os.close(master)
    os.close(slave)
    assert [e.details["text"] for e in read_events(tmp_path / "S01" / "1") if e.kind == "note"] == ["möchte nicht"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "hung up"])
def test_asked_to_end_while_recording(tmp_path: Path, pty_possible: None, name: str) -> None:
    """``kill``, or a window that is closed: all is written and the terminal is put back, as after Ctrl-C."""
    import fcntl
    import pty
    import termios

    def at_a_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup, around the tests, would have ignored

    master, slave = pty.openpty()  # of no size, as some are
    process = subprocess.Popen(
        [*COMMAND, str(tmp_path), "--device", "virtual://", "--speed", "5", "--subject", "S01", "--protocol", "quick"],
        stdin=slave, stderr=slave, stdout=subprocess.DEVNULL, start_new_session=True, preexec_fn=at_a_terminal,
    )  # fmt: skip
    os.close(slave)
    shown, limit = b"", time.monotonic() + 60
    while b"RECORDING" not in shown:
        assert time.monotonic() < limit
        assert process.poll() is None
        if select.select([master], [], [], 0.1)[0]:
            shown += os.read(master, 65536)
        if b"READY." in shown and b"GET READY" not in shown:
            os.write(master, b" ")
            time.sleep(0.3)
    if name != "hung up":
        process.send_signal(getattr(signal, name))
        shown = b""
        while b"what was recorded is kept" not in shown:
            assert time.monotonic() < limit + 30
            if select.select([master], [], [], 0.1)[0]:
                shown += os.read(master, 65536)
        assert b"\x1b[?1049l" in shown
        assert process.wait(10) == 130
    os.close(master)
    process.wait(10)
    events = list(read_events(tmp_path / "S01" / "1"))
    assert [e.kind for e in events][-2:] == ["abandon", "close"]
    stream = (tmp_path / "S01" / "1" / "fulldatastream.csv").read_bytes()
    assert stream.count(b"\n") == events[-1].details["rows"]
    assert not (tmp_path / "S01" / "1" / "session.lock").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--subject", "Anna Miller"], "never a name"),
        ([], "give --subject"),
        (["--subject", "S01", "--protocol", "plush17"], "Did you mean 'plush-17'"),
        (["--subject", "S01", "--words", "chld"], "Did you mean 'child'"),
        (["--subject", "S01", "--session", "../x"], "no name for a session"),
        (["--subject", "S01", "--speed", "-1"], "--speed is -1"),
        (["--subject", "S01", "--auto", "0"], "--auto is 0"),
        (["--subject", "S01", "--layout", "plush-16"], "plush-1"),
    ],
)
def test_what_cannot_be_is_one_sentence(cli: Cli, tmp_path: Path, words: list[str], said: str) -> None:
    ran = cli("record", tmp_path / "out", "--device", URL, *words)
    assert ran.status == 2
    assert said in ran.err
    assert len(ran.err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_toy_that_is_not_there_is_one_sentence(cli: Cli, tmp_path: Path) -> None:
    ran = cli("record", tmp_path / "out", "--device", "tcp://127.0.0.1:1", "--subject", "S01")
    assert (ran.status, "nobody listens" in ran.err) == (2, True)
    assert not (tmp_path / "out").exists()


def test_sessions_are_not_mixed(cli: Cli, tmp_path: Path) -> None:
    words = ["record", tmp_path, "--device", URL, "--subject", "S01", "--auto", "1"]
    assert scripted(tmp_path, " . ", "--protocol", "quick").returncode == 0
    ran = cli(*words, "--protocol", "rest")
    assert (ran.status, "begun with the protocol 'quick', not 'rest'" in ran.err) == (2, True)
    ran = cli(*words, "--words", "child")
    assert (ran.status, "--words goes with --protocol" in ran.err) == (2, True)
    ran = cli(*words, "--session", "1", "--new")
    assert (ran.status, "leave --new off" in ran.err) == (2, True)
    ran = cli(*words, "--protocol", "quick", "--new", "--json")
    assert (ran.status, ran.json["session"], ran.json["recordings"]) == (0, "2", 4)


def test_a_missing_consent_is_said_once(cli: Cli, tmp_path: Path, real_toy_url: str) -> None:
    words = ["record", tmp_path, "--device", real_toy_url, "--subject", "S01", "--protocol", "quick"]
    assert "No consent reference" in cli(*words).err
    assert "No consent reference" not in cli(*words).err
    assert "No consent reference" not in cli(*words, "--consent", "C-7").err
    head = SessionHead.read(tmp_path / "S01" / "1")
    assert head is not None
    assert (head.consent, head.simulated) == ("C-7", False)


@pytest.fixture
def real_toy_url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A toy that is not virtual: a stream that is played back."""
    from plushsense.recording.simulate import SimulationSpec, simulate

    out = tmp_path_factory.mktemp("sim") / "out"
    simulate(out, SimulationSpec(people=1, repetitions=1, at_rest=0, gestures=("Tail hit 1",)))
    return f"replay://{out / 'P01' / 'fulldatastream.csv'}"


def test_the_toy_alone_needs_no_subject(cli: Cli, tmp_path: Path) -> None:
    own = tmp_path / "rest.toml"
    own.write_text('name = "r"\ngesture_set = "plush-18"\ngestures = ["At rest"]\nrepetitions = 2\n')
    ran = cli("record", tmp_path / "out", "--device", URL, "--protocol", own, "--auto", "3", "--json")
    assert (ran.status, ran.json["subject"], ran.json["recordings"]) == (0, "none", 2)
