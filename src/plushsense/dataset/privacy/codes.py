"""Advise on codes of people: the next free one, one that exists in another spelling, one that looks like a name."""

from __future__ import annotations

import re
from dataclasses import dataclass

from plushsense.core.gestures import NOBODY
from plushsense.core.sentences import Message
from plushsense.dataset.privacy.removed import RemovedCodes, comparable
from plushsense.dataset.store import UNKNOWN_SUBJECT

_FIRST = "S01"
# Words before a number that are not the name of a person.
_PLAIN = (
    "subj", "subject", "sub", "child", "kid", "pat", "patient", "person", "part", "participant", "test", "pilot",
    "user", "bērns", "berns", "dalībnieks", "dalibnieks", "cilvēks", "cilveks", "persona",
)  # fmt: skip


@dataclass(frozen=True)
class CodeDoubt:
    """A question about a code, and the codes to choose from, each with the text of the answer."""

    question: Message
    answers: tuple[tuple[Message, str], ...]


@dataclass(frozen=True)
class HomeCodes:
    """The codes of the people in a home: of recorded sessions, newest last, of data sets, and of those removed."""

    recorded: tuple[str, ...]
    others: frozenset[str]
    removed: RemovedCodes

    @property
    def known(self) -> frozenset[str]:
        """Return the codes of the people who are in the home now."""
        return self.others.union(self.recorded) - {NOBODY, UNKNOWN_SUBJECT}

    def next_free(self) -> str:
        """Return a code that continues those of the recorded sessions, or S01."""
        last = next((c for c in reversed(self.recorded) if re.search(r"\d$", c) and not looks_like_name(c)), "")
        prefix, digits = re.fullmatch(r"(.*?)(\d+)", last or _FIRST).groups()  # type: ignore[union-attr]
        number = int(digits) if last else 0
        taken = set(map(comparable, self.known))
        while True:
            number += 1
            code = f"{prefix}{number:0{len(digits)}d}"
            if comparable(code) not in taken and code not in self.removed:
                return code

    def same(self, code: str) -> str:
        """Return a known code that differs in case, punctuation and leading zeros only; "" if ``code`` is known."""
        return (
            "" if code in self.known else next((c for c in sorted(self.known) if comparable(c) == comparable(code)), "")
        )

    def doubt(self, code: str) -> CodeDoubt | None:
        """Return the question to ask before a session is recorded with this code, None if it is fine."""
        free = self.next_free()
        if known := self.same(code):
            return CodeDoubt(
                Message("“{code}” is written almost like {known}. Is it the same person?", code=code, known=known),
                (
                    (Message("Yes, it is {code}", code=known), known),
                    (Message("No, take {code}", code=free), free),
                ),
            )
        keep = (Message("Keep {code}", code=code), code)
        other = (Message("Take {code}", code=free), free)
        if code in self.removed:
            removed = Message("{code} was removed for good. Somebody else needs another code.", code=code)
            return CodeDoubt(removed, (other, keep))
        if code not in (*self.known, NOBODY) and looks_like_name(code):
            name = Message(
                "“{code}” looks like a name. A code keeps names away from the recordings; who has which code stays on "
                "paper.",
                code=code,
            )
            return CodeDoubt(name, (other, keep))
        return None


def looks_like_name(code: str) -> bool:
    """Return whether a code has three or more letters in turn that are no usual word for a participant."""
    return any(word.casefold() not in _PLAIN for word in re.findall(r"[^\W\d_]{3,}", code))
