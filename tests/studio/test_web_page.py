"""The page of an export in a real Chromium, with a stand-in for the serial port: what it reads, decides and saves.

Each thing is compared with the Python that defines it, on the same bytes.
"""

from __future__ import annotations

import base64
import csv
import gzip
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.gestures import AFFECTS, gesture_set_names, load_gestures
from plushsense.core.layouts import Layout, layout_names, load_layout
from plushsense.core.recorder_csv import read_recording, read_stream, recording_filename
from plushsense.deploy.code import IMAGE, facts_of
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.wasm import WEB, module
from plushsense.deploy.web import PAGE, web_files
from plushsense.devices.base import Counters, Frame
from plushsense.devices.ble import UART_SERVICE, UART_TX
from plushsense.devices.opening import open_device
from plushsense.devices.wire import LineParser
from plushsense.live.reactions import EYES, Reactor, load_reactions
from plushsense.models.bundle import Bundle
from plushsense.runtime.classifier import IntegerClassifier
from plushsense.runtime.image import IntegerModel
from plushsense.studio.app.words import Words
from plushsense.windows.clock import LONG_PAUSE_MS
from support.browsing import KEPT, PHONE, Look, Studio, axe, english, keep_picture, marked
from support.exports import bundle_of, exported
from support.requirements import LONG
from support.sent_lines import format_line

# What navigator.serial is to the page: a port whose bytes the test sends.
_PORT = """() => {
  let sink;
  const port = { open: async (how) => { port.how = how }, close: async () => {}, setSignals: async () => {},
    readable: new ReadableStream({ start(made) { sink = made } }) };
  window.portOptions = () => port.how;
  window.sendBytes = (text) => sink.enqueue(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  window.breakPort = () => { port.readable = null; sink.error(new Error('The device has been lost.')) };
  Object.defineProperty(navigator, 'serial', { value: { requestPort: async () => port } });
  window.answers = [];
  addEventListener('plushsense', ({ detail: { toy } }) => {
    toy.onAnswer = (a) => answers.push([a.ms, a.state, a.kind, a.affect, a.gesture, a.confidence]);
  });
}"""
_NO_RADIO = "() => Object.defineProperty(navigator, 'bluetooth', { value: undefined })"
_PLUSH = load_layout("plush-15")
GAP = 40_000


@dataclass
class Opened:
    """A page, and the model in it."""

    page: Any
    model: IntegerModel
    look: Look

    def connect(self) -> None:
        """Press the button of the cable."""
        self.page.click("#serial")
        self.page.wait_for_function("() => document.body.classList.contains('running')")

    def send(self, data: bytes, size: int = 5000) -> None:
        """Have the port send bytes, in pieces, and wait until all are read."""
        pieces = [base64.b64encode(data[at : at + size]).decode() for at in range(0, len(data), size)]
        self.page.evaluate(
            "async (all) => { for (const p of all) { sendBytes(p); await new Promise(setTimeout) } }", pieces
        )

    def text(self, name: str) -> str:
        """The text of an element."""
        return str(self.page.inner_text(f"#{name}"))

    def until(self, name: str, text: str) -> None:
        """Wait for a text in an element."""
        wait = "([name, text]) => document.getElementById(name).textContent.includes(text)"
        self.page.wait_for_function(wait, arg=[name, text])


@pytest.fixture(scope="session")
def trained(furniture: Path) -> Bundle:
    """A network whose events are many."""
    return Bundle.load(furniture / "bundles" / "little.plush")


@pytest.fixture
def pages(look: Callable[..., Look], tmp_path: Path) -> Iterator[Callable[..., Opened]]:
    """``pages(layout)`` opens the page of a small model from a file, without a network; it may not ask for anything."""
    seen: list[tuple[Look, Path]] = []

    def new(bundle: Bundle | str = "plush-15", radio: str = _NO_RADIO, **how: Any) -> Opened:
        bundle = bundle if isinstance(bundle, Bundle) else bundle_of(bundle)
        model = integer_model(bundle)
        image = model.to_bytes()
        file = tmp_path / "index.html"
        content = web_files(
            bundle, facts_of(model, bundle, image), image, module(calibrate=bool(bundle.layout.self_calibration))
        )
        file.write_bytes(next(text for name, text in content.items() if name == PAGE))
        looking = look(own=True, **how)
        looking.context.set_offline(True)
        page = looking.context.new_page()
        page.set_viewport_size({"width": looking.size[0], "height": looking.size[1]})
        for event, note in (("console", looking._log), ("pageerror", looking._fail)):
            page.on(event, note)
        page.add_init_script(f"({_PORT})(); ({radio})()")
        page.goto(file.as_uri())
        seen.append((looking, file))
        return Opened(page, model, looking)

    yield new
    for looking, file in seen:
        assert looking.complaints == []
        assert set(looking.asked) == {file.as_uri()}
        looking.asked.clear()


