"""Streams of the lab streaming layer, in and out, in loopback."""

from __future__ import annotations

import itertools
import sys
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any

import pytest
from tests.support.sent_lines import NAMED, toy_of_lines

from plushsense.core.errors import ConfigError, DeviceError, MissingExtraError
from plushsense.core.layouts import Channel, CsvFormat, Layout, load_layout
from plushsense.devices.base import Device, Frame, ReconnectingDevice
from plushsense.devices.lsl import LslOutlet, forward, load_pylsl, name_url
from plushsense.devices.opening import open_device

PLUSH = load_layout("plush-15")
PHONE = load_layout("phone-6")
WIDE = Layout(
    name="wide",
    title="two wide channels",
    rate_hz=100.0,
    channels=(Channel("a", "V", "x"), Channel("b", "", "x")),
    wire=("a", "device_ms", "b"),
    derived=(),
    inputs=("a", "b"),
    csv=CsvFormat(("host_ms", "device_ms", "a", "b"), ("h", "d", "a", "b"), ","),
)
needs_lsl = pytest.mark.usefixtures("lsl_possible")


@pytest.fixture
def name() -> str:
    """A name that no other test, in this process or beside it, publishes under."""
    return f"plush-{uuid.uuid4().hex[:10]}"


def stream(name: str, labels: list[str] | int, kind: str = "double64", type_: str = "EEG", source: str = "s") -> Any:
    """A stream of some other program."""
    pylsl = load_pylsl()
    width = labels if isinstance(labels, int) else len(labels)
    info = pylsl.StreamInfo(name, type_, width, 100.0, kind, source + name)
    if not isinstance(labels, int):
        channels = info.desc().append_child("channels")
        for label in labels:
            channels.append_child("channel").append_child_value("label", label)
    return pylsl.StreamOutlet(info)


def take(device: Device, count: int, send: Callable[[], None] | None = None) -> list[Frame]:
    got: list[Frame] = []
    end = time.monotonic() + 10
    while len(got) < count:
        assert time.monotonic() < end
        if send is not None:
            send()
        got += device.read() or []
    return got


@needs_lsl
def test_out_and_in_again_exactly(name: str) -> None:
    big = 2**53
    frames = [Frame(0, t, (v, -v)) for t, v in zip((5, 15, 25, 40), (0, big, 123_456_789_012_345, -1), strict=True)]
    with LslOutlet(WIDE, name) as outlet, open_device(outlet.url, WIDE) as device:
        outlet.push(frames)
        got = take(device, 4)
        assert [(f.device_ms, f.values) for f in got] == [(f.device_ms, f.values) for f in frames]
        assert abs(got[0].host_ms - time.time() * 1000) < 5000
        assert (device.counters.frames, device.counters.garbage) == (4, 2)
    assert device.read() is None
    with LslOutlet(PHONE, name + "p") as outlet, open_device(outlet.url, PHONE) as device:
        outlet.push([Frame(0, 7, (1, -2, 3333, 199_999, -100_000, 0))])
        assert take(device, 1)[0].values == (1, -2, 3333, 199_999, -100_000, 0)


@needs_lsl
def test_the_stream_says_what_it_carries(name: str) -> None:
    pylsl = load_pylsl()
    with LslOutlet(PHONE, name):
        (found,) = pylsl.resolve_byprop("name", name, timeout=5)
        inlet = pylsl.StreamInlet(found, recover=False)
        info = inlet.info(timeout=5)
        channel, seen = info.desc().child("channels").child("channel"), []
        while not channel.empty():
            seen.append((channel.child_value("label"), channel.child_value("unit")))
            channel = channel.next_sibling()
        assert seen == [*((c.name, c.unit) for c in PHONE.channels), ("device_ms", "ms")]
        assert (info.type(), info.nominal_srate(), info.channel_count()) == ("Touch", 100.0, 7)
        assert info.desc().child("synchronization").child_value("can_drop_samples") == "true"


