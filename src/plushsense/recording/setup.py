"""Prepare a recording session for the terminal and the studio: derive folder, layout and head from a request."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import Layout
from plushsense.devices.base import Device, now_ms
from plushsense.devices.opening import open_device, parse_url
from plushsense.devices.virtual.stream import VirtualDevice
from plushsense.recording.plan import load_protocol
from plushsense.recording.recorder import Recorder
from plushsense.recording.session import check_session, check_subject, new_session, next_session
from plushsense.recording.session_files import SessionHead
from plushsense.recording.states import RecorderStatus

_SIMULATED = "virtual"


def open_toy(url: str, layout: Layout | str | None = None) -> Device:
    """Open a toy by its URL as `open_device`; when it is disconnected later, wait for it and record the gap."""
    return open_device(url, layout, reconnect=True)


def is_virtual(url: str) -> bool:
    """Return whether a URL opens the virtual toy in this process."""
    return parse_url(url).scheme == _SIMULATED


def with_speed(url: str, speed: float) -> str:
    """Return the URL of a virtual or replayed toy with this speed, unless it names one itself."""
    address = parse_url(url)
    if address.scheme not in (_SIMULATED, "replay") or "speed" in address.query:
        return url
    return f"{url}{'&' if '?' in url else '?'}speed={speed:g}"


def speed_of(url: str) -> float:
    """Return the speed in the URL of a virtual or replayed toy; 1 for any other."""
    address = parse_url(url)
    return address.number("speed", 1.0) if address.scheme in (_SIMULATED, "replay") else 1.0


def prompt_virtual(recorder: Recorder) -> None:
    """Make the person of a virtual toy perform the requested gestures when they are recorded.

    It has no effect on any other toy. Call it before the recorder starts.
    """
    inner = getattr(recorder.device, "inner", recorder.device)
    if not isinstance(inner, VirtualDevice):
        return
    inner.follow()

    def on_change(what: str, status: RecorderStatus) -> None:
        if what == "countdown" and status.state == "countdown":
            inner.perform(status.step.gesture, recorder.begins_ms)

    recorder.subscribe(on_change)


PROTOCOL = "plush-17"
"""The default protocol of a new session."""
FASTEST = 1000.0


@dataclass(frozen=True)
class SessionRequest:
    """A request for a recording session, as the terminal and the studio make it.

    Attributes:
        device: the toy's URL.
        subject: a code; "" for a protocol that is recorded without a person.
        protocol, words: "" is `PROTOCOL` in its default wording for a new session, unchanged for a continued one.
        layout: "" is the URL's layout or plush-15 for a new session, unchanged for a continued one.
        age_group, gender, consent: see `SessionHead`.
        speed: times real time at which the toy runs.
        simulated: the toy is a virtual one, although its URL does not say so.
    """

    device: str
    subject: str = ""
    protocol: str = ""
    words: str = ""
    layout: str = ""
    age_group: str = ""
    gender: str = ""
    consent: str = ""
    speed: float = 1.0
    simulated: bool = False


def check_speed(speed: float) -> float:
    """Return a speed if it is valid, else raise ConfigError."""
    if not 0.0 <= speed <= FASTEST:
        raise ConfigError(f"--speed is {speed:g}; 0 (as fast as it can) to {FASTEST:g} is accepted.")
    return speed


def session_folder(
    out: Path, request: SessionRequest, session: str | None = None, new: bool = False
) -> tuple[Path, SessionHead | None]:
    """Return the session's folder in ``out``, and its head if it exists already.

    Args:
        session: its name; None: the person's last session if it is unfinished, else a new number.
        new: always begin a new session.

    Raises:
        ConfigError: without a subject, or when a new session was requested and one of this name exists.
        DatasetError: for an invalid code or name.
    """
    subject = request.subject
    if not subject and request.protocol and load_protocol(request.protocol).needs_nobody:
        subject = NOBODY
    if not subject:
        raise ConfigError("The session has no person: give --subject with the person's code, such as S01.")
    person = out / check_subject(subject)
    if session is not None:
        name = check_session(session)
    else:
        name = new_session(person) if new else next_session(person)
    known = SessionHead.read(person / name)
    if known is not None and new:
        raise ConfigError(f"The session '{person / name}' exists: leave --new off, or give another --session.")
    return person / name, known


def session_layout(request: SessionRequest, folder: Path, known: SessionHead | None) -> Layout | str | None:
    """Return the layout to open the toy with; None leaves it to the URL."""
    if not request.layout and known is not None:
        return Layout.from_dict(known.layout, f"layout in '{folder}'")
    return request.layout or None


def session_head(request: SessionRequest, folder: Path, fresh: bool, layout: Layout, software: str) -> SessionHead:
    """Return the head of the requested session; settings left out for a continued session are empty.

    Args:
        fresh: whether the session is new.
        layout: the open toy's.
        software: the program that records.
    """
    named = request.protocol or (PROTOCOL if fresh else "")
    if not named and request.words:
        raise ConfigError("--words goes with --protocol: a continued session keeps the wording it began with.")
    protocol = load_protocol(named, request.words or None) if named else None
    return SessionHead(
        subject=folder.parent.name,
        session=folder.name,
        started_ms=now_ms(),
        layout=layout.to_dict(),
        protocol=protocol.to_dict() if protocol is not None else {},
        age_group=request.age_group,
        gender=request.gender,
        consent=request.consent,
        device=request.device,
        software=software,
        simulated=request.simulated or is_virtual(request.device) or request.speed != 1.0,
    )


def is_pseudo_terminal(request: SessionRequest, head: SessionHead) -> bool:
    """Return whether the port is a pseudo terminal, possibly of a virtual toy that is not marked as one."""
    return "/dev/pts/" in request.device and not head.simulated


def lacks_consent(head: SessionHead) -> bool:
    """Return whether a person is recorded without a reference to a signed form."""
    return not (head.consent or head.subject == NOBODY or head.simulated)