def _stream(layout: Layout, seconds: float, person: int = 3) -> list[Frame]:
    with open_device(f"virtual://?person={person}&seed=2&speed=0&seconds={seconds}&layout={layout.name}") as device:
        return list(device)


def _bytes(layout: Layout, frames: list[Frame]) -> bytes:
    return b"".join(format_line(layout, f.values, f.device_ms, 10) for f in frames)


def _answers(classifier: IntegerClassifier, frames: list[Frame]) -> tuple[list[Any], list[Any]]:
    """Steps and events as the page has them, but times by the toy's clock as far as the clock is not reset."""
    first, steps, events = frames[0].device_ms, [], []
    reactor = Reactor(load_reactions("standard"))
    kinds = {"sure": "sure gesture", "affect": "sure affect"}
    labels = classifier.gestures.labels
    for frame in frames:
        for d in classifier.push(frame):
            reacted = [(r.eyes, r.sound) for r in reactor.push(d)]
            for e in d.events:
                what = (e.kind, e.number, e.gesture or "", e.affect, e.source.replace("cnn", "network"))
                events.append((*what, " ".join(reacted.pop()) if reacted and e.kind == "begun" else ""))
            if d.source == "cnn" and d.state == "tracking":
                kind = kinds.get(d.answer or "", d.answer)
                steps.append(
                    [
                        int(d.t_s * 1e6 + 0.5) // 1000 + first,
                        d.state,
                        kind,
                        d.affect,
                        labels.index(d.gesture or ""),
                        d.confidence,
                    ]
                )
    return steps, events


def test_the_page_decides_as_live_int8_on_the_same_bytes(pages: Callable[..., Opened], trained: Bundle) -> None:
    """With damaged lines, a gap, pieces cut anywhere, and a page that is held up while bytes wait."""
    opened = pages(trained)
    frames = _stream(_PLUSH, 28)
    late = [Frame(f.host_ms, f.device_ms + GAP, f.values) for f in frames[2000:]]
    data = _bytes(_PLUSH, frames[:2000]) + b"1 2 3\nnoise \xff\n" + _bytes(_PLUSH, late)
    opened.connect()
    assert opened.page.evaluate("() => portOptions().baudRate") == 115_200
    half = len(_bytes(_PLUSH, frames[:850]))
    opened.send(b"4 5 6\n" + data[:half], 997)
    if KEPT:
        opened.page.wait_for_function("() => document.getElementById('face').dataset.eyes === 'green'")
    keep_picture(opened.page.screenshot(), "page-desk-light-en", 960)
    # A tab in the background: nothing runs for longer than a silence, then all that has come at once.
    waiting = base64.b64encode(data[half:]).decode()
    hold = "(bytes) => { sendBytes(bytes); const at = performance.now(); while (performance.now() - at < 1300); }"
    opened.page.evaluate(hold, waiting)
    n = len(frames)
    opened.page.wait_for_function("(n) => plushPage.run.frames === n", arg=n)
    # The frames as the page has them: those that the parser accepts.
    parser = LineParser(_PLUSH, Counters(), joining=True)
    read = parser.frames(b"4 5 6\n" + data, 0)
    steps, events = _answers(IntegerClassifier(opened.model), read)
    got = opened.page.evaluate("() => ({ answers, log: plushPage.run.log, bad: plushPage.run.parser.malformed })")
    assert len(steps) > 400 and len(events) > 3 and any(e[-1] for e in events)
    assert [a for a in got["answers"] if a[1] == "tracking"] == steps
    assert [tuple(row[2:]) for row in got["log"]] == events
    assert got["bad"] == parser.counters.malformed == 3
    opened.until("counts", f"{n:d}")
    assert opened.page.evaluate("() => plushPage.run.toy.counts().restarts") == 1


def test_after_a_reboot_sensors_calibrate_themselves_anew_as_in_live(
    pages: Callable[..., Opened], tmp_path: Path
) -> None:
    """By the browser's clock, and by that of a recording, of which one frame has an impossible time."""
    layout = replace(_PLUSH, self_calibration=_PLUSH.names)
    opened = pages(bundle_of(layout, window=60))
    page, start = opened.page, 1_700_000_000_000
    parts = [_stream(_PLUSH, 6, person) for person in (3, 4)]
    hosts = (start, start + LONG_PAUSE_MS + 10_000)
    frames = [Frame(host, f.device_ms, f.values) for host, part in zip(hosts, parts, strict=True) for f in part]
    frames[900] = frames[900]._replace(device_ms=10**9)
    expected = [step[1:] for step in _answers(IntegerClassifier(opened.model), frames)[0]]
    assert expected[-1] != _answers(IntegerClassifier(opened.model), [f._replace(host_ms=0) for f in frames])[0][-1][1:]
    opened.connect()
    for host, part in ((hosts[0], frames[:600]), (hosts[1], frames[600:])):
        page.clock.set_fixed_time(host)
        opened.send(b"\n" * (part[0] is frames[0]) + _bytes(_PLUSH, part))
    tracking = "() => answers.splice(0).filter((a) => a[1] === 'tracking').map((a) => a.slice(1))"
    assert page.evaluate(tracking) == expected
    page.click("#stop")
    page.clock.pause_at(hosts[1] + 1)
    lines = [_PLUSH.csv.separator.join(map(str, [*f.values, f.host_ms, f.device_ms])) for f in frames]
    text = "\n".join(["; ".join([*_PLUSH.names, "host_ms", "device_ms"]), *lines, ""])
    page.set_input_files("#file", {"name": "fulldatastream.csv", "mimeType": "text/csv", "buffer": text.encode()})
    opened.until("message", "Playing")
    page.clock.run_for(20_000)
    opened.until("message", "is over.")
    assert page.evaluate(tracking) == expected