@needs_lsl
def test_time_stamps_are_even_and_never_run_back(name: str) -> None:
    pylsl = load_pylsl()
    with LslOutlet(WIDE, name) as outlet:
        (found,) = pylsl.resolve_byprop("name", name, timeout=5)
        inlet = pylsl.StreamInlet(found, recover=False)
        inlet.open_stream(timeout=5)
        begun = pylsl.local_clock()
        # In bursts, as a serial line hands them over; then the toy restarts.
        for burst in range(5):
            outlet.push([Frame(0, 100_000 + 10 * i, (1, 2)) for i in range(4 * burst, 4 * burst + 4)])
            time.sleep(0.04)
        ended = pylsl.local_clock()
        outlet.push([Frame(0, t, (1, 2)) for t in (100_200, 0, 10, 20)])
        stamps: list[float] = []
        while len(stamps) < 24:
            stamps += inlet.pull_chunk(timeout=0.2, max_samples=60)[1]
        steps = [b - a for a, b in itertools.pairwise(stamps)]
        assert begun - 0.031 < stamps[0] < begun + 1.0
        assert steps[:20] == pytest.approx([0.01] * 20, abs=1e-4)
        assert min(steps) >= 0.0
        assert stamps[-1] >= ended


@needs_lsl
@pytest.mark.parametrize("how", ["lsl://type:{type}", "lsl://source:src{name}", "lsl://name:{name}", "lsl://{name}"])
def test_a_stream_of_another_program(name: str, how: str) -> None:
    outlet = stream(name, ["b", "x", "a"], type_=f"T{name}", source="src")
    with open_device(how.format(name=name, type=f"T{name}"), WIDE) as device:
        stamps = [100.0, 100.0101, 100.0099, 100.03, 20.0, 20.01]
        for n, at in enumerate(stamps):
            outlet.push_sample([10.0 + n, 0.5, n], at)
        got = take(device, 6)
        assert [f.values for f in got] == [(n, 10 + n) for n in range(6)]
        # Stamps in ms; a hair back is held, a restart is not.
        assert [f.device_ms for f in got] == [100_000, 100_010, 100_010, 100_030, 20_000, 20_010]


@needs_lsl
def test_the_toys_own_clock_by_position_but_not_in_floats(name: str) -> None:
    wire = stream(name, 3, "int32")
    floats = stream(name + "f", 3, "float32")
    with open_device(f"lsl://{name}", WIDE) as device, open_device(f"lsl://{name}f", WIDE) as other:
        wire.push_sample([1, 777, 2], 50.0)
        floats.push_sample([1, 777, 2], 50.0)
        assert [(f.device_ms, f.values) for f in take(device, 1)] == [(777, (1, 2))]
        assert [(f.device_ms, f.values) for f in take(other, 1)] == [(50_000, (1, 2))]
        assert "its device_ms is float32" in other.notes[1]


@needs_lsl
def test_values_that_are_no_steps_are_counted_and_then_refused(name: str) -> None:
    outlet = stream(name, ["a", "b"])
    with open_device(f"lsl://{name}", WIDE) as device:
        for bad in (float("nan"), float("inf"), 0.5, 1e300):
            outlet.push_sample([1, bad], 1.0)
        outlet.push_sample([1, 2], 1.0)
        assert len(take(device, 1)) == 1
        assert device.counters.to_dict() == {"frames": 1, "lost": 0, "malformed": 4, "garbage": 0, "reconnects": 0}
    with open_device(f"lsl://{name}", WIDE) as device, pytest.raises(ConfigError, match="step that is small enough"):
        take(device, 1, lambda: [outlet.push_sample([0.25, 0.5], 2.0) for _ in range(50)] and None)


@needs_lsl
def test_refusals(name: str) -> None:
    with pytest.raises(DeviceError, match=f"no LSL stream has the name '{name}' within 0.3 s"):
        open_device(f"lsl://{name}?find_s=0.3")
    one = stream(name, 2, type_=f"T{name}")
    with pytest.raises(DeviceError, match=r"has 2 channels, and layout 'plush-15' needs 13.*\?layout="):
        open_device(f"lsl://{name}")
    with pytest.raises(DeviceError, match=f"there are .*{name}"):
        open_device(f"lsl://no-{name}?find_s=0.2")
    two = stream(name + "2", 2, type_=f"T{name}")
    with pytest.raises(DeviceError, match=f"fits 2 streams: open one of .*lsl://{name}2 on"):
        open_device(f"lsl://type:T{name}", WIDE)
    text = stream(name + "t", 2, "string")
    with pytest.raises(DeviceError, match="stream of texts"):
        open_device(f"lsl://{name}t", WIDE)
    del one, two, text


