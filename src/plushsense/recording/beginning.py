"""What is said before a session begins: whose it is, what is recorded from which toy; and what that makes of it.

The terminal and the studio say it in their own ways; what follows is the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import NOBODY
from plushsense.core.signal import Layout
from plushsense.devices.base import now_ms
from plushsense.recording.protocol import load_protocol
from plushsense.recording.session import check_session, check_subject, new_session, next_session
from plushsense.recording.sessionfile import SessionHead
from plushsense.recording.toy import is_virtual

PROTOCOL = "plush-17"
"""What is recorded in a new session where nobody says it."""
FASTEST = 1000.0


@dataclass(frozen=True)
class Wanted:
    """What a person says of a session.

    Attributes:
        device: the toy's URL.
        subject: a code; "" where the protocol is the toy's alone.
        protocol, words: "" is `PROTOCOL` in its own words for a new session, and as it was for one that goes on.
        layout: "" is the URL's or plush-15, and as it was for one that goes on.
        age_group, gender, consent: as they stand in the head.
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
    """A speed that a toy may have; ConfigError for any other."""
    if not 0.0 <= speed <= FASTEST:
        raise ConfigError(f"--speed is {speed:g}; 0 (as fast as it can) to {FASTEST:g} is accepted.")
    return speed


def place(out: Path, wanted: Wanted, session: str | None = None, new: bool = False) -> tuple[Path, SessionHead | None]:
    """The session's folder in ``out``, and its head where it is there already.

    Args:
        session: its name; None: the person's last one when it is unfinished, else a number.
        new: begin another one in any case.

    Raises:
        ConfigError: without a subject, or when a session of this name is there and a new one is wanted.
        DatasetError: for a code or name that cannot be.
    """
    subject = wanted.subject
    if not subject and wanted.protocol and load_protocol(wanted.protocol).needs_nobody:
        subject = NOBODY
    if not subject:
        raise ConfigError("Whose session is it? Give --subject with the person's code, such as S01.")
    person = out / check_subject(subject)
    if session is not None:
        name = check_session(session)
    else:
        name = new_session(person) if new else next_session(person)
    known = SessionHead.read(person / name)
    if known is not None and new:
        raise ConfigError(f"The session '{person / name}' is there: leave --new off, or give another --session.")
    return person / name, known


def layout_of(wanted: Wanted, folder: Path, known: SessionHead | None) -> Layout | str | None:
    """The layout to open the toy with; None leaves it to the URL."""
    if not wanted.layout and known is not None:
        return Layout.from_dict(known.layout, f"layout in '{folder}'")
    return wanted.layout or None


def head_of(wanted: Wanted, folder: Path, fresh: bool, layout: Layout, software: str) -> SessionHead:
    """The session as it was said; what was left out of a session that goes on is empty.

    Args:
        fresh: whether the session begins now.
        layout: the open toy's.
        software: the program that records.
    """
    named = wanted.protocol or (PROTOCOL if fresh else "")
    if not named and wanted.words:
        raise ConfigError("--words goes with --protocol: a session that goes on keeps the words it began with.")
    protocol = load_protocol(named, wanted.words or None) if named else None
    return SessionHead(
        subject=folder.parent.name,
        session=folder.name,
        started_ms=now_ms(),
        layout=layout.to_dict(),
        protocol=protocol.to_dict() if protocol is not None else {},
        age_group=wanted.age_group,
        gender=wanted.gender,
        consent=wanted.consent,
        device=wanted.device,
        software=software,
        simulated=wanted.simulated or is_virtual(wanted.device) or wanted.speed != 1.0,
    )


def is_pseudo(wanted: Wanted, head: SessionHead) -> bool:
    """Whether the port is a pseudo terminal, behind which a virtual toy may sit that nobody has marked as one."""
    return "/dev/pts/" in wanted.device and not head.simulated


def lacks_consent(head: SessionHead) -> bool:
    """Whether a person is recorded without a reference to a signed form."""
    return not (head.consent or head.subject == NOBODY or head.simulated)
