"""Record: a session is begun, taken up and led here."""

from __future__ import annotations

from nicegui import context

from plushsense.apps.studio.desk import Desk
from plushsense.apps.studio.pages.record_session import show_session
from plushsense.apps.studio.pages.record_start import show_start
from plushsense.apps.studio.shell import Page


async def show(page: Page) -> None:
    """The session that the address names, or the only one that is open; else what can be begun or taken up."""
    desk = page.house.part(Desk)
    request = context.client.request
    asked = dict(request.query_params) if request is not None else {}
    sittings = desk.sittings()
    sitting = desk.get(asked.get("session", ""))
    if sitting is None and not asked and len(sittings) == 1:
        sitting = sittings[0]
    if sitting is not None:
        show_session(page, desk, sitting)
    else:
        await show_start(page, desk, asked.get("session", ""), asked.get("ended", ""))
