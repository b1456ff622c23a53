"""Which recordings of a protocol are made, passed over or to be made again: the session's place in its plan."""

from __future__ import annotations

from plushsense.recording.protocol import Step
from plushsense.recording.session import Key, Standing


def key_of(step: Step) -> Key:
    """What a recording is known by: its gesture and repetition."""
    return step.gesture, step.repetition


class Course:
    """A session's steps and what came of each.

    Attributes:
        steps: all, in order.
        takes: the recording of each step that counts; the newest comes last.
        skipped: steps that were passed over.
        aside: files of a step that are not to be used.
        at: the step that is asked for.
    """

    def __init__(self, steps: tuple[Step, ...], standing: Standing) -> None:
        self.steps = steps
        self.takes = dict(standing.takes)
        self.skipped = set(standing.skipped)
        self.aside = {key: list(files) for key, files in standing.aside.items()}
        self.at = 0
        self._last: Key | None = next(reversed(self.takes), None)

    @property
    def step(self) -> Step:
        """The recording that is asked for."""
        return self.steps[self.at]

    @property
    def last(self) -> Key | None:
        """The last recording that was made and counts; None when there is none, or it is to be made again."""
        return self._last if self._last in self.takes else None

    @property
    def last_file(self) -> str:
        """Its file; "" when there is none."""
        return self.takes[self.last] if self.last is not None else ""

    @property
    def redone(self) -> int:
        """Files that were set aside."""
        return sum(map(len, self.aside.values()))

    def _left(self, order: tuple[Step, ...]) -> Step | None:
        return next((s for s in order if key_of(s) not in self.takes and key_of(s) not in self.skipped), None)

    def following(self) -> Step | None:
        """The recording to be made after this one; None when this is the last."""
        return self._left(self.steps[self.at + 1 :] + self.steps[: self.at])

    def advance(self, from_start: bool = False) -> bool:
        """On to the next recording that is to be made, around the end if need be; False when all are."""
        at = 0 if from_start else self.at + 1
        left = self._left(self.steps[at:] + self.steps[:at])
        self.at = left.number if left is not None else len(self.steps) - 1
        return left is not None

    def set_aside(self, key: Key) -> str:
        """A recording is not to be used: its file; the step is asked for again."""
        file = self.takes.pop(key)
        self.aside.setdefault(key, []).append(file)
        self.at = next(s.number for s in self.steps if key_of(s) == key)
        return file

    def keep(self, key: Key) -> str:
        """Its newest file that was set aside counts after all; "" when there is none or another counts."""
        if key in self.takes or not self.aside.get(key):
            return ""
        file = self.takes[key] = self.aside[key].pop()
        self._last = key
        return file

    def made(self, key: Key, file: str) -> None:
        """A recording was finished; an earlier one of the step is set aside."""
        earlier = self.takes.pop(key, "")
        if earlier:
            self.aside.setdefault(key, []).append(earlier)
        self.takes[key] = file
        self.skipped.discard(key)
        self._last = key
