"""Session folders as our own recorder leaves them: ``session.json`` says whose they are, whatever the folders' names.

Every file of a session is a recording, its stream, a companion of one of these (sidecar, head, log), or left over from
a crash; only what is none of these is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from plushsense.core.errors import BadInput, DatasetError
from plushsense.core.recfile import STREAM_NAME, parse_name
from plushsense.core.signal import Layout
from plushsense.dataset.people import PersonInfo
from plushsense.dataset.sources import COMPANIONS, LEFT_OUT, Found
from plushsense.dataset.store import RECORDINGS, STREAMS
from plushsense.recording.sessionfile import SESSION_HEAD, SESSION_LOG, SIDECAR, SessionHead, set_aside

# What the recorder leaves when it is killed, or is still at work.
LEFT_OVER = {
    ".part": "not finished when the recorder stopped; its rows are in the session's stream",
    ".new": "not finished when the recorder stopped; its rows are in the session's stream",
    ".torn": "damaged by a crash and set aside by the recorder; its rows are in the session's stream",
    ".lock": "a lock of the recorder",
}

Sessions = dict[Path, SessionHead | str]


def read_sessions(files: Iterable[Path]) -> Sessions:
    """The head of every session folder among ``files``, or the reason why it cannot be read."""
    sessions: Sessions = {}
    for path in files:
        if path.name != SESSION_HEAD:
            continue
        try:
            head = SessionHead.read(path.parent)
            if head is not None and head.subject.strip():
                Layout.from_dict(head.layout, "layout")
        except (BadInput, RecursionError) as cause:
            sessions[path.parent] = f"its {SESSION_HEAD} cannot be used: {cause}"
            continue
        if head is not None:
            sessions[path.parent] = head if head.subject.strip() else f"its {SESSION_HEAD} names no subject"
    return sessions


def session_of(path: Path, sessions: Mapping[Path, object]) -> Path | None:
    """The session folder that a file lies in, the nearest; None where there is none."""
    return next((place for place in path.parents if place in sessions), None)


def common_layout(sessions: Sessions, given: Layout | None, of: str) -> Layout | None:
    """The layout of all sessions, and the given one where there is any; ``of`` says whose that is.

    Raises:
        DatasetError: when two sessions, or a session and the given layout, do not agree.
    """
    agreed = given
    for place, head in sessions.items():
        if isinstance(head, str):
            continue
        own = Layout.from_dict(head.layout, f"layout of the session '{place.name}'")
        if agreed is None:
            agreed, of = own, f"session '{place.name}'"
        elif own.to_dict() != agreed.to_dict():
            what = f"'{own.name}'" if own.name != agreed.name else f"another '{own.name}'"
            raise DatasetError(
                f"Session '{place.name}' was recorded with the layout {what}, but {of} is '{agreed.name}': "
                "a data set has one layout, so import them apart."
            )
    if agreed is not None and agreed.is_labelled and any(isinstance(h, SessionHead) for h in sessions.values()):
        raise DatasetError(
            f"Layout '{agreed.name}' has a label on every row, which recordings of a session do not carry: "
            "take 'label' out of its csv.columns."
        )
    return agreed


def find_sessions(sessions: Sessions, files: Iterable[Path]) -> Iterator[Found]:
    """What each of ``files``, all in a session folder, is."""
    by_session: dict[Path, list[Path]] = {}
    for path in files:
        place = session_of(path, sessions)
        if place is not None:
            by_session.setdefault(place, []).append(path)
    for place, mine in by_session.items():
        head = sessions[place]
        if isinstance(head, str):
            yield from (Found(path, "", reason=head) for path in mine)
        else:
            yield from _find(place, head, mine)


def _find(place: Path, head: SessionHead, files: list[Path]) -> Iterator[Found]:
    try:
        aside = set_aside(place)
    except (BadInput, OverflowError, RecursionError) as cause:
        # Without the log nobody knows which takes were made again.
        yield from (Found(path, "", reason=f"its {SESSION_LOG} cannot be used: {cause}") for path in files)
        return
    stream = place / STREAM_NAME
    mains = {p.with_suffix("").as_posix(): p for p in files if p == stream or parse_name(p.name) is not None}
    for path in files:

        def found(kind: str, reason: str = "", beside: Path | None = None, why: str = "", path: Path = path) -> Found:
            return Found(path, kind, head.subject, reason, head.session or place.name, beside=beside, aside=why)

        name = path.name
        if path == stream:
            yield found(STREAMS)
        elif parse_name(name) is not None:
            yield found(RECORDINGS, why=aside.get(name, ""))
        elif path.parent == place and name in (SESSION_HEAD, SESSION_LOG):
            yield found(COMPANIONS, beside=stream if stream in files else None)
        elif path.suffix in LEFT_OVER:
            yield found(LEFT_OUT, LEFT_OVER[path.suffix])
        elif name.endswith(SIDECAR):
            main = mains.get(path.with_suffix("").as_posix())
            if main is None:
                yield found(LEFT_OUT, "the sidecar of a recording that is not there")
            else:
                yield found(COMPANIONS, beside=main)
        else:
            yield found("", "no file of a session: expected are recordings, their sidecars, the stream and the log")


def people_of(sessions: Sessions) -> tuple[list[PersonInfo], list[str]]:
    """The people of the sessions, the latest session's word first, and a sentence for each that changed."""
    people: dict[str, PersonInfo] = {}
    notes = []
    heads = sorted((h for h in sessions.values() if isinstance(h, SessionHead)), key=lambda h: h.started_ms)
    for head in heads:
        said = {key: _plain(getattr(head, key)) for key in ("age_group", "gender", "consent")}
        before = people.get(head.subject)
        if before is not None:
            for key, value in said.items():
                was = getattr(before, key)
                if was and value and was != value:
                    notes.append(
                        f"the sessions of '{head.subject}' differ in {key.replace('_', ' ')} ('{was}', '{value}'): "
                        "the latest is kept"
                    )
                said[key] = value or was
        people[head.subject] = PersonInfo(head.subject, said["age_group"], said["gender"], said["consent"])
    return list(people.values()), notes


def _plain(text: str) -> str:
    """A text as one line that every file can hold."""
    text = text.encode("utf-8", "replace").decode("utf-8")
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
