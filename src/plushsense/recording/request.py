"""Request of the terminal or the studio for a session: its folder, its layout and its head."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, replace
from pathlib import Path

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import Layout
from plushsense.devices.base import now_ms
from plushsense.devices.opening import is_virtual
from plushsense.recording.plan import load_protocol
from plushsense.recording.session import check_session, check_subject, new_session, next_session
from plushsense.recording.session_files import SessionHead

PROTOCOL = "plush-17"
"""The default protocol of a new session."""
FASTEST = 1000.0


@dataclass(frozen=True)
class SessionRequest:
    """Request of the terminal or the studio for a recording session.

    ``device`` is the toy's URL, ``subject`` a code ("" for a protocol that is recorded without a person). Without
    ``protocol``, ``words`` or ``layout``, a continued session keeps its own, and a new one has `PROTOCOL`, its default
    wording, and the layout of the URL or plush-15. The toy runs at ``speed`` times real time. ``simulated`` marks a
    virtual toy that cannot be recognised by its URL.
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
    """Return ``speed`` if it is valid, else raise ConfigError."""
    if not 0.0 <= speed <= FASTEST:
        raise ConfigError(
            "--speed is {speed:g}; 0 (as fast as it can) to {most:g} is accepted.", speed=speed, most=FASTEST
        )
    return speed


def session_folder(
    out: Path, request: SessionRequest, session: str | None = None, new: bool = False
) -> tuple[Path, SessionHead | None]:
    """Return the folder of the requested session in ``out``, and its head if it exists.

    Args:
        session: its name; None for the person's last session if that is unfinished, else for a new number.
        new: whether to begin a new session in any case.

    Raises:
        ConfigError: if there is no subject, or a new session was requested and one of this name exists.
        DatasetError: for an invalid code or name.
    """
    subject = request.subject
    if not subject and request.protocol and load_protocol(request.protocol).needs_nobody:
        subject = NOBODY
    if not subject:
        raise ConfigError(
            "The session has no person: give --subject with the person's code, such as S01.", field="person"
        )
    person = out / check_subject(subject)
    if session is not None:
        name = check_session(session)
    else:
        name = new_session(person) if new else next_session(person)
    known = SessionHead.read(person / name)
    if known is not None and new:
        raise ConfigError(
            "The session '{person}' exists: leave --new off, or give another --session.",
            person=person / name,
            name=f"{person.name}/{name}",
        )
    return person / name, known


def session_layout(request: SessionRequest, folder: Path, known: SessionHead | None) -> Layout | str | None:
    """Return the layout to open the toy with; None for that of the URL."""
    if not request.layout and known is not None:
        return Layout.from_dict(known.layout, f"layout in '{folder}'")
    return request.layout or None


def session_head(request: SessionRequest, folder: Path, fresh: bool, layout: Layout, software: str) -> SessionHead:
    """Return the head of the requested session; for a continued session, settings not requested are empty.

    Args:
        fresh: whether the session is new.
        layout: the layout of the open toy.
        software: name and version of the recording program.
    """
    named = request.protocol or (PROTOCOL if fresh else "")
    if not named and request.words:
        raise ConfigError("--words goes with --protocol: a continued session keeps the wording it began with.")
    protocol = load_protocol(named, request.words or None) if named else None
    if protocol is not None and protocol.order == "random" and fresh and not protocol.seed:
        protocol = replace(protocol, seed=1 + secrets.randbelow(2**31 - 1))
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
    """Return whether the port is a pseudo terminal, possibly of a virtual toy that is not marked ``simulated``."""
    return "/dev/pts/" in request.device and not head.simulated


def lacks_consent(head: SessionHead) -> bool:
    """Return whether a real session with a person has no reference to a signed consent form."""
    return not (head.consent or head.subject == NOBODY or head.simulated)