@pytest.mark.parametrize("layout", ["plush-15", "plush-14", "phone-6"])
def test_lines_are_read_as_in_python_wherever_they_are_cut(pages: Callable[..., Opened], layout: str) -> None:
    opened, chosen = pages(layout), load_layout(layout)
    rng = np.random.default_rng(7)
    words = ["1", "-2", "+3", "-0", "007", "12.5", ".5", "5.", "1e3", "2.5e-1", "1e", "0x1", "1_0", "-", "nan"]
    words += [
        "9" * 15,
        "9" * 16,
        "9" * 18,
        "9" * 19,
        str(2**53),
        str(2**53 + 1),
        str(-(2**53)),
        str(2**31 + 1),
        "0.0005",
        "0.0015",
        "-0.0025",
        "\v",
        "\xff",
    ]
    cases = []
    for joining in (False, True) * 100:
        lines = []
        for _ in range(6):
            fields = [str(v) for v in rng.integers(0, 500, len(chosen.wire) + int(rng.choice([0, 0, 0, 0, 1, -1])))]
            for at in rng.integers(0, len(fields), rng.integers(0, 3)):
                fields[at] = str(rng.choice(words))
            lines.append(
                str(rng.choice([" ", "  ", ",", "\t", " ; "])).join(fields) + str(rng.choice(["\n", "\r\n", "\r"]))
            )
        data = "".join(lines).encode("latin-1") + (b"7" * 900 + b"\n1" if rng.random() < 0.1 else b"")
        cuts = sorted(rng.integers(0, len(data), 9).tolist())
        cases.append((joining, data, [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]))
    feed = """(cases) => cases.map(([joining, pieces]) => {
      const parser = new plushPage.LineParser(joining);
      const frames = pieces.flatMap((p) => parser.feed(Uint8Array.from(atob(p), (c) => c.charCodeAt(0))));
      return [frames.map((f) => [f.ms, f.values]), parser.frames, parser.malformed, parser.garbage];
    })"""
    sent = [[joining, [base64.b64encode(p).decode() for p in pieces]] for joining, _, pieces in cases]
    expected = []
    for joining, data, _ in cases:
        parser = LineParser(chosen, Counters(), joining=joining)
        frames = [[line.device_ms, list(line.values)] for line in parser.feed(data)]
        counters = parser.counters
        expected.append([frames, counters.frames, counters.malformed, counters.garbage])
    assert opened.page.evaluate(feed, sent) == expected
    assert sum(len(frames) for frames, *_ in expected) > 200


def _files(folder: Path) -> dict[str, bytes]:
    """Recordings of a toy with 15 and with 14 numbers a line, as recorders and the authors' scripts leave them."""
    rows = [[*range(n, n + 13), 1_700_000_000_000 + 10 * n, 5000 + 10 * n] for n in range(40)]
    delays = [[*row[:14], 9 + n % 3] for n, row in enumerate(rows)]
    table = {name: [[str(v) for v in row] for row in of] for name, of in (("clock", rows), ("delays", delays))}
    titles = "; ".join(_PLUSH.csv.header)
    files = {
        f"Tail tap 1_{10**12}_{n}.csv": "\r\n".join([titles, *map("; ".join, of)])
        for n, of in enumerate(table.values())
    }
    files["fulldatastream.csv"] = "".join(";".join(row) + "\n" for row in table["clock"]) + "3;4;5"
    files["spoilt.csv"] = "\ufeff\n" + "\n".join([titles, "1;2", *map(";".join, table["clock"]), "x;" * 15, ""])
    files["short.csv"] = "1;2;3\n"
    return {name: text.encode() for name, text in files.items()}


