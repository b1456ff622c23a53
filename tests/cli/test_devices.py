"""``plushsense devices``: the list, and a toy handed on to LSL, lost and found again, read by ``live``."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

COMMAND = [sys.executable, "-m", "plushsense"]


@pytest.fixture(scope="module")
def plush_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small network with random weights: what it says does not matter here."""
    from plushsense.core.gestures import load_gestures
    from plushsense.core.layouts import load_layout
    from plushsense.models.arch import Arch
    from plushsense.models.bundle import Bundle
    from plushsense.models.reference import random_weights
    from plushsense.windows.features import Scaler

    arch = Arch.parse("14d1_19d2", (4, 4))
    scaler = Scaler(np.zeros(11), np.full(11, 1e-3))
    bundle = Bundle(
        arch, random_weights(arch, 3), load_layout("plush-15"), scaler, load_gestures("plush-18")
    )  # fmt: skip
    return bundle.save(tmp_path_factory.mktemp("plush") / "m.plush")


@contextmanager
def beside(*words: str) -> Iterator[str]:
    """A verb that runs beside the test and says its URL."""
    process = subprocess.Popen([*COMMAND, *words, "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["url"]
    finally:
        process.terminate()
        process.wait(10)


def live(*words: str) -> dict[str, Any]:
    done = subprocess.run([*COMMAND, "live", *words], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stderr.splitlines()[-1])
    return summary


def test_the_list(cli: Any) -> None:
    ran = cli("devices", "--scan-s", 0.1, "--json")
    assert ran.status == 0
    assert ran.json["devices"][-1] | {"description": ""} == {
        "url": "virtual://?person=7", "kind": "virtual", "name": "virtual toy", "description": "",
    }  # fmt: skip
    assert isinstance(ran.json["notes"], list)
    assert "virtual://?person=7" in cli("devices", "--scan-s", 0.1).out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--scan-s", "0"], "accepted is above 0 to 600"),
        (["--layout", "plush-15"], "belong to --lsl-out"),
        (["--lsl-out", "tcp://localhost"], "tcp://host:port"),
    ],
)
def test_refusals(cli: Any, words: list[str], said: str) -> None:
    ran = cli("devices", *words)
    assert (ran.status, ran.out) == (2, "") and said in ran.err


@pytest.mark.usefixtures("lsl_possible")
def test_a_toy_handed_on_to_lsl_goes_away_and_comes_back(plush_bundle: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    name = f"relay {uuid.uuid4().hex[:8]}"
    toy = ("toy", "--tcp", port, "--speed", "5")
    with ExitStack() as first:
        url = first.enter_context(beside(*toy))
        with beside("devices", "--lsl-out", url, "--lsl-name", name) as stream:
            live("--device", stream, "--model", str(plush_bundle), "--seconds", "3")
            first.close()
            with beside(*toy):
                summary = live("--device", stream, "--model", str(plush_bundle), "--seconds", "3")
    assert summary["counters"]["frames"] > 250
