"""Open devices by URL, and search for available ones: serial ports, Bluetooth, LSL streams, the virtual toy."""

from __future__ import annotations

import math
import os
import pkgutil
import re
import threading
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from urllib.parse import unquote

from plushsense.core.errors import AddressError, ConfigError, DeviceError, MissingExtraError, PlushSenseError, nearest
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.sentences import Message
from plushsense.devices.base import Device, ReconnectingDevice

DEFAULT_LAYOUT = "plush-15"

SCHEMES: dict[str, str] = {
    "serial": "plushsense.devices.bytestreams:open_serial",
    "ble": "plushsense.devices.ble:open_ble",
    "tcp": "plushsense.devices.bytestreams:open_tcp",
    "lsl": "plushsense.devices.lsl:open_lsl",
    "replay": "plushsense.devices.replay:open_replay",
    "virtual": "plushsense.devices.virtual.stream:open_virtual",
}
"""For each scheme, ``module:function`` of a function (address, layout) that returns the open `Device`."""

CHECKS: dict[str, str] = {
    "serial": "plushsense.devices.bytestreams:check_serial",
    "tcp": "plushsense.devices.bytestreams:check_tcp",
}
"""For some schemes, ``module:function`` of a function (address) that raises an error if no toy can be there."""

SEARCHES: dict[str, str] = {
    "Serial ports": "plushsense.devices.bytestreams:search_serial",
    "Bluetooth": "plushsense.devices.ble:search_bluetooth",
    "LSL": "plushsense.devices.lsl:search_streams",
}
"""For each transport, ``module:function`` of a function (seconds to search) that returns a `DeviceListing`."""
_SENDING = ("Bluetooth", "LSL")  # They ask devices by radio, and the network by multicast.

EXAMPLES = (
    "serial:///dev/ttyUSB0?baud=115200, serial://COM3, ble://AA:BB:CC:DD:EE:FF, ble://name:PlushName, tcp://host:port, "
    "lsl://NAME, replay:///path/stream.csv, virtual://?person=7"
)


@dataclass
class DeviceAddress:
    """The parts of a device URL: ``place`` is between ``scheme://`` and ``?``, ``query`` has the settings after it."""

    url: str
    scheme: str
    place: str
    query: dict[str, str] = field(default_factory=dict)

    def check_keys(self, known: Iterable[str]) -> None:
        """Raise ConfigError for a setting that is not in ``known``, with the nearest one that is."""
        accepted = ("layout", *known)
        for key in self.query:
            if key not in accepted:
                raise AddressError(
                    "'{url}': unknown setting '{key}' of {scheme}://: accepted are {known}.{hint}",
                    url=self.url,
                    key=key,
                    scheme=self.scheme,
                    known=", ".join(accepted),
                    hint=nearest(key, accepted),
                )

    def whole(self, key: str, default: int, low: int = 0, high: int = 2**31 - 1) -> int:
        """Return a setting as a whole number from ``low`` to ``high``; raise ConfigError if it is not one."""
        text = self.query.get(key)
        if text is None:
            return default
        if not re.fullmatch(r"\d{1,10}", text, re.ASCII) or not low <= int(text) <= high:
            raise AddressError(
                "'{url}': {key} is '{text}'; accepted is a whole number, {low} to {high}.",
                url=self.url,
                key=key,
                text=text,
                low=low,
                high=high,
            )
        return int(text)

    def number(self, key: str, default: float, low: float = 0.0, high: float = 1e6) -> float:
        """Return a setting as a number from ``low`` to ``high``; raise ConfigError if it is not one."""
        text = self.query.get(key)
        if text is None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise AddressError(
                "'{url}': {key} is '{text}'; accepted is a number, {low:g} to {high:g}.",
                url=self.url,
                key=key,
                text=text,
                low=low,
                high=high,
            )
        return value


def parse_url(url: str) -> DeviceAddress:
    """Parse a device URL. A path without a scheme, such as ``x.csv`` or ``C:\\x.csv``, means a replay.

    Raises:
        ConfigError: for an unknown scheme, or a setting that is not ``key=value`` or is repeated.
    """
    text = os.fspath(url).strip()
    if not text:
        raise AddressError("No device URL was given; accepted are {examples}.", examples=EXAMPLES)
    match = re.match(r"([A-Za-z][A-Za-z0-9+.\-]+):(//)?", text)
    if match is None or (match[2] is None and match[1].lower() not in SCHEMES):
        if Path(text).is_file():
            return DeviceAddress(text, "replay", text)
        if re.fullmatch(r"/dev/\S+|COM\d+", text):
            raise AddressError("'{port}' is a port, no recording to replay: write serial://{port}.", port=text)
        place, query = _split_query(text, text)
        return DeviceAddress(text, "replay", place, query)
    scheme = match[1].lower()
    if scheme not in SCHEMES:
        raise AddressError(
            "'{text}': there is no scheme '{scheme}'; accepted are {schemes}, as in {examples}.{hint}",
            text=text,
            scheme=scheme,
            schemes=", ".join(SCHEMES),
            examples=EXAMPLES,
            hint=nearest(scheme, SCHEMES),
            known=", ".join(f"{known}://" for known in SCHEMES),
        )
    place, query = _split_query(text[match.end() :], text)
    return DeviceAddress(text, scheme, place, query)


def _split_query(rest: str, url: str) -> tuple[str, dict[str, str]]:
    place, mark, tail = rest.partition("?")
    query: dict[str, str] = {}
    for part in tail.split("&") if mark else ():
        if not part:
            continue
        key, equals, value = part.partition("=")
        if not equals or not key:
            raise AddressError("'{url}': '{part}' is no setting; write key=value, joined by &.", url=url, part=part)
        if key in query:
            raise AddressError("'{url}': the setting '{part}' stands there twice; leave one.", url=url, part=key)
        query[key] = unquote(value.replace("+", " "))
    return place, query


