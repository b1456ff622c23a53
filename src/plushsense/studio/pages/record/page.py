"""Record page: starts, resumes and conducts a session."""

from __future__ import annotations

from nicegui import context

from plushsense.studio.app.shell import Page
from plushsense.studio.pages.record.controller import RecordController
from plushsense.studio.pages.record.session import show_session
from plushsense.studio.pages.record.start import show_start


async def show(page: Page) -> None:
    """Show the session that the address names, or the only active one; else the page to start one."""
    controller = page.workspace.part(RecordController)
    request = context.client.request
    query = dict(request.query_params) if request is not None else {}
    active = controller.active_sessions()
    session = controller.get(query.get("session", ""))
    if session is None and not query and len(active) == 1:
        session = active[0]
    if session is not None:
        show_session(page, controller, session)
    else:
        await show_start(page, controller, query.get("session", ""), query.get("ended", ""))
