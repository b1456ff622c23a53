"""A virtual person who is told what to do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from plushsense.core.layouts import load_layout
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.stream import LogPrompts, Prompt, ToySpec, ToyStream, VirtualDevice


def event(what: str, **more: object) -> str:
    return json.dumps({"what": what, "at_ms": 1} | more) + "\n"


def test_a_log_is_followed_from_now_on(tmp_path: Path) -> None:
    path = tmp_path / "session.jsonl"
    prompts = LogPrompts(path)
    assert prompts() is None
    path.write_text(event("open") + event("countdown", gesture="Tail pull", device_ms=5000, countdown_s=3.0))
    assert prompts() == Prompt("Tail pull", 8000)
    assert prompts() is None
    line = event("countdown", gesture="Hold strong", device_ms=None, countdown_s=3.0)
    with path.open("a") as file:
        file.write("no json\n" + line[:20])
        file.flush()
        assert prompts() is None
        file.write(line[20:])
    assert prompts() == Prompt("Hold strong", None)
    assert LogPrompts(path)() is None, "what was asked before is not made up for"


def test_the_hand_comes_when_the_recording_begins() -> None:
    """Asked two seconds before, the person waits for it; "At rest" is nobody's doing."""
    asked: list[Prompt] = []
    stream = ToyStream(ToySpec(lost=0.0, garbled=0.0), load_layout("plush-15"), lambda: asked.pop() if asked else None)
    begun, begin_ms = [], 0
    for n, line in enumerate(stream):
        if n == 300:
            begin_ms = line.device_ms + 3000
            asked.append(Prompt("Tail tap 2", begin_ms))
        if n == 2000:
            asked.append(Prompt("At rest"))
        if line.begins is not None:
            begun.append(line.begins)
        if n > 4000:
            break
    (performed,) = begun
    assert performed.label == "Tail tap 2"
    assert 0 < performed.start_ms - begin_ms < 2000


def test_without_cues_it_plays_as_it_always_did() -> None:
    layout = load_layout("plush-15")
    spec = ToySpec(person=3, seed=2)
    plain = [line.data for line, _ in zip(ToyStream(spec, layout), range(3000), strict=False)]
    with_noise = ToySpec(person=3, seed=2, glitch=spec.world.glitch)
    assert [line.data for line, _ in zip(ToyStream(with_noise, layout), range(3000), strict=False)] == plain


@pytest.mark.slow
def test_a_device_is_told() -> None:
    with open_device("virtual://?speed=0&lost=0&garbled=0") as device:
        assert isinstance(device, VirtualDevice)
        device.follow()
        for _ in range(5):
            device.read()
        assert device.performed == []
        device.perform("Hold strong")
        for _ in range(8):
            device.read()
        assert [p.label for p in device.performed] == ["Hold strong"]
