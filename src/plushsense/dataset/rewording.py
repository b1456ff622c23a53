"""What people wrote down, under pseudonyms: session files, marks, the people's table, the head of a data set.

Codes and names are replaced, dates moved, logins become roles, and what points at one toy or computer is dropped.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tomli_w

from plushsense.core.errors import DatasetError
from plushsense.core.tomlfile import read_toml
from plushsense.dataset.people import PersonInfo
from plushsense.dataset.store import HEAD
from plushsense.dataset.timeshift import FIRST_MS, shifted_number, shifted_text
from plushsense.dataset.wording import Names, without_addresses

ON_FILE = "on file"
ORIGIN = "origin.json"
"""What the importer writes of a file that it converted: the name that somebody gave it, and its hash."""
_MENDED = "mended"
LOGINS = frozenset({"who", "by", "user", "author", "leader", "operator", "recorded_by"})
_SUBJECT, _CONSENT = "subject", "consent"
_PLACES = frozenset({"device", "port", "address", "url", "mac", "hostname", "computer", "serial_number"})
PROSE = frozenset({"why", "text", "note", "notes", "comment", "comments", "said", "description"})
_SECONDS = ("_s", "timestamp", "epoch")
# A program that marks says so in place of a login; that is nobody's name.
_PROGRAMS = re.compile(r"plushsense.*|recorder", re.IGNORECASE | re.DOTALL)
_FILE = re.compile(r"^(?P<label>.+)_(?P<epoch>\d{1,18})_(?P<rows>\d{1,12}(?:\.\w+)?(?:#.*)?)$", re.DOTALL)


@dataclass
class Findings:
    """What a person should know or look at: file (its new path), line (0: the whole file) and a sentence."""

    found: list[dict[str, Any]] = field(default_factory=list)
    prose: int = 0

    def add(self, file: str, message: str, line: int = 0) -> None:
        """One more."""
        self.found.append({"file": file, "line": line, "message": message})

    def told(self) -> list[dict[str, Any]]:
        """All, those that are alike as one."""
        times = Counter((f["file"], f["line"], f["message"]) for f in self.found)
        return [
            {"file": file, "line": line, "message": message if n == 1 else f"{n} times: {message}"}
            for (file, line, message), n in times.items()
        ]


@dataclass(frozen=True)
class Rewording:
    """How one person's (or nobody's) words are rewritten. ``roles`` gives a login's role by its folded form."""

    names: Names
    roles: dict[str, str]
    code: str
    shift_ms: int
    findings: Findings
    drop_notes: bool = False

    def text(self, text: str, where: tuple[str, int] | None = None) -> str:
        """A text with names, addresses and dates rewritten; a replaced name is reported for ``where``."""
        new, put = self.names.replace(shifted_text(without_addresses(text), self.shift_ms))
        if put and where is not None:
            for word, times in Counter(put).items():
                self.findings.add(
                    where[0], f"a name or code in the text was replaced by '{word}' ({times}×): read it", where[1]
                )
        return new

    def name(self, name: str) -> str:
        """A file's name, or the last part of an id: the time in it is moved, its label stays."""
        match = _FILE.match(name)
        if match is None:
            return self.text(name)
        return f"{match['label']}_{shifted_number(int(match['epoch']), self.shift_ms)}_{match['rows']}"

    def role(self, login: str) -> str:
        """``person-1`` in place of a login; a program that marked stays."""
        if not login or _PROGRAMS.fullmatch(login):
            return login
        return self.roles.setdefault(login.casefold(), f"person-{len(self.roles) + 1}")

    def value(self, value: Any, key: str = "", where: tuple[str, int] = ("", 0)) -> Any:
        """A value of JSON or TOML, with everything in it."""
        if isinstance(value, dict):
            # What was cut off a torn line can be a piece of a date.
            torn = value.get("what") == _MENDED
            kept = {k: v for k, v in value.items() if not (torn and k == "text")}
            return {self.text(str(k)): self.value(v, str(k), where) for k, v in kept.items()}
        if isinstance(value, list):
            return [self.value(v, key, where) for v in value]
        if isinstance(value, str):
            return self._string(value, key.casefold(), where)
        if isinstance(value, bool) or value is None:
            return value
        if isinstance(value, int | float):
            return self._number(value, key.casefold())
        return value

    def _string(self, value: str, key: str, where: tuple[str, int]) -> str:
        if key in LOGINS:
            return self.role(value)
        if key == _SUBJECT:
            return self.code if value else value
        if key == _CONSENT:
            return ON_FILE if value else value
        if key in _PLACES:
            return without_addresses(value) if "://" in value else ""
        if key in PROSE and value:
            if self.drop_notes:
                return ""
            self.findings.prose += 1
        return self.text(value, where)

    def _number(self, value: float, key: str) -> float:
        if key.endswith(_SECONDS) and FIRST_MS / 1000 <= value < FIRST_MS / 60:
            return value + self.shift_ms // 1000
        if isinstance(value, int):
            return shifted_number(value, self.shift_ms)
        return value + (shifted_number(int(value), self.shift_ms) - int(value)) if abs(value) < 2.0**53 else value