def test_files_are_read_as_in_python_and_hostile_ones_get_one_sentence(
    pages: Callable[..., Opened], tmp_path: Path
) -> None:
    opened = pages()
    read = """([text, name]) => {
      const read = plushPage.readFile(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)), name);
      return read && [read.malformed, read.frames.map((f) => [f.ms, f.values])];
    }"""
    for name, content in _files(tmp_path).items():
        got = opened.page.evaluate(read, [base64.b64encode(content).decode(), name])
        (tmp_path / name).write_bytes(content)
        if name == "short.csv":
            assert got is None
            continue
        result = (read_recording if name.startswith("Tail") else read_stream)(tmp_path / name, _PLUSH)
        frames = result.frames
        assert got[1] == [[ms, v] for ms, v in zip(frames.device_ms.tolist(), frames.values.tolist(), strict=True)], (
            name
        )
        assert got[0] == result.malformed - result.cut, name
    for name, content in (
        ("a.csv", b"\x00\x01" * 50),
        ("b.csv", b""),
        ("c.html", b"<script>alert(1)</script>"),
        ("d", b"1 2\n"),
    ):
        opened.page.set_input_files("#file", {"name": name, "mimeType": "text/csv", "buffer": content})
        opened.until("message", f"“{name}” cannot be played: it is not a recording")
    text = (tmp_path / "fulldatastream.csv").read_text()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr("recording.csv", text)
    for name, content, said in (
        ("e.csv.gz", gzip.compress(text.encode()), "is packed (gzip or zip)"),
        ("f.xlsx", packed.getvalue(), "is packed (gzip or zip)"),
        ("g.csv", text.encode("utf-16"), "is text in UTF-16: save it in UTF-8"),
        ("h.csv", b"\xfe\xff" + text.encode("utf-16-be"), "is text in UTF-16: save it in UTF-8"),
    ):
        opened.page.set_input_files("#file", {"name": name, "mimeType": "text/csv", "buffer": content})
        opened.until("message", f"“{name}” {said}")
    # A virtual toy's lines, played to their end.
    lines = _bytes(_PLUSH, _stream(_PLUSH, 0.5))
    opened.page.set_input_files("#file", {"name": "virtual toy.txt", "mimeType": "text/plain", "buffer": lines})
    opened.until("message", "is over.")
    assert opened.page.is_checked("#simulated") and "Simulation: these data" in opened.text("mark")


def test_what_happens_is_named_spoken_and_saved_in_both_languages(
    pages: Callable[..., Opened], trained: Bundle, tmp_path: Path
) -> None:
    opened = pages(trained, size=PHONE, dark=True, language="lv")
    page = opened.page
    opened.until("state", "Nav sākts")
    assert english(page) == []
    opened.connect()
    opened.until("state", "Savienojas")
    page.click("summary")
    page.select_option("#gesture", "Tail hit 2")
    page.check("#simulated")
    page.click("#record")
    opened.until("message", "Simulētus datus šeit neieraksta")
    page.uncheck("#simulated")
    page.click("#record")
    frames = _stream(_PLUSH, 15)
    opened.send(b"\n" + _bytes(_PLUSH, frames))
    opened.until("rows", f"{len(frames)} kadri")
    # Something is drawn in each lane, once it is in sight.
    page.locator("#canvas").scroll_into_view_if_needed()
    page.wait_for_function("""() => [...Array(13).keys()].every((lane) => {
      const { width, height } = canvas, begin = height * lane / 13;
      const { data } = canvas.getContext('2d').getImageData(0, begin, width, height / 13);
      return new Set(data).size > 8;
    })""")
    with page.expect_download() as kept:
        page.click("#record")
    assert axe(page) == []
    assert english(page) == []
    named = kept.value.suggested_filename
    kept.value.save_as(tmp_path / named)
    recorded = read_recording(tmp_path / named, _PLUSH).frames
    assert named.startswith("Tail hit 2_") and named.endswith(f"_{len(frames)}.csv")
    assert recorded.values.tolist() == [list(f.values) for f in frames]
    assert recorded.device_ms.tolist() == [f.device_ms for f in frames]
    assert page.evaluate("() => plushPage.run.log.length")
    with page.expect_download() as kept:
        page.click("#log")
    # Each is spoken once at most, and only what is new.
    assert opened.text("spoken").count(",") == 1
    page.click("[data-language=en]")
    opened.until("state", "No signal from the toy")
    assert page.evaluate("() => plushPage.run.spans.every((s) => s.to !== null)")
    opened.send(b"names: 1\n" * 3)
    opened.until("about", "as “names: 1”: this page expects 15")
    page.evaluate("() => breakPort()")
    opened.until("message", "The toy went away (The device has been lost.)")
    assert axe(page) == []


