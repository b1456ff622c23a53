"""One export on the page: what it is, its files, and what comes next."""

from __future__ import annotations

from nicegui import ui

from plushsense.apps.studio.downloads import address
from plushsense.apps.studio.exports import ExportFacts
from plushsense.apps.studio.house import EXPORTS
from plushsense.apps.studio.jobs import Job
from plushsense.apps.studio.pages.export_shown import facts, moment, size, table, text
from plushsense.apps.studio.shell import Page, tag
from plushsense.deploy.package import ARDUINO, IDF, IDF_EXAMPLE, SKETCH


def show_facts(page: Page, found: ExportFacts, made: Job | None) -> None:
    """Its facts, files and download; ``made``: the work that made it, for what it warned of."""
    words, told = page.words, found.facts
    with tag(ui.column().classes("ps-card w-full"), "export-facts"):
        if told.get("simulated"):
            text(words("shell.simulation"), classes="ps-said ps-said-warning w-full")
        for warning in made.warnings if made else ():
            text(warning, classes="ps-said ps-said-warning w-full")
        facts(
            [
                (words("export.network"), str(told["title"])),
                (words("export.gestures"), str(told["classes"])),
                (words("export.layout"), str(told.get("layout", ""))),
                (words("export.flash"), words("export.flash_value", n=f"{found.flash_bytes:,}")),
                (words("export.ram"), words("export.ram_value", n=f"{found.ram_bytes:,}")),
                (
                    words("export.step"),
                    words("export.step_value", ms=f"{told['step_ms']:g}", macs=f"{told['macs_per_step']:,}"),
                ),
                (words("export.made"), moment(found.made_s)),
                (words("export.place"), str(found.folder)),
            ]
        )
        for name, each in told.get("conversions", {}).items():
            apart = each.get("largest_difference")
            said = words("export.converted", file=each["file"], n=f"{each['bytes']:,}", name=name)
            text(said if apart is None else f"{said} {words('export.apart', d=f'{apart:.1g}')}")
        with ui.expansion(words("export.files", n=len(found.files), size=size(sum(found.files.values())))) as files:
            rows = [(name, f"{bytes_:,}") for name, bytes_ in found.files.items()]
            table(words("export.files_caption"), (words("export.file"), words("export.bytes")), rows, (1,))
        tag(files.classes("w-full"), "files")
        down = ui.link(words("export.download"), address(EXPORTS, found.name)).classes("ps-link")
        tag(down.props("download"), "download")


def show_next(page: Page) -> None:
    """What the firmware engineer does with it."""
    words = page.words
    with tag(ui.column().classes("ps-card w-full"), "next"):
        text(words("export.next"), "h3")
        with ui.element("ol").classes("ps-steps"):
            for key in ("arduino", "idf", "plain", "read"):
                said = words(f"export.next_{key}", arduino=ARDUINO, sketch=SKETCH, idf=IDF, example=IDF_EXAMPLE)
                text(said, "li")
