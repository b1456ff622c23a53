"""Asking why: excluding a recording and accepting a finding need a reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nicegui import ui

from plushsense.apps.studio.shell import tag
from plushsense.apps.studio.words import Words
from plushsense.dataset.quality.finding import Finding

if TYPE_CHECKING:
    from plushsense.apps.studio.pages.review_desk import Desk

SEVERITY_SIGNS = {"error": "✖", "warning": "▲", "info": "ℹ"}
_EXCLUDING = ("wrong", "nothing", "disturbed", "sensor", "twice", "broken_off")
_ACCEPTING = ("looked", "person", "known")


def finding_text(words: Words, finding: Finding) -> str:
    """A finding in short: sign, severity in words for what is urgent, and the check."""
    return f"{SEVERITY_SIGNS[finding.severity]} {words(f'review.severity_{finding.severity}')}: {finding.check}"


def ask(desk: Desk, finding: Finding | None = None) -> None:
    """Ask for a reason, then exclude the recording on the desk, or accept the finding."""
    words, shown = desk.words, desk.current
    title = (
        words("review.why_exclude", id=shown)
        if finding is None
        else words("review.why_accept", check=finding.check, about=finding.about or desk.review.dataset.head.name)
    )

    async def answer(why: str) -> None:
        if not why.strip():
            error.set_text(words("review.reason_needed"))
            field.run_method("focus")
            return
        dialog.close()
        review, visit = desk.review, desk.visit
        if finding is None:
            await desk.decide(shown, lambda: review.exclude(visit, shown, desk.name, why), move=True)
        else:
            await desk.decide(shown, lambda: review.accept_finding(visit, finding, desk.name, why))

    with desk.page_slot, ui.dialog() as dialog:
        # At once: a key that is pressed after it is for the page again.
        dialog.props(f'aria-label="{words("review.reason")}" transition-duration=0')
        with tag(ui.card().classes("w-full"), "reason"):
            ui.label(title).classes("text-lg font-bold").style("overflow-wrap: anywhere")
            with ui.row().classes("gap-2"):
                for number, key in enumerate(_EXCLUDING if finding is None else _ACCEPTING):
                    said = words(f"review.because_{key}")
                    button = ui.button(said, on_click=lambda said=said: answer(said)).props("no-caps outline")
                    if number == 0:
                        button.props("autofocus")
            field = ui.input(words("review.own_reason")).props("outlined").classes("w-full")
            tag(field, "own-reason").on("keydown.enter", lambda: answer(field.value or ""))
            error = tag(ui.label().props("role=alert").classes("ps-said-error"), "reason-error")
            with ui.row().classes("w-full justify-end"):
                ui.button(words("review.cancel"), on_click=dialog.close).props("no-caps flat")
                go = words("review.exclude_go") if finding is None else words("review.accept_finding")
                tag(ui.button(go, on_click=lambda: answer(field.value or "")).props("no-caps unelevated"), "reason-go")
    dialog.on("hide", dialog.delete)
    dialog.open()