def test_pictures_of_the_signals_need_no_frame_of_the_screen_and_only_what_differs_is_written(
    pages: Callable[..., Opened],
) -> None:
    """Frames take most of the processor time where there is no graphics card."""
    opened = pages()
    page = opened.page
    page.evaluate("""() => {
      window.pictures = window.frames = 0;
      const { fillRect } = CanvasRenderingContext2D.prototype, later = requestAnimationFrame;
      CanvasRenderingContext2D.prototype.fillRect = function (...area) { pictures++; fillRect.apply(this, area) };
      // Playwright asks for frames, too.
      window.requestAnimationFrame = (draw) => (frames += new Error().stack.includes('index.html'), later(draw));
    }""")
    opened.connect()
    still = [Frame(0, 10 * n, (400,) * 10 + (0, 0, 16_384)) for n in range(600)]
    opened.send(b"\n" + _bytes(_PLUSH, still))
    opened.until("state", "No signal from the toy")
    assert page.evaluate("() => [pictures, frames]") == [0, 0]  # as they are not in sight
    page.locator("#canvas").scroll_into_view_if_needed()
    page.wait_for_function("() => pictures")
    assert page.evaluate("() => frames") == 0
    assert page.evaluate("() => canvas.getContext('2d').getContextAttributes().desynchronized") is True
    changed = """() => {
      const watch = new MutationObserver(() => {}), all = { attributes: true, childList: true, subtree: true };
      for (const node of document.querySelectorAll('.now, #mark, #message')) watch.observe(node, all);
      document.getElementById('simulated').dispatchEvent(new Event('change')); // shows all anew
      return watch.takeRecords().map((record) => record.attributeName ?? record.target.id);
    }"""
    assert page.evaluate(changed) == []


# What navigator.bluetooth is to the page: a toy that notifies what the test sends.
_RADIO = """() => {
  const tx = new EventTarget(), device = new EventTarget(), asked = [];
  tx.startNotifications = async () => {};
  const characteristic = { getCharacteristic: async (uuid) => (asked.push(uuid), tx) };
  const server = { getPrimaryService: async (uuid) => {
    asked.push(uuid);
    if (window.lacks) throw lacks;
    return characteristic;
  } };
  device.name = 'Bear';
  const radio = window.radio = device.gatt = {
    connect: async () => (radio.connected = true, server), disconnect: () => (radio.connected = false),
  };
  window.notify = (text) => {
    tx.value = new DataView(Uint8Array.from('..' + text, (c) => c.charCodeAt(0)).buffer, 2);
    tx.dispatchEvent(new Event('characteristicvaluechanged'));
  };
  window.switchOff = () => device.dispatchEvent(new Event('gattserverdisconnected'));
  window.asked = asked;
  const requestDevice = async (how) => (asked.push(how.filters[0].services[0], how.optionalServices[0]), device);
  Object.defineProperty(navigator, 'bluetooth', { value: { requestDevice } });
}"""


def test_a_bluetooth_toy_with_older_firmware_is_read_until_it_goes_away(pages: Callable[..., Opened]) -> None:
    old = load_layout("plush-14")
    opened = pages(radio=_RADIO)
    opened.page.click("#bluetooth")
    opened.until("message", "Reading the toy.")
    assert opened.page.evaluate("() => asked") == [UART_SERVICE, UART_SERVICE, UART_SERVICE, UART_TX]
    lines = _bytes(old, _stream(old, 1)).decode()
    for at in range(0, len(lines), 20):
        opened.page.evaluate("(text) => notify(text)", lines[at : at + 20])
    n = lines.count("\n") - 10  # that many show what they are
    opened.page.wait_for_function("(n) => plushPage.run.frames === n", arg=n)
    assert opened.page.evaluate("() => plushPage.run.parser.clock") == 10 * (n - 1)
    opened.page.evaluate("() => switchOff()")
    opened.until("message", "The toy went away (disconnected).")


def test_a_bluetooth_device_that_is_no_toy_is_let_go(pages: Callable[..., Opened]) -> None:
    opened = pages(radio=_RADIO)
    for error, said in (
        ("NotFoundError", "“Bear” is not a toy that this page can read, as it lacks the service of the Nordic UART"),
        ("NetworkError", "The toy could not be connected (no service). Close other programs"),
    ):
        opened.page.evaluate("(name) => { window.lacks = new DOMException('no service', name) }", error)
        opened.page.click("#bluetooth")
        opened.until("message", said)
        assert opened.page.evaluate("() => radio.connected") is False
    # Nor is one kept whose model cannot be run.
    opened.page.evaluate(
        "() => { delete window.lacks; WebAssembly.instantiate = () => { throw new Error('no memory') } }"
    )
    opened.page.click("#bluetooth")
    opened.until("message", "This browser cannot run the model")
    assert opened.page.evaluate("() => radio.connected") is False


