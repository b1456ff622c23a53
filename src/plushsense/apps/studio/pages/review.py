"""The review page: a data set's recordings in a table, one by one, and over each other; every decision is a mark.

The address of the page says what it shows, so that it can be linked to and survives a reload:

``/review?dataset=DIR``
    a data set inside the studio's folders, absolute or within the home folder; without it, the first there is.
``recordings=ID`` (several times), ``title=WORDS``
    only these recordings, and what they have in common. An id that is not there is left out, with a sentence.
``selection=KEY``
    the same, kept under a key. Other pages let `plushsense.apps.studio.reviews.Reviews.address` make the link: it
    takes the ids and chooses between the two.
``person, gesture, state, severity, check, text``
    the filters (`plushsense.apps.studio.review_filter.Filter`).
``view=table | one | overlay``, ``recording=ID``
    what is open; ``recording`` alone opens that one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import context, run, ui

from plushsense.apps.studio.pages.review_desk import Desk
from plushsense.apps.studio.reviewing import Review
from plushsense.apps.studio.reviews import Reviews
from plushsense.apps.studio.shell import Page, tag

_CSS = Path(__file__).parents[1] / "review.css"


async def show(page: Page) -> None:
    """Build the page."""
    ui.add_css(_CSS.read_text(encoding="utf-8"))
    words, request = page.words, context.client.request
    query = request.query_params if request is not None else {}
    asked = {key: str(value) for key, value in query.items()}
    named = request.query_params.getlist("recordings") if request is not None else []
    datasets = page.house.datasets()
    place = asked.get("dataset") or (str(datasets[0]) if datasets else "")
    with page.refusing():
        place = str(page.house.inside(place)) if place else ""
    _choice_of_dataset(page, datasets, place)
    if not place:
        ui.label(words("review.no_dataset")).classes("ps-dim")
        ui.link(words("pages.home"), "/").classes("ps-link")
        return
    waiting = tag(ui.label(words("review.opening")).props("role=status"), "opening")
    await context.client.connected()
    with page.refusing():
        reviews = page.house.part(Reviews)
        review: Review = await _done(reviews.open, place)
        title, only = asked.get("title", ""), named
        if asked.get("selection"):
            title, only = await _done(reviews.selection, asked["selection"])
        desk = Desk(page, review, asked)
        desk.limit(title, only)
        desk.build()
        await desk.begin(asked)
    waiting.delete()


async def _done(work: Callable[..., Any], *given: Any) -> Any:
    """What blocks, beside the pages."""
    return await run.io_bound(work, *given)


def _choice_of_dataset(page: Page, datasets: list[Path], place: str) -> None:
    words = page.words
    titles = {str(p.resolve()): page.house.title(p) for p in datasets}
    twice = {t for t in titles.values() if list(titles.values()).count(t) > 1}
    options = {p: f"{t} ({Path(p).name})" if t in twice else t for p, t in titles.items()}
    if len(options) > 1 or place not in options:
        choice = ui.select(
            options,
            value=place if place in options else None,
            label=words("review.dataset"),
            on_change=lambda e: ui.navigate.to(f"/review?dataset={quote(str(e.value))}"),
        )
        tag(choice.props("outlined dense").style("min-width: 280px"), "dataset")