def check_address(address: DeviceAddress) -> None:
    """Raise an error if no toy can be at an address: a port that does not exist, or a name that is not valid."""
    if address.scheme in CHECKS:
        pkgutil.resolve_name(CHECKS[address.scheme])(address)


# Schemes whose data can end; a device of any other scheme can only disconnect.
_ENDING = ("replay", "virtual")


def is_virtual(url: str) -> bool:
    """Return whether a URL opens a virtual toy in this process."""
    return parse_url(url).scheme == "virtual"


def with_speed(url: str, speed: float) -> str:
    """Return ``url`` with ``speed`` if it is of a virtual or replayed toy and has no speed, else unchanged."""
    address = parse_url(url)
    if address.scheme not in _ENDING or "speed" in address.query:
        return url
    return f"{url}{'&' if '?' in url else '?'}speed={speed:g}"


def speed_of(url: str) -> float:
    """Return the speed in the URL of a virtual or replayed toy; 1 for any other."""
    address = parse_url(url)
    return address.number("speed", 1.0) if address.scheme in _ENDING else 1.0


def open_device(
    url: str | os.PathLike[str],
    layout: Layout | str | None = None,
    *,
    reconnect: bool = False,
    reconnect_s: float | None = None,
) -> Device:
    """Open a toy by its URL.

    ``serial:///dev/ttyUSB0?baud=115200``, ``serial://COM3``, ``ble://AA:BB:CC:DD:EE:FF``, ``ble://name:PlushName``,
    ``tcp://host:port``, ``lsl://NAME``, ``replay:///path/stream.csv?speed=1``, ``virtual://?person=7&seed=1&speed=1``;
    a path alone is a replay. A setting ``layout`` in the URL overrides the argument; the default is plush-15.

    Args:
        layout: a layout, its name or the path of its file.
        reconnect: return a `ReconnectingDevice`, which restores a lost connection and records the gap.
        reconnect_s: longest time to wait for the toy in a gap, in seconds; None: no limit.

    Raises:
        ConfigError: for a scheme or setting that is unknown or out of range.
        LayoutError: for an unknown layout.
        DeviceError: for a port, host, stream or file that does not exist or cannot be opened.
        MissingExtraError: for a scheme whose optional package is not installed.
    """
    address = parse_url(os.fspath(url))
    chosen: Layout | str = address.query.get("layout") or layout or DEFAULT_LAYOUT
    resolved = chosen if isinstance(chosen, Layout) else load_layout(chosen)
    open_address = pkgutil.resolve_name(SCHEMES[address.scheme])

    def opened() -> Device:
        device = open_address(address, resolved)
        if not isinstance(device, Device):
            raise DeviceError(f"'{address.url}': the scheme {address.scheme} opened nothing that is a toy.")
        return device

    if not reconnect:
        return opened()
    return ReconnectingDevice(address.url, resolved, opened, for_s=reconnect_s, ends=address.scheme in _ENDING)


SCAN_S = 3.0
_GRACE_S = 2.0


@dataclass(frozen=True)
class DeviceInfo:
    """A device that may be a toy; ``url`` opens it, ``kind`` is serial, ble, lsl or virtual."""

    url: str
    kind: str
    name: str
    description: str


@dataclass
class DeviceListing:
    """The devices found, and notes for the user, such as why a transport could not be searched."""

    devices: list[DeviceInfo] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return asdict(self)


def list_devices(scan_s: float = SCAN_S, *, network: bool = True) -> DeviceListing:
    """Search for toys on all transports at once, for ``scan_s`` seconds.

    Without ``network``, nothing is sent by radio or network: only serial ports are listed.

    All serial ports and LSL streams are listed, and Bluetooth devices that advertise the Nordic UART service or have a
    name like a toy's. A missing package or adapter gives a note, not an error.

    Raises:
        ConfigError: if ``scan_s`` is not above 0 and at most 600.
    """
    if not 0.0 < scan_s <= 600.0:
        raise ConfigError(f"The time to look for toys is {scan_s:g} s; accepted is above 0 to 600.")
    results: dict[str, DeviceListing] = {}

    def look(scheme: str, search: str) -> None:
        try:
            results[scheme] = pkgutil.resolve_name(search)(scan_s)
        except MissingExtraError as refusal:
            note = Message("{kind}: not looked at. {refusal}", kind=scheme, refusal=refusal)
            results[scheme] = DeviceListing(notes=[note])
        except PlushSenseError as refusal:
            results[scheme] = DeviceListing(notes=[refusal.message])
        except Exception as cause:  # noqa: BLE001, RUF100
            results[scheme] = DeviceListing(
                notes=[Message("{kind} cannot be used: {split}.", kind=scheme, split=" ".join(str(cause).split()))]
            )

    searches = {scheme: search for scheme, search in SEARCHES.items() if network or scheme not in _SENDING}
    threads = [threading.Thread(target=look, args=item, daemon=True) for item in searches.items()]
    for thread in threads:
        thread.start()
    listing = DeviceListing()
    for thread, scheme in zip(threads, searches, strict=True):
        thread.join(scan_s + _GRACE_S)
        late = Message("{kind} did not answer within {scan_s:g} s.", kind=scheme, scan_s=scan_s + _GRACE_S)
        part = results.get(scheme) or DeviceListing(notes=[late])
        listing.devices += part.devices
        listing.notes += part.notes
    listing.devices.append(DeviceInfo("virtual://?person=7", "virtual", "virtual toy", "in this program; a simulation"))
    return listing