def test_a_button_pressed_twice_opens_one_port_and_the_last_file_chosen_is_played(
    pages: Callable[..., Opened],
) -> None:
    opened = pages()
    page = opened.page
    page.evaluate("""() => {
      window.begun = [];
      addEventListener('plushsense', ({ detail }) => begun.push(detail));
      for (const _ of '12') document.getElementById('serial').click();
    }""")
    opened.until("message", "Reading the toy.")
    page.evaluate(
        """(text) => {
      for (const name of ['a.txt', 'b.txt']) {
        const field = document.getElementById('file'), of = new DataTransfer();
        of.items.add(new File([text], name));
        field.files = of.files;
        field.dispatchEvent(new Event('change'));
      }
    }""",
        _bytes(_PLUSH, _stream(_PLUSH, 0.3)).decode(),
    )
    opened.until("message", "“b.txt” is over.")
    assert page.evaluate("() => begun.map((own) => own.over)") == [True] * 3
    opened.until("state", "Not started")
    assert page.is_enabled("#serial")


def test_any_label_is_shown_in_a_phone_s_width_saved_and_recorded(pages: Callable[..., Opened], tmp_path: Path) -> None:
    labels = ["At rest; no, none", '</script><b>"' + 70 * "ž" + "🧸", " .. "]
    known = load_gestures("plush-18").gestures[:3]
    gestures = replace(
        load_gestures("plush-18"), gestures=tuple(replace(g, label=n) for g, n in zip(known, labels, strict=True))
    )
    layout = load_layout("phone-6")
    opened = pages(bundle_of(layout, gestures=gestures, window=60), size=PHONE)
    page = opened.page
    assert page.locator("#bars li").count() == 3
    opened.connect()
    page.click("summary")
    page.evaluate("(label) => plushPage.run.log.push(['', '', 'named', 1, label, '', '', ''])", labels[1])
    with page.expect_download() as kept:
        page.click("#log")
    rows = list(csv.reader(Path(kept.value.path()).read_text("utf-8").splitlines(), delimiter=";"))
    assert [len(row) for row in rows] == [8, 8] and rows[1][4] == labels[1]
    lines = _bytes(layout, [Frame(0, 10 * n, (n,) * 6) for n in range(30)])
    for label in labels:
        page.select_option("#gesture", label)
        page.click("#record")
        opened.send(b"\n" + lines)
        with page.expect_download() as kept:
            page.click("#record")
        kept.value.save_as(tmp_path / (name := kept.value.suggested_filename))
        assert name.startswith(recording_filename(label, 0, 0).removesuffix("0_0.csv"))
        assert len(read_recording(tmp_path / name, layout).frames) == len(lines.splitlines())
    assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")


def test_each_sentence_of_the_page_has_a_translation_and_is_used() -> None:
    script, template = ((WEB / name).read_text("utf-8") for name in ("page.js", "page.html.j2"))
    table, rest = script.split("const LATVIAN = {")[1].split("\n};", 1)
    translated = set(re.findall(r'"([^"]+)": "[^"]+"|(\w+): "', table))
    translated = {quoted or bare for quoted, bare in translated}
    used = set(re.findall(r"data-t[^>]*>([^<]*)</", template)) | set(re.findall(r"\bt\(\"([^\"]+)\"", rest))
    used |= {text for text in re.findall(r'"([^"\n]+)"', rest) if re.match(r"[A-Z“].* .*", text)}
    labels = {label for name in gesture_set_names() for label in load_gestures(name).labels}
    names = {re.sub(r" \d$", "", label) for label in labels} | {"At rest", *AFFECTS, "purr", "shriek"}
    names |= {name for layout in layout_names() for name in load_layout(layout).names} | {f"Eyes {e}" for e in EYES}
    assert used - labels - translated == set()
    assert [text for text in translated - names if text not in rest + template] == []


def test_names_are_those_of_the_studio(pages: Callable[..., Opened]) -> None:
    opened, words = pages(language="lv"), Words("lv")
    labels = [label for name in gesture_set_names() for label in load_gestures(name).labels]
    channels = [name for layout in ("plush-15", "phone-6") for name in load_layout(layout).names]
    got = opened.page.evaluate("([a, b]) => [a.map(plushPage.named), b.map((n) => plushPage.t(n))]", [labels, channels])
    assert got == [[words.gesture(label) for label in labels], [words.channel(name) for name in channels]]


def test_a_browser_without_ports_says_what_to_do_and_the_page_cannot_ask_for_anything(
    pages: Callable[..., Opened],
) -> None:
    opened = pages()
    assert "iPhone and iPad" in opened.text("without") and opened.page.is_disabled("#bluetooth")
    blocked = """() => new Promise((answer) => {
      addEventListener('securitypolicyviolation', (e) => answer(e.effectiveDirective));
      fetch('http://127.0.0.1:9/').catch(() => {});
    })"""
    assert opened.page.evaluate(blocked) == "connect-src"
    assert all("Content Security Policy" in text for text in opened.look.complaints)
    opened.look.complaints.clear()


