"""Build the review page: the recordings of a data set as a table, one by one, and as overlays, and its streams.

The query parameters of the address contain the state of the page, for links and reloads:

``/review?dataset=DIR``
    a data set in the folders of the studio, as an absolute path or relative to the home folder; by default the first.
``recordings=ID`` (several times), ``title=TEXT``
    show only these recordings, under this title. Unknown ids are left out and reported.
``session=NAME``
    show only the recordings of these sessions (``S01/1,S02/1``), which were just put there, with a button to undo that.
``selection=KEY``
    the same, but stored under a key. `plushsense.studio.app.selections.Selections.address` chooses one of these.
``person, gesture, state, severity, check, text``
    the filters (`plushsense.studio.pages.review.controller.RecordingFilter`).
``view=table | one | overlay | durations | stream``, ``recording=ID``, ``stream=ID``
    the open view; ``recording`` alone opens that recording.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from nicegui import context, run, ui

from plushsense.studio.app.choices import Choices
from plushsense.studio.app.selections import Selections
from plushsense.studio.app.shell import Page, add_style, address, query, tag
from plushsense.studio.pages.review.controller import DURATIONS, ONE, OVERLAY, STREAM, TABLE, ReviewController
from plushsense.studio.pages.review.gesture_views import DurationsView, GestureOverlayView
from plushsense.studio.pages.review.recording_view import RecordingView
from plushsense.studio.pages.review.review import Review, Reviews
from plushsense.studio.pages.review.stream_view import StreamView
from plushsense.studio.pages.review.table_view import RecordingTableView
from plushsense.studio.widgets.destination import moved, take_back

_CSS = Path(__file__).with_name("review.css")


async def show(page: Page) -> None:
    """Build the page."""
    add_style(_CSS.read_text(encoding="utf-8"))
    words, request, values = page.words, context.client.request, query()
    recordings = request.query_params.getlist("recordings") if request is not None else []
    datasets = page.workspace.datasets()
    choices = page.workspace.part(Choices)
    place = values.get("dataset") or choices.last("dataset", map(str, datasets))
    with page.show_errors():
        place = str(page.workspace.inside(place)) if place else ""
    _choice_of_dataset(page, datasets, place)
    if not place:
        ui.label(words("There is no data set yet. Record a session, or import recordings on the home page.")).classes(
            "ps-dim"
        )
        ui.link(words("Home"), "/").classes("ps-link")
        return
    opening = tag(ui.label(words("Opening the data set …")).props("role=status"), "opening")
    await context.client.connected()
    with page.show_errors():
        reviews = page.workspace.part(Reviews)
        review: Review | None = await run.io_bound(reviews.open, place)
        if review is None:
            return  # the studio is ending
        choices.keep(dataset=str(review.path))
        title = values.get("title", "")
        if values.get("selection"):
            selection = await run.io_bound(page.workspace.part(Selections).read, values["selection"])
            if selection is None:
                return
            title, recordings = selection
        controller = ReviewController(page, review, values)
        if sessions := values.get("session", "").split(",") if values.get("session") else []:
            title = moved(sessions, review.dataset.head.name)
            recordings = [i for i in review.infos if i.startswith(tuple(f"{name}/" for name in sessions))]
            back = address("record", ended=sessions[0]) if len(sessions) == 1 else address("home")
            controller.take_back = lambda: take_back(page, review.path, sessions, lambda: ui.navigate.to(back))
        controller.limit(title, recordings)
        controller.build(
            {
                TABLE: RecordingTableView,
                ONE: RecordingView,
                OVERLAY: GestureOverlayView,
                DURATIONS: DurationsView,
                STREAM: StreamView,
            }
        )
        await controller.begin(values.get("recording", ""))
    opening.delete()


def _choice_of_dataset(page: Page, datasets: list[Path], place: str) -> None:
    words = page.words
    titles = {str(p.resolve()): page.workspace.title(p) for p in datasets}
    count = Counter(titles.values())
    options = {p: f"{t} ({Path(p).name})" if count[t] > 1 else t for p, t in titles.items()}
    if len(options) > 1 or place not in options:
        choice = ui.select(
            options,
            value=place if place in options else None,
            label=words("Data set"),
            on_change=lambda e: ui.navigate.to(address("review", dataset=str(e.value))),
        )
        tag(choice.style("min-width: 280px"), "dataset")