@needs_lsl
@pytest.mark.parametrize("sources", [("a", "b"), ("same", "same")])
def test_one_of_two_equal_toys_is_not_opened_at_random(name: str, sources: tuple[str, str]) -> None:
    outlets = [stream(name, ["a", "b"], source=source) for source in sources]
    with pytest.raises(DeviceError, match="fits 2 streams: open one of") as refused:
        open_device(f"lsl://{name}", WIDE)
    urls = sorted(part.partition(" on ")[0] for part in str(refused.value).partition("one of ")[2].split(", "))
    key = "source" if sources[0] != sources[1] else "uid"
    assert len(urls) == 2 and all(url.startswith(f"lsl://{key}:") for url in urls)
    with open_device(urls[0], WIDE) as one, open_device(urls[1], WIDE) as other:
        for value, outlet in enumerate(outlets):
            outlet.push_sample([value, value], 1.0)
        assert {take(one, 1)[0].values, take(other, 1)[0].values} == {(0, 0), (1, 1)}


@needs_lsl
def test_a_stream_with_other_labels_is_not_the_toy(name: str) -> None:
    gyroscope, unnamed = stream(name, ["gx", "gy"]), stream(name + "u", 2)
    with pytest.raises(DeviceError, match="its 2 channels are gx, gy, and those of layout 'wide' a, b"):
        open_device(f"lsl://{name}", WIDE)
    with open_device(f"lsl://{name}u", WIDE, reconnect=True) as device:
        assert device.notes == ("its channels have no names: its 2 values are taken for a, b, in this order",)
    del gyroscope, unnamed


@pytest.mark.parametrize(
    ("url", "error", "words"),
    [
        ("lsl://", DeviceError, "lsl://type:EEG"),
        ("lsl://type:", DeviceError, "names no LSL stream"),
        ("lsl://a%27b%22", DeviceError, "names no LSL stream"),
        ("lsl://x?baud=1", ConfigError, "find_s"),
    ],
)
def test_urls_that_are_refused(url: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        open_device(url)


def test_urls_of_names() -> None:
    assert name_url("Plush Bear") == "lsl://Plush%20Bear"
    assert name_url("type:EEG") == "lsl://name:type%3AEEG"


@needs_lsl
def test_odd_names(name: str) -> None:
    for odd in (f"type:{name}", f"{name}'s toy / 1?", f'"{name}"'):
        outlet = stream(odd, ["a", "b"])
        with open_device(name_url(odd), WIDE) as device:
            outlet.push_sample([1, 2], 1.0)
            assert len(take(device, 1)) == 1


@needs_lsl
def test_a_stream_that_ends_and_comes_back(name: str) -> None:
    outlet: Any = LslOutlet(WIDE, name)
    with open_device(outlet.url, WIDE) as plain, open_device(outlet.url, WIDE, reconnect=True) as device:
        assert isinstance(device, ReconnectingDevice)
        outlet.push([Frame(0, 10, (1, 2))])
        assert len(take(device, 1)) == len(take(plain, 1)) == 1
        outlet.close()
        with pytest.raises(DeviceError, match="went away"):
            list(plain)
        end = time.monotonic() + 10
        while device.state != "waiting":
            assert time.monotonic() < end
            device.read()
        with LslOutlet(WIDE, name) as again:
            while device.state != "connected":
                assert time.monotonic() < end + 10
                device.read()
            again.push([Frame(0, 20, (3, 4))])
            assert take(device, 1)[0].values == (3, 4)
        assert device.counters.frames == 2 and device.counters.reconnects == 1
        assert (device.gaps[0].device_ms_before, device.gaps[0].device_ms_after) == (10, 20)


@needs_lsl
def test_closing_from_another_thread_ends_the_frames(name: str) -> None:
    with LslOutlet(WIDE, name) as outlet:
        device = open_device(outlet.url, WIDE)
        threading.Timer(0.15, device.close).start()
        begun = time.monotonic()
        assert list(device) == []
        assert time.monotonic() - begun < 3


@needs_lsl
def test_forward_wants_the_same_channels(name: str) -> None:
    with (
        open_device("virtual://?speed=0&seconds=1") as device,
        LslOutlet(WIDE, name) as outlet,
        pytest.raises(ConfigError, match="plush-15.*wide"),
    ):
        forward(device, outlet)


@needs_lsl
def test_forward_warns_of_lines_that_cannot_be_read(name: str) -> None:
    warned: list[str] = []
    with toy_of_lines(NAMED) as device, LslOutlet(device.layout, name) as outlet:
        assert forward(device, outlet, warn=warned.append) == 0
    assert len(warned) == 1 and "it has names before the numbers" in warned[0]


@needs_lsl
def test_an_outlet_needs_a_name() -> None:
    with pytest.raises(ConfigError, match="needs a name"):
        LslOutlet(WIDE, " ")


def test_without_pylsl(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'plushsense\[lsl\]'"):
        open_device("lsl://x")
