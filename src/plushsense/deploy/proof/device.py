"""Verify the C of an export on a chip that is connected by a UART: send the vectors, compare what comes back.

The chip runs the export's own harness (``examples/verify_device``); ``plush_device.h`` there describes the packets. The
computer sends only what the chip asks for, so that a UART without flow control loses nothing.
"""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from plushsense.core.errors import DeviceError
from plushsense.deploy.golden import Vectors, counted
from plushsense.deploy.proof.vectors import Export, RowComparison, compare
from plushsense.deploy.proof.verify import CHIP, Cycles, Progress, SettingResult, VerificationResult
from plushsense.devices.bytestreams import Link, open_link
from plushsense.runtime.image import image_check

VERSION = 1
MOST_BYTES = 1024
HELLO_S = 10.0
"""How long to wait for the chip's first answer."""
SILENT_S = 60.0
"""How long a chip may compute before it asks or answers."""
_AGAIN_S = 1.0
_SYNC = b"PV"
_HEAD = struct.Struct("<cH")
_HELLO = struct.Struct("<6I")
_MEASURES = struct.Struct("<IIIQ")
_SHOWN = 40


class _PacketLink:
    """Packets over a link; every error is a DeviceError that says what the chip did."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self._waiting = bytearray()

    def send(self, letter: bytes, content: bytes = b"") -> None:
        packet = _HEAD.pack(letter, len(content)) + content
        self.link.send(_SYNC + packet + struct.pack("<I", zlib.crc32(packet)))

    def receive(self, wait_s: float, *, noise: bool = False) -> tuple[bytes, bytes] | None:
        """Return letter and content of the next packet; None if it did not come within ``wait_s``.

        ``noise``: other bytes are passed over, such as the messages of a boot loader.
        """
        until = time.monotonic() + wait_s
        while True:
            try:
                packet = self._packet()
            except DeviceError:
                if not noise:
                    raise
                del self._waiting[0]
                continue
            left = until - time.monotonic()
            if packet is not None or left <= 0:
                return packet
            data = self.link.receive(min(left, 0.1))
            if data is None:
                raise DeviceError(f"'{self.link.url}' closed the connection before all results had come.")
            self._waiting += data

    def _packet(self) -> tuple[bytes, bytes] | None:
        waiting = self._waiting
        if not _SYNC.startswith(bytes(waiting[: len(_SYNC)])):
            raise self._garbage("bytes that are no packet")
        if len(waiting) < len(_SYNC) + _HEAD.size:
            return None
        letter, n = _HEAD.unpack_from(waiting, len(_SYNC))
        end = len(_SYNC) + _HEAD.size + n
        if n > MOST_BYTES:
            raise self._garbage("a packet that is too long")
        if len(waiting) < end + 4:
            return None
        if struct.unpack_from("<I", waiting, end)[0] != zlib.crc32(waiting[len(_SYNC) : end]):
            raise self._garbage("a packet with a wrong checksum")
        content = bytes(waiting[len(_SYNC) + _HEAD.size : end])
        del waiting[: end + 4]
        return letter, content

    def _garbage(self, what: str) -> DeviceError:
        start = bytes(self._waiting[:_SHOWN])
        return DeviceError(
            f"'{self.link.url}' sent {what} ({start!r}…): check cable and baud rate, and that nothing else, such as a "
            "log, writes to this UART."
        )


@dataclass(frozen=True)
class _DeviceInfo:
    """Memory sizes and cycle counter that the program on a chip reports when it is contacted.

    ``memory_bytes`` are for the state of a toy, ``room_bytes`` for models and patches.
    """

    memory_bytes: int
    room_bytes: int
    counter: str


def verify_device(
    export: Export, url: str, vectors: Sequence[Vectors] = (), *, progress: Progress | None = None
) -> VerificationResult:
    """Send the vectors of an export to a chip that runs its harness, and compare every result.

    Golden vectors, patches, test scenarios and ``vectors`` are run. ``not_run`` names those for which the chip has too
    little memory.

    Raises:
        BadInput: if files of the export are not those that this version writes.
        DeviceError: if the chip is not there, runs another model, sends damaged packets, or falls silent.
        ConfigError: for a URL that is neither serial:// nor tcp://.
    """
    export.require_unchanged()
    began = time.monotonic()
    link = open_link(url)
    try:
        packets = _PacketLink(link)
        chip = _greet(packets, export)
        cases = [export.golden, *export.patched(), *export.scenarios(), *vectors]
        fitting = [v for v in cases if v.memory_bytes <= chip.memory_bytes and v.kept_bytes <= chip.room_bytes]
        results, measured = _run(packets, fitting, export, progress)
    finally:
        link.close()
    left_out = [v for v in cases if v not in fitting]
    not_run = [
        (
            name,
            f"the chip has {chip.memory_bytes:,} bytes of memory and {chip.room_bytes:,} of room, of which "
            f"{sum(v.name == name for v in left_out)} need more: raise PLUSH_DEVICE_MEMORY_BYTES or "
            "PLUSH_DEVICE_ROOM_BYTES",
        )
        for name in dict.fromkeys(v.name for v in left_out)
    ]
    scenarios = [*export.patched(), *export.scenarios()]
    run = SettingResult(
        CHIP,
        url,
        f"counter {chip.counter}" if chip.counter else "no counter",
        sum(r.vectors for r in results),
        sum(r.mismatches for r in results),
        max(r.max_abs_diff for r in results),
        time.monotonic() - began,
        next((r.first for r in results if r.first), None),
        _cycles(chip, measured, fitting),
    )
    decisions = sum(v.decisions for v in fitting if v not in scenarios)
    return VerificationResult(export.title, export.edited, decisions, counted(fitting), (run,), tuple(not_run))


def _greet(packets: _PacketLink, export: Export) -> _DeviceInfo:
    """Ask until the chip answers, which may still boot, and check that it runs the harness of this export."""
    url, until = packets.link.url, time.monotonic() + HELLO_S
    # The rest of a packet, if the chip still waits for it because a computer was stopped.
    packets.link.send(bytes(MOST_BYTES + 4))
    while (now := time.monotonic()) < until:
        packets.send(b"H")
        asked_until = min(now + _AGAIN_S, until)
        while found := packets.receive(asked_until - time.monotonic(), noise=True):
            if found[0] == b"h" and len(found[1]) >= _HELLO.size:
                return _checked(found[1], export, url)
    raise DeviceError(
        f"'{url}' did not answer for {HELLO_S:g} s: does the chip run examples/verify_device of this export, at this "
        "baud rate?"
    )


def _checked(hello: bytes, export: Export, url: str) -> _DeviceInfo:
    version, model_id, channels, classes, memory_bytes, room_bytes = _HELLO.unpack_from(hello)
    own = image_check(export.image)
    if version != VERSION:
        raise DeviceError(
            f"'{url}' runs a harness of version {version}, and this PlushSense speaks {VERSION}: export the model "
            "again, and flash its examples/verify_device."
        )
    shape = len(export.model.layout.channels), export.model.network.arch.classes
    if model_id != own or (channels, classes) != shape:
        raise DeviceError(
            f"'{url}' runs the model {model_id:08x}, and '{export.folder}' holds {own:08x}: flash the harness of this "
            "export."
        )
    return _DeviceInfo(memory_bytes, room_bytes, hello[_HELLO.size :].decode("utf-8", "replace"))


def _run(
    packets: _PacketLink, cases: Sequence[Vectors], export: Export, progress: Progress | None
) -> tuple[list[RowComparison], dict[int, tuple[int, int, int, int]]]:
    """Send the cases; return the comparison of each, and the measures of those that have some."""
    url, pieces = packets.link.url, [_pieces(v.to_bytes()) for v in cases]
    total, done = sum(map(len, pieces)), 0
    received, words, measured = [bytearray() for _ in cases], "", {}
    at = -1
    left: list[bytes] = []
    packets.send(b"S")
    while True:
        found = packets.receive(SILENT_S)
        if found is None:
            raise DeviceError(
                f"'{url}' fell silent for {SILENT_S:g} s in {cases[max(at, 0)].name}, after "
                f"{sum(map(len, received)):,} bytes of results: did the program on the chip crash?"
            )
        letter, content = found
        if letter == b"n":
            if not left:
                at += 1
                left = list(reversed(pieces[at])) if at < len(cases) else [b""]
            packets.send(b"D", left.pop())
            done += at < len(cases)
            if progress:
                progress(done, total)
        elif letter == b"r" and at >= 0:
            received[min(at, len(cases) - 1)] += content
        elif letter == b"m" and len(content) == _MEASURES.size:
            measured[at] = _MEASURES.unpack(content)
        elif letter == b"w":
            words = content.decode("utf-8", "replace")
        elif letter == b"d":
            break
        elif letter == b"e":
            raise DeviceError(f"'{url}' gave up, because {content.decode('utf-8', 'replace')}: check the cable.")
        elif letter != b"h" or at >= 0:  # an answer to a question that was asked again
            raise DeviceError(f"'{url}' sent a packet '{letter.decode('latin-1')}' that is none of the harness.")
    results = []
    for n, (vectors, rows) in enumerate(zip(cases, received, strict=True)):
        if words and n > at:
            # The harness ends with what went wrong; the other cases were not run.
            results.append(RowComparison(len(vectors.answers), len(vectors.answers), 0, None))
            continue
        result = compare(vectors.answers, bytes(rows) + (words.encode() if n == at else b""), export.labels)
        first = f"On {url}, {vectors.name}: {result.first}." if result.first else None
        results.append(replace(result, first=first))
    return results, measured


def _cycles(
    chip: _DeviceInfo, measured: dict[int, tuple[int, int, int, int]], cases: Sequence[Vectors]
) -> Cycles | None:
    """Return the cycles of the export's own model, over all cases with it; None without a counter."""
    own = [m for n, m in measured.items() if cases[n].model is None]
    steps = sum(m[1] for m in own)
    if not chip.counter or not steps:
        return None
    return Cycles(chip.counter, steps, sum(m[3] for m in own) / steps, max(m[2] for m in own))


def _pieces(data: bytes) -> list[bytes]:
    return [data[at : at + MOST_BYTES] for at in range(0, len(data), MOST_BYTES)]
