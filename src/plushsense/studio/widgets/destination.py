"""Choose the data set that recorded sessions go into, put them there, and take them out again."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nicegui import run, ui

from plushsense.core.sentences import join_names
from plushsense.dataset.files import DATASETS
from plushsense.studio.app.choices import Choices
from plushsense.studio.app.jobs import DONE, RUNNING, Jobs
from plushsense.studio.app.shell import Page, address, named, on_change, tag
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.widgets.elements import admitting, ask, errors_beside

_NAMED = 5


def session_name(session: Path) -> str:
    """Return the name of a session's folder as pages show it: ``<person>/<session>``."""
    return f"{session.parent.name}/{session.name}"


def moved(sessions: Sequence[str], dataset: str) -> str:
    """Return the text that says which sessions are in which data set."""
    return f"{join_names(sessions, most=_NAMED)} → {dataset}"


class Destination:
    """Fields for the data set that sessions of one layout go into: one that exists, or a new one.

    The last choice is preselected; real sessions and those of a virtual toy have one each. Screen readers read
    ``about``, which tells these fields from others of the page.
    """

    def __init__(self, page: Page, layout: str, simulated: bool, about: str = "") -> None:
        self._page, workspace, words = page, page.workspace, page.words
        self._key = f"sessions of {layout}{', simulated' if simulated else ''}"
        fitting = {str(path): workspace.title(path) for path in workspace.fitting(layout, simulated)}
        last = workspace.part(Choices).last(self._key, fitting, "")
        with ui.row().classes("items-start ps-small-gap"):
            options = fitting | {"": words("a new data set")}
            self._list = ui.select(options, value=last, label=words("Into the data set")).classes("ps-wide")
            free = workspace.free_name(DATASETS, words("recordings"))
            self._name = ui.input(words("Name of the new data set"), value=free).classes("ps-wide")
        if about:
            for field in (self._list, self._name):
                named(field, f"{about}: {field.props['label']}")
        tag(self._list, "destination").set_visibility(bool(fitting))
        tag(self._name, "new-name").bind_visibility_from(self._list, "value", value="")

    async def put(self, sessions: Sequence[Path], then: Callable[[Path], Any]) -> bool:
        """Import sessions into the data set, and call ``then`` with it; the choice is preselected the next time.

        Returns:
            Whether the import has begun.
        """
        page, workspace, words = self._page, self._page.workspace, self._page.words
        jobs = workspace.part(Jobs)
        with errors_beside(page, self._name):
            chosen = str(self._list.value or "")
            place = workspace.inside(chosen) if chosen else workspace.new(DATASETS, str(self._name.value or ""))
            name = workspace.title(place)

            def begin(readmit: bool) -> None:
                job = jobs.import_sessions(
                    sessions, place, words("Import into the data set “{name}”", name=name), readmit
                )
                workspace.part(Choices).keep(**{self._key: str(place), "dataset": str(place)})
                page.say(words("The recordings go into the data set “{name}” …", name=name))

                ended = False

                def follow() -> None:
                    nonlocal ended
                    if ended or job.state == RUNNING:
                        return
                    ended = True
                    if job.state == DONE:
                        then(place)
                        return
                    stopped = words("The recordings were not put into a data set: try it again on the home page.")
                    page.say(words.failure(job.refusal) or stopped, "error")

                on_change(jobs.changed, follow)

            return await admitting(page, begin)
        return False


def review_address(dataset: Path, sessions: Sequence[Path]) -> str:
    """Return the address of the review page that shows the recordings of sessions, which were just put there."""
    return address("review", dataset=dataset, session=",".join(map(session_name, sessions)))


async def take_back(page: Page, dataset: Path, sessions: Sequence[str], then: Callable[[], Any]) -> None:
    """Take sessions (see `session_name`) out of a data set again, and call ``then``; ask if decisions would be lost."""
    words = page.words

    async def go(_: str = "") -> None:
        with page.show_errors():
            page.workspace.part(Jobs).check_unused(dataset)
            await run.io_bound(_take_back, page.workspace, dataset, sessions)
            if inspect.isawaitable(done := then()):
                await done

    with page.show_errors():
        if not (decided := await run.io_bound(_decided, dataset, sessions)):
            await go()
            return
        title = words(
            "In the data set, {n:recording is|recordings are} trimmed, left out or decided otherwise since. Taking out "
            "{sessions} drops these decisions.",
            n=decided,
            sessions=join_names(sessions, most=_NAMED),
        )
        ask(words, title, words("Take out"), go)


def _decided(dataset: Path, sessions: Sequence[str]) -> int:
    """Return how many recordings of sessions somebody has decided about since they were recorded."""
    from plushsense.dataset.marks import RECORDER, MarkState, read_marks

    theirs = tuple(f"{name}/" for name in sessions)
    states = (state for name, state in read_marks(dataset).items() if name.startswith(theirs))
    return sum(s != MarkState(excluded=s.excluded and s.excluded_by == RECORDER) for s in states)


def _take_back(workspace: Workspace, dataset: Path, sessions: Sequence[str]) -> None:
    """Take sessions out of a data set; one that holds nothing else is discarded."""
    from plushsense.dataset.index import open_dataset
    from plushsense.dataset.privacy.forget import take_out

    theirs = tuple(f"{name}/" for name in sessions)
    if all(info.id.startswith(theirs) for info in open_dataset(dataset).recordings):
        workspace.discard(dataset)
        return
    for name in sessions:
        take_out(dataset, workspace.inside(workspace.recordings / name))