def test_the_studio_opens_and_saves_the_page_of_an_export(
    studio: Callable[..., Studio], look: Callable[..., Look], home: Path, trained: Bundle
) -> None:
    exported(home / "exports" / "bear", trained)
    file = home / "exports" / "bear" / PAGE
    url = studio(home=home).url
    looking = look()
    page = looking.open(f"{url}/export?name=bear")
    with page.expect_popup() as opened:
        marked(page, "open-page").click()
    opened.value.wait_for_function("() => document.getElementById('state')?.textContent === 'Not started'")
    assert axe(opened.value) == []
    opened.value.close()
    with page.expect_download() as saved:
        marked(page, "save-page").click()
    assert saved.value.suggested_filename == "bear.html"
    assert Path(saved.value.path()).read_bytes() == file.read_bytes()
    assert looking.complaints == []
    # Of a page from elsewhere no script runs, though it claims the policy.
    file.write_text(file.read_text("utf-8") + "<script>document.title = 'theirs'</script>", "utf-8")
    page.goto(f"{url}/page/bear")
    assert page.title() == "PlushSense" and "Content Security Policy" in looking.complaints.pop()
    file.write_text("another version", "utf-8")
    for name in ("bear", "none", "..%2Fbear", "a" * 300):
        assert page.request.get(f"{url}/page/{name}").status == 404


def test_the_page_of_the_documentation_reads_a_toy(look: Callable[..., Look], trained: Bundle, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "browser.md").read_text("utf-8")
    html = text.split("```html\n")[1].split("```")[0]
    web = exported(tmp_path / "out", trained) / "web"
    (web / IMAGE).write_bytes((web.parent / IMAGE).read_bytes())
    page = look(own=True).context.new_page()
    page.add_init_script(f"({_PORT})()")
    page.route("http://127.0.0.1:9/*", lambda route: route.fulfill(path=web / route.request.url.rpartition("/")[2]))
    page.route("http://127.0.0.1:9/", lambda route: route.fulfill(body=html, content_type="text/html"))
    page.goto("http://127.0.0.1:9/")
    page.wait_for_function("() => connect.onclick")
    page.click("#connect")
    page.wait_for_function("() => portOptions()")
    data = base64.b64encode(b"noise " * 15 + b"\n" + _bytes(_PLUSH, _stream(_PLUSH, 16))).decode()
    page.evaluate("(data) => sendBytes(data)", data)
    page.wait_for_function("() => state.textContent === 'begun: negative'")


@dataclass
class Tab:
    """A tab that Playwright does not hold in the foreground, as it does with its own; driven by way of the browser."""

    browser: Any
    target: str
    session: str
    replies: dict[int, Any]

    def call(self, method: str, **given: Any) -> Any:
        """Call a method of Chrome's DevTools protocol in the tab."""
        number = len(self.replies) + 1
        message = json.dumps({"id": number, "method": method, "params": given})
        self.browser.send("Target.sendMessageToTarget", {"sessionId": self.session, "message": message})
        while number not in self.replies:  # they come with any other reply
            self.browser.send("Target.getTargets")
        return self.replies[number]["result"]

    def run(self, code: str) -> Any:
        """Evaluate an expression, and wait for its promise."""
        done = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def until(self, condition: str) -> None:
        """Wait until an expression is true."""
        while not self.run(condition):
            pass

    def minimize(self, minimized: bool) -> None:
        """Take its window, in which it is alone, out of sight or back, and wait until the page knows it."""
        window = self.browser.send("Browser.getWindowForTarget", {"targetId": self.target})["windowId"]
        bounds = {"windowState": "minimized" if minimized else "normal"}
        self.browser.send("Browser.setWindowBounds", {"windowId": window, "bounds": bounds})
        self.until(f"document.hidden === {json.dumps(minimized)}")


@pytest.fixture
def background(pages: Callable[..., Opened]) -> Iterator[Callable[..., Tab]]:
    """``background(bundle)`` opens the page in a `Tab`, the clock of which runs as the test says."""
    made: list[tuple[Any, str]] = []

    def new(bundle: Bundle) -> Tab:
        opened = pages(bundle)
        browser = opened.page.context.browser.new_browser_cdp_session()
        context = browser.send("Target.createBrowserContext")["browserContextId"]
        made.append((browser, context))
        target = browser.send("Target.createTarget", {"url": "about:blank", "browserContextId": context})["targetId"]
        session = browser.send("Target.attachToTarget", {"targetId": target, "flatten": False})["sessionId"]
        tab = Tab(browser, target, session, {})

        def note(event: Any) -> None:
            message = json.loads(event["message"])
            if "id" in message:
                tab.replies[message["id"]] = message

        browser.on("Target.receivedMessageFromTarget", note)
        tab.call("Page.enable")
        tab.call("Page.addScriptToEvaluateOnNewDocument", source=f"({_PORT})(); ({_CLOCK})()")
        tab.call("Page.navigate", url=opened.page.url)
        tab.until("document.readyState === 'complete' && 'plushPage' in window")
        return tab

    yield new
    for browser, context in made:
        browser.send("Target.disposeBrowserContext", {"browserContextId": context})
        browser.detach()


