"""What a step of an exported network costs on each chip: counted on emulators, the time estimated."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from plushsense.apps.studio.exports import ExportFacts
from plushsense.apps.studio.jobs import Job
from plushsense.apps.studio.pages.export_shown import Cell, WorkShown, moment, table, text, verdict
from plushsense.apps.studio.shell import Page, tag
from plushsense.deploy.targets import TARGETS

_FITS = {"yes": True, "no": False, "unsure": None}


def show_cost(page: Page, work: WorkShown, export: ExportFacts, counted: Job | None) -> None:
    """The newest count of this export, or how to have one; ``counted`` is the work that counted."""
    words = page.words
    found: dict[str, Any] = counted.result.get("profile", {}) if counted else {}
    fresh = found.get("digest") == export.digest

    async def again() -> None:
        await work.start("profile", {"place": str(export.folder)})

    with tag(ui.column().classes("ps-card w-full"), "cost"):
        text(words("export.cost"), "h3")
        if not found:
            text(words("export.not_counted"))
        elif not fresh:
            text(words("export.counted_before"), classes="ps-said ps-said-warning w-full")
        elif "refused" in found:
            tag(text(found["refused"], classes="ps-said ps-said-warning w-full"), "cost-refused")
        else:
            assert counted is not None
            _shown(page, found, moment(counted.ended_s))
        if not fresh or "refused" in found:
            tag(ui.button(words("export.count"), on_click=again).props("outline no-caps"), "count")


def _shown(page: Page, found: dict[str, Any], when: str) -> None:
    words = page.words
    text(words("export.cost_about", step=f"{found['step_ms']:g}"), classes="ps-dim")
    rows = [
        (
            each["chip"],
            f"{each['mhz']}",
            words("export.between", low=f"{each['low']:.2g}", high=f"{each['high']:.2g}"),
            Cell(verdict(_FITS[each["fits"]], words(f"export.fits_{each['fits']}"))),
        )
        for each in found["estimated_ms"].values()
    ]
    if rows:
        head = [words(f"export.{k}") for k in ("chip", "mhz", "estimate", "fits")]
        tag(table(words("export.estimate_caption", when=when), head, rows, (1,)), "estimates")
    counted = [
        (
            TARGETS[name].title,
            *(f"{each[key]:,}" for key in ("instructions_per_step", "flash_bytes", "ram_bytes")),
            f"{each['stack_push_bytes']:,}" if each["stack_push_bytes"] is not None else "–",
        )
        for name, each in found["targets"].items()
        if each["instructions_per_step"] is not None
    ]
    if counted:
        head = [words(f"export.{k}") for k in ("counted_on", "instructions", "flash_all", "ram_all", "stack")]
        table(words("export.counted_caption", optimise=found["optimise"]), head, counted, (1, 2, 3, 4))
    for name, packages in found["missing"].items():
        said = words("export.target_missing", target=TARGETS[name].title, packages=" ".join(packages))
        text(said, classes="ps-dim")