def logins_in(value: Any, key: str = "") -> Iterator[str]:
    """Every login in a value of JSON."""
    if isinstance(value, dict):
        for k, v in value.items():
            yield from logins_in(v, str(k).casefold())
    elif isinstance(value, list):
        for v in value:
            yield from logins_in(v, key)
    elif isinstance(value, str) and key in LOGINS and value and not _PROGRAMS.fullmatch(value):
        yield value


def subjects_in(value: Any) -> Iterator[str]:
    """What a session's head calls its person."""
    if isinstance(value, dict) and isinstance(value.get(_SUBJECT), str) and value[_SUBJECT]:
        yield value[_SUBJECT]


def read_lines(path: Path) -> Iterator[tuple[int, Any]]:
    """The values of a JSON file (one, line 1) or of a JSON-lines file, with their lines; None for what is no JSON."""
    data = path.read_bytes()
    pieces = data.split(b"\n") if path.suffix.lower() == ".jsonl" else [data]
    for number, piece in enumerate(pieces, 1):
        if not piece.strip():
            continue
        try:
            yield number, json.loads(piece.decode("utf-8-sig"))
        except (ValueError, RecursionError):
            yield number, None


def reworded_json(path: Path, new: str, words: Rewording) -> str | None:
    """A session file's text under pseudonyms; None when nothing of it can be read.

    A line that is no JSON was torn by a crash: nobody can tell what it says, so it is left out and reported.
    """
    lines = path.suffix.lower() == ".jsonl"
    out = []
    for number, value in read_lines(path):
        if value is None:
            words.findings.add(new, "left out: this is no JSON (torn by a crash?)", number if lines else 0)
            continue
        changed = words.value(value, where=(new, number if lines else 0))
        out.append(json.dumps(changed, ensure_ascii=False, indent=None if lines else 1) + "\n")
    return "".join(out) if out or lines else None


def reworded_marks(
    path: Path, words_of: Callable[[str], Rewording | None], renamed: Callable[[str], str], findings: Findings
) -> str:
    """The marks under new ids, in the order of the new ids: the old order would tell who is who.

    ``words_of`` gives the rewording of a mark's recording, None where nobody is known by it; ``renamed`` its new id.
    """
    out: list[tuple[str, str]] = []
    for number, table in read_lines(path):
        identity = table.get("recording") if isinstance(table, dict) else None
        words = words_of(identity) if isinstance(identity, str) else None
        if words is None or not isinstance(identity, str):
            findings.add(path.name, "a mark was left out: it is torn, or nobody is known by its recording", number)
            continue
        new = renamed(identity)
        rest = {k: v for k, v in table.items() if k != "recording"}
        line = {"recording": new} | words.value(rest, where=(path.name, 0))
        out.append((new, json.dumps(line, ensure_ascii=False) + "\n"))
    return "".join(line for _, line in sorted(out, key=lambda pair: pair[0]))


def reworded_people(
    people: Iterable[PersonInfo], words_of: Callable[[str], Rewording], file: str
) -> Iterator[PersonInfo]:
    """The people's table under codes. The consent's reference becomes "on file": it leads to a signed name."""
    for person in people:
        words = words_of(person.subject)
        more = {key: words.text(value, (file, 0)) for key, value in person.more.items()}
        yield replace(
            person,
            subject=words.code,
            age_group=words.text(person.age_group, (file, 0)),
            gender=words.text(person.gender, (file, 0)),
            consent=ON_FILE if person.consent else "",
            more=more,
        )


def reworded_head(folder: Path, words: Rewording) -> str:
    """``dataset.toml`` under pseudonyms; layout and gesture set stay as they are."""
    table = read_toml(folder / HEAD, "data set", DatasetError)
    kept = ("layout", "gesture_set", "format")
    out = {key: value if key in kept else _texts(value, words) for key, value in table.items()}
    return tomli_w.dumps(out)


def _texts(value: Any, words: Rewording) -> Any:
    """A value of the head: who made a data set is meant to be named, so only people's codes and dates change."""
    if isinstance(value, dict):
        return {key: _texts(v, words) for key, v in value.items()}
    if isinstance(value, list):
        return [_texts(v, words) for v in value]
    return words.text(value, (HEAD, 0)) if isinstance(value, str) else value