# The page's clock is the toy's: it goes on as the toy's bytes come, which wait while the page is frozen.
_CLOCK = """() => {
  const { port1, port2 } = new MessageChannel(), { fillRect } = CanvasRenderingContext2D.prototype;
  let now = 0;
  performance.now = () => now;
  window.pictures = 0;
  window.seen = [];
  CanvasRenderingContext2D.prototype.fillRect = function (...area) { pictures++; fillRect.apply(this, area) };
  for (const name of ['freeze', 'resume']) document.addEventListener(name, () => seen.push(name));
  port1.onmessage = ({ data }) => sendBytes(data);
  window.toySends = (text, ms) => { now += ms; if (text) port2.postMessage(text) };
}"""


def test_after_a_minute_in_the_background_the_page_is_right_again(
    background: Callable[..., Tab], trained: Bundle
) -> None:
    """In a hidden tab, in one that the browser has frozen, and after a minute of which nothing is left."""
    tab, model = background(trained), integer_model(trained)
    stream = _stream(_PLUSH, 195, person=2)
    # In the midst of events, which a silence would end.
    at = {"hidden": 650, "frozen": 6700, "lost": 12_550, "over": 18_600}
    read = [*stream[: at["lost"]], *stream[at["over"] :]]

    def send(frames: list[Frame], piece: int = 150) -> None:
        """Have the toy send frames, 1.5 seconds in a piece."""
        for begin in range(0, len(frames), piece):
            some = frames[begin : begin + piece]
            text = base64.b64encode(_bytes(_PLUSH, some)).decode()
            tab.run(f"toySends({json.dumps(text)}, {10 * len(some)})")

    def received(frames: list[Frame]) -> None:
        tab.until(f"plushPage.run.frames === {len(frames)}")

    tab.run("document.getElementById('serial').click()")
    tab.until("document.body.classList.contains('running')")
    tab.run("canvas.scrollIntoView()")
    tab.run("sendBytes(btoa('\\n'))")
    send(stream[: at["hidden"]])
    received(stream[: at["hidden"]])
    tab.until("pictures > 0")
    tab.minimize(True)
    tab.run("pictures = 0")
    send(stream[at["hidden"] : at["frozen"]])
    received(stream[: at["frozen"]])
    assert tab.run("pictures") == 0
    tab.call("Page.setWebLifecycleState", state="frozen")
    tab.until("seen.at(-1) === 'freeze'")
    send(stream[at["frozen"] : at["lost"]], 1000)
    assert tab.run("plushPage.run.frames") == at["frozen"]
    tab.call("Page.setWebLifecycleState", state="active")
    received(stream[: at["lost"]])
    tab.call("Page.setWebLifecycleState", state="frozen")
    tab.until("seen.length === 3")
    tab.run(f"toySends('', {10 * (at['over'] - at['lost'])})")
    send(stream[at["over"] :])
    tab.call("Page.setWebLifecycleState", state="active")
    received(read)
    tab.minimize(False)
    steps, events = _answers(IntegerClassifier(model), read)
    assert len(steps) > 2000 and len(events) > 20
    assert tab.run("answers.filter((a) => a[1] === 'tracking')") == steps
    assert [tuple(row) for row in tab.run("plushPage.run.log.map((row) => row.slice(2))")] == events
    assert tab.run("plushPage.run.toy.counts().restarts") == 1
    # What is shown is of now, and not of a minute ago.
    tab.until(f"document.getElementById('counts').textContent.includes('Frames: {len(read)}.')")
    tab.until("pictures > 0")
    assert tab.run("events.children.length === Math.min(20, plushPage.run.spans.length)")


@pytest.mark.exhaustive
def test_half_an_hour_needs_no_more_memory_than_a_minute(pages: Callable[..., Opened]) -> None:
    _grows(pages(), 30 if not LONG else 240)


def test_minutes_need_no_more_memory_than_the_first(pages: Callable[..., Opened]) -> None:
    _grows(pages(), 2)


def _grows(opened: Opened, minutes: int) -> None:
    frames = _stream(_PLUSH, 60)
    length = frames[-1].device_ms - frames[0].device_ms + 10
    opened.connect()
    session = opened.page.context.new_cdp_session(opened.page)
    session.send("Performance.enable")
    used = []
    for minute in range(minutes):
        moved = [Frame(f.host_ms, f.device_ms + minute * length, f.values) for f in frames]
        opened.send(_bytes(_PLUSH, moved))
        session.send("HeapProfiler.collectGarbage")
        metrics = {m["name"]: m["value"] for m in session.send("Performance.getMetrics")["metrics"]}
        wasm = opened.page.evaluate(
            "() => { answers.length = 0; return plushPage.run.toy._c.memory.buffer.byteLength }"
        )
        used.append((metrics["JSHeapUsedSize"] / 1e6, wasm))
    assert used[-1][0] < used[0][0] + 1.5, used
    assert used[-1][1] == used[0][1]
