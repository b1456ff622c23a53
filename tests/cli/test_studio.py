"""``plushsense studio``: one sentence for what cannot be, and an orderly end."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from plushsense.cli.main import main
from plushsense.studio.app import serve
from support.traced import SocketTrace

needs_nicegui = pytest.mark.skipif(importlib.util.find_spec("nicegui") is None, reason="nicegui is not installed")


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What the verb says when it refuses: one sentence, nothing on standard output."""

    def run(*options: str) -> str:
        assert main(["studio", "--no-show", *options]) == 2
        told = capsys.readouterr()
        assert told.out == ""
        assert "Traceback" not in told.err
        assert len(told.err.strip().splitlines()) == 1
        return told.err

    return run


def test_options_that_cannot_be(refused: Callable[..., str], tmp_path: Path) -> None:
    home = str(tmp_path / "home")
    assert "--speed is 0" in refused("--home", home, "--speed", "0")
    assert "--speed is -1" in refused("--home", home, "--speed", "-1")
    assert "--speed is nan" in refused("--home", home, "--speed", "nan")
    assert "--port is 70000" in refused("--home", home, "--port", "70000")
    assert "--port is -1" in refused("--home", home, "--port", "-1")
    assert "no scheme 'http'" in refused("--home", home, "--device", "http://x")
    assert "nothing" in refused("--home", home, "--dataset", str(tmp_path / "nothing"))
    assert "is not a data set" in refused("--home", home, "--dataset", str(tmp_path))
    assert "There is no bundle" in refused("--home", home, "--model", str(tmp_path / "m.plush"))
    file = tmp_path / "file"
    file.write_text("x")
    assert "is a file" in refused("--home", str(file))
    assert not (tmp_path / "home").exists()


@needs_nicegui
def test_addresses_that_cannot_be(refused: Callable[..., str], tmp_path: Path) -> None:
    home = str(tmp_path / "home")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"cannot listen on 127.0.0.1, port {port}" in refused("--home", home, "--port", str(port))
    assert "cannot listen on 192.0.2.77" in refused("--home", home, "--host", "192.0.2.77", "--port", "0")
    assert "cannot listen on nowhere.invalid" in refused("--home", home, "--host", "nowhere.invalid")


def test_the_next_free_port_is_taken_by_default() -> None:
    try:
        with socket.create_server(("127.0.0.1", serve.PORT)):
            assert serve.PORT < serve._free_port("127.0.0.1", None) < serve.PORT + 20
    except OSError:
        assert serve._free_port("127.0.0.1", None) != serve.PORT
    assert serve._free_port("127.0.0.1", 0) > 0


def test_ipv6(tmp_path: Path) -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6 here")
    try:
        assert serve._free_port("::1", 0) > 0
    except Exception as cause:  # noqa: BLE001 (a machine may have IPv6 and no loopback of it)
        pytest.skip(str(cause))


def test_without_the_extra_the_command_is_told(
    refused: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "nicegui", None)
    said = refused("--home", str(tmp_path / "home"))
    assert 'pip install "plushsense[studio]"' in said or "plushsense[studio]" in said
    assert not (tmp_path / "home").exists()


class Running:
    """The verb in a process of its own."""

    def __init__(self, home: Path, *options: str, before: Sequence[str] = ()) -> None:
        command = [*before, sys.executable, "-m", "plushsense", "studio", "--home", str(home), "--no-show"]
        env = {k: v for k, v in os.environ.items() if not k.startswith(("NICEGUI_", "PYTEST_"))}
        self.process = subprocess.Popen(
            [*command, "--port", "0", *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=env,
            cwd=home.parent,
        )

    def end(self, timeout: float = 30.0) -> tuple[int, str, str]:
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=timeout)
        return self.process.returncode, out, err


@needs_nicegui
@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is sent otherwise there")
def test_it_answers_says_where_and_ends_on_ctrl_c(tmp_path: Path) -> None:
    trace = SocketTrace(tmp_path)
    one = Running(tmp_path / "home", "--json", before=trace.words)
    assert one.process.stdout is not None
    told = json.loads(one.process.stdout.readline())
    with urllib.request.urlopen(told["url"], timeout=60) as answer:
        assert answer.status == 200
    assert told["url"].startswith("http://127.0.0.1:")
    assert told["home"] == str((tmp_path / "home").resolve())
    second = Running(tmp_path / "home")
    _, err = second.process.communicate(timeout=60)
    assert second.process.returncode == 2
    assert "A studio is already running in" in err and len(err.strip().splitlines()) == 1
    status, out, err = one.end()
    assert (status, out) == (130, "")
    assert "Traceback" not in err
    # The folder is free again.
    third = Running(tmp_path / "home")
    assert third.process.stderr is not None
    assert "The studio is at  http://127.0.0.1:" in third.process.stderr.readline()
    assert third.end()[0] == 130
    # It waits until it can connect to itself. The page Home searched for toys, and nothing was sent.
    assert trace.used() == {"bind 127.0.0.1", "connect 127.0.0.1"}


@needs_nicegui
@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is sent otherwise there")
def test_over_ipv6_and_under_another_name(tmp_path: Path) -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError as cause:
        pytest.skip(f"no IPv6 loopback here: {cause}")
    one = Running(tmp_path / "home", "--json", "--host", "::1", "--name", "toybox.local")
    assert one.process.stdout is not None
    url = json.loads(one.process.stdout.readline())["url"]
    assert url.startswith("http://[::1]:")
    for headers in ({}, {"Host": "toybox.local"}):
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as answer:
            assert answer.status == 200
    assert one.end()[0] == 130


def test_the_memory_of_pages_that_were_left_is_freed_together(monkeypatch: pytest.MonkeyPatch) -> None:
    collected: list[int] = []
    monkeypatch.setattr(serve, "_COLLECT_S", 0.0)
    monkeypatch.setattr(serve.gc, "collect", lambda: collected.append(1))

    async def leave(pages: int) -> None:
        release = serve._release_memory()
        for left in range(2):
            for _ in range(pages):
                release()
            while len(collected) <= left:
                await asyncio.sleep(0)

    asyncio.run(leave(3))
    assert collected == [1, 1]
