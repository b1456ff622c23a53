"""Keep the decisions of each browser tab, so that the last one can be undone, however many recordings it is about."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.dataset.marks import Mark, MarksFollower, MarkState, append_marks, inverse_marks

_MAX_VISITS = 50


@dataclass(frozen=True)
class ReviewDecision:
    """A decision made in a browser tab about recordings, with the states of their marks before and after it."""

    action: str
    before: Mapping[str, MarkState]
    after: Mapping[str, MarkState]
    check: str = ""
    rows: tuple[int, int] = (0, -1)

    @property
    def recording(self) -> str:
        """The only recording, stream or person that the decision is about, or the first one."""
        return next(iter(self.before))

    def changed_part(self, marks: MarkState) -> Any:
        """Return the part of a mark state that the decision changes."""
        if self.check:
            return self.check in marks.accepted
        if self.action in ("exclude", "include"):
            return marks.excluded
        if self.action in ("label", "unlabel"):
            return marks.stretches
        if self.action == "relabel":
            return marks.gesture
        return marks.start, marks.stop, marks.how

    def stands(self, identity: str, now: MarkState) -> bool:
        """Return whether the marks still state for ``identity`` what the decision made them state."""
        return bool(self.changed_part(now) == self.changed_part(self.after[identity]))

    def inverse(self, who: str, why: str) -> list[Mark]:
        """Return the marks that undo the decision."""
        start, stop = self.rows
        marks: list[Mark] = []
        for identity, before in self.before.items():
            mark = Mark(identity, self.action, who, start=start, stop=stop, check=self.check)
            marks += inverse_marks(mark, before, who, why)
        return marks


class Decisions:
    """The marks of a data set, and the decisions of each browser tab that can be undone. Not thread-safe."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._marks = MarksFollower(path)
        self._histories: OrderedDict[str, list[ReviewDecision]] = OrderedDict()
        self.states = self._marks.states()

    def look(self) -> bool:
        """Read marks written since the last call, also by other programs; return whether there are any."""
        before = self.states
        self.states = self._marks.states()
        return self.states is not before

    def state(self, identity: str) -> MarkState:
        """Return the state of a recording, stream or person according to the marks."""
        return self.states.get(identity, MarkState())

    def decide(
        self,
        visit: str,
        about: Iterable[str],
        action: str,
        make: Callable[[], object],
        check: str = "",
        rows: tuple[int, int] = (0, -1),
    ) -> int:
        """Call ``make`` to write marks, store how to undo them as one decision, and return how many states changed."""
        self.look()
        before = {identity: self.state(identity) for identity in about}
        make()
        self.look()
        changed = [identity for identity in before if self.state(identity) != before[identity]]
        if changed:
            history = self._histories.setdefault(visit, [])
            earlier, later = {i: before[i] for i in changed}, {i: self.state(i) for i in changed}
            history.append(ReviewDecision(action, earlier, later, check, rows))
            self._histories.move_to_end(visit)
            while len(self._histories) > _MAX_VISITS:
                self._histories.popitem(last=False)
        return len(changed)

    def history(self, visit: str) -> Sequence[ReviewDecision]:
        """Return the decisions of a browser tab that can be undone, oldest first."""
        return tuple(self._histories.get(visit, ()))

    def undo(
        self, visit: str, who: str, why: str = "", check: Callable[[], None] | None = None
    ) -> ReviewDecision | None:
        """Undo the last decision of a browser tab by writing the inverse marks; return None if there is none.

        What was changed elsewhere since stays; the returned decision is about the other recordings only. ``check`` is
        that of `append_marks`.

        Raises:
            DatasetError: if everything was changed elsewhere since. The next call undoes an older decision.
        """
        history = self._histories.get(visit)
        if not history:
            return None
        self.look()
        last = history[-1]
        standing = {i: b for i, b in last.before.items() if last.stands(i, self.state(i))}
        if not standing:
            history.pop()
            raise DatasetError(
                "“{recording}” has been changed in another window or program since then, so nothing is undone.",
                recording=last.recording,
            )
        undone = replace(last, before=standing)
        append_marks(self._path, undone.inverse(who, why), check)
        history.pop()
        self.look()
        return undone
