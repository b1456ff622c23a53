"""A package on the page: what the validators say, whether people can be recognised, what is in it."""

from __future__ import annotations

import json
from typing import Any
from urllib.parse import quote

from nicegui import run, ui

from plushsense.apps.studio.downloads import address
from plushsense.apps.studio.house import PACKAGES
from plushsense.apps.studio.jobs import DONE, Job, Jobs
from plushsense.apps.studio.packages import PackageFacts, packages_of
from plushsense.apps.studio.pages.export_shown import Cell, WorkShown, link, moment, size, table, text, verdict
from plushsense.apps.studio.shell import Page, tag
from plushsense.apps.studio.words import Words
from plushsense.core.errors import ConfigError
from plushsense.dataset.publish.checking import VALIDATORS

_SHOWN = 20


class Packages:
    """The list of packages, and the one that is open."""

    def __init__(self, page: Page, work: WorkShown, lacking: list[str]) -> None:
        self.page, self.words, self.house, self.work, self.lacking = page, page.words, page.house, work, lacking
        self._detail = tag(ui.column().classes("w-full"), "package")
        self._list = tag(ui.column().classes("w-full"), "packages")

    async def build(self, name: str) -> None:
        """``name``: the one to open, or ""."""
        if name:
            await self.show(name)
        await self.refresh()

    async def refresh(self) -> None:
        """The list anew."""
        words = self.words
        names = await run.io_bound(lambda: packages_of(self.house)) or []
        found = await run.io_bound(lambda: [PackageFacts.of(self.house, n) for n in names]) or []
        rows = [
            (
                link(each.name, f"/publish?name={quote(each.name)}"),
                each.title,
                words("export.simulation_short") if each.simulated else "",
                moment(each.made_s),
                Cell(self._state(checked_by(self.house.part(Jobs), each))),
            )
            for each in found
        ]
        self._list.clear()
        with self._list:
            text(words("publish.earlier"), "h2")
            if not rows:
                text(words("publish.none"), classes="ps-dim")
                return
            head = [words(f"publish.{k}") for k in ("package", "what", "data", "made", "last_check")]
            table(words("publish.earlier_caption"), head, rows)

    def _state(self, job: Job | None) -> str:
        if job is None:
            return verdict(None, self.words("publish.never_checked"))
        good = bool(job.result["valid"])
        return verdict(good, f"{self.words('publish.valid' if good else 'publish.invalid')}, {moment(job.ended_s)}")

    async def show(self, name: str) -> None:
        """Open a package."""
        words = self.words
        with self.page.refusing():
            if name not in (await run.io_bound(lambda: packages_of(self.house)) or []):
                raise ConfigError(f"There is no package '{name}' in this studio: choose one of the list.")
            found = await run.io_bound(lambda: PackageFacts.of(self.house, name))
            assert found is not None
            job = checked_by(self.house.part(Jobs), found)
            ui.run_javascript(f"history.replaceState(null, '', {json.dumps(f'/publish?name={quote(name)}')})")
            self._detail.clear()
            with self._detail:
                text(words("publish.one", name=name), "h2")
                if found.simulated:
                    text(words("shell.simulation"), classes="ps-said ps-said-warning w-full")
                self._answers(found, job)
                with tag(ui.column().classes("ps-card w-full"), "recognised"):
                    text(words("publish.recognised"), "h3")
                    for sentence in recognised(words, found.reidentification):
                        text(sentence)
                self._contents(found)

    def _answers(self, found: PackageFacts, job: Job | None) -> None:
        words = self.words
        with tag(ui.column().classes("ps-card w-full"), "answers"):
            text(words("publish.answers"), "h3")
            if job is None:
                text(words("publish.not_checked"))
            else:
                with ui.row().classes("items-center"):
                    ui.html(self._state(job), sanitize=False)
                    text(words("publish.all_agree" if job.result["valid"] else "publish.some_disagree"), "span")
                self._validators(job.result)
                for each in [*job.result.get("warnings", ()), *job.result.get("notes", ())]:
                    text(f"{words('publish.note')} {each}", classes="ps-said ps-said-info w-full")
            self._thorough = tag(ui.checkbox(words("publish.with_thorough")), "check-thorough")
            again = ui.button(words("publish.check"), icon="fact_check", on_click=lambda: self._check(found))
            tag(again.props("outline no-caps"), "check").set_enabled("publish" not in self.lacking)

    def _validators(self, result: dict[str, Any]) -> None:
        words = self.words
        rows = []
        for each in result["validators"]:
            good, name = not each["problems"], each["validator"]
            about = words(f"publish.v_{name}") if name in VALIDATORS else ""
            found = words("publish.problems_found", n=each["problems"])
            mark = Cell(verdict(good, words("publish.passed") if good else found))
            rows.append((name, mark, about, each["looked_at"]))
        head = [words(f"publish.{k}") for k in ("validator", "answer", "looks_at", "looked_at")]
        tag(table(words("publish.validators_caption"), head, rows), "validators")
        if problems := result["problems"]:
            listed = [(p["validator"], p["file"] or words("publish.whole"), p["problem"]) for p in problems[:_SHOWN]]
            head = [words(f"publish.{k}") for k in ("validator", "file", "problem")]
            tag(table(words("publish.problems_caption", n=len(problems)), head, listed), "problems")
            if len(problems) > _SHOWN:
                text(words("publish.more_problems", n=len(problems) - _SHOWN), classes="ps-dim")

    async def _check(self, found: PackageFacts) -> None:
        self.page.say("")
        with self.page.refusing():
            spec = {"place": str(self.house.inside(found.place)), "thorough": bool(self._thorough.value)}
            await self.work.start("validate", spec)

    def _contents(self, found: PackageFacts) -> None:
        words = self.words
        with tag(ui.column().classes("ps-card w-full"), "contents"):
            text(words("publish.contents"), "h3")
            rows = [(name, f"{files:,}", size(total)) for name, (files, total) in found.contents.items()]
            files, total = (sum(each) for each in zip(*found.contents.values(), strict=True)) if rows else (0, 0)
            with ui.expansion(words("publish.files", n=f"{files:,}", size=size(total))).classes("w-full"):
                head = [words(f"publish.{k}") for k in ("file", "files_count", "size")]
                table(words("publish.contents_caption"), head, rows, (1, 2))
            if found.citation:
                text(words("publish.cite"), "h3")
                tag(text(found.citation), "citation")
                if "doi.org" not in found.citation:
                    text(words("publish.no_doi"), classes="ps-dim")
            text(words("publish.take"), "h3")
            if found.zip is not None:
                said = words("publish.download", size=size(found.zip.stat().st_size))
                down = ui.link(said, address(PACKAGES, found.name)).classes("ps-link").props("download")
                tag(down, "download")
            else:
                text(words("publish.no_zip"), classes="ps-said ps-said-warning w-full")
            text(words("publish.by_hand"))
            text(str(found.place), classes="ps-path")


def checked_by(jobs: Jobs, found: PackageFacts) -> Job | None:
    """The newest work that proved this package, when it was made or later."""
    places = {str(p) for p in (found.folder, found.zip) if p is not None}
    return next(
        (
            j
            for j in jobs.all("publish", "validate")
            if j.state == DONE and j.spec.get("place") in places and j.ended_s >= found.made_s - 1.0
        ),
        None,
    )


def recognised(words: Words, figures: dict[str, Any]) -> list[str]:
    """What the re-identification found, in plain words; ``figures`` of the package's own file, {} where nobody
    looked."""
    trials = {(t["design"], t["sees"]): t for t in figures.get("trials", ())}
    head = trials.get(("recordings", "everything"))
    if head is None:
        return [words("publish.nobody_looked")]
    top, low, chance = head["top1"], (head["top1"].get("ci95") or [head["top1"]["mean"]])[0], head["chance"]
    between = (
        words("publish.interval", low=_of_100(top["ci95"][0]), high=_of_100(top["ci95"][1])) if top["ci95"] else ""
    )
    said = [
        words(
            "publish.named",
            right=_of_100(top["mean"]),
            people=head["people"],
            recordings=head["recordings"],
            between=between,
            chance=_of_100(chance),
        )
    ]
    for key, trial in (
        ("unseen", trials.get(("gestures", "everything"))),
        ("moved", trials.get(("recordings", "movement"))),
        ("clock", trials.get(("recordings", "clock"))),
        ("session", trials.get(("sessions", "everything"))),
    ):
        if trial is not None:
            said.append(words(f"publish.named_{key}", right=_of_100(trial["top1"]["mean"])))
    if ("sessions", "everything") not in trials:
        said.append(words("publish.no_sessions"))
    if figures.get("simulated"):
        said.append(words("publish.means_simulated"))
    else:
        said.append(words("publish.means_guessing" if low <= chance else "publish.means_personal"))
    return [*said, words("publish.lower_bound")]


def _of_100(share: float) -> str:
    return f"{100 * share:.0f}" if share >= 0.095 or share == 0 else f"{100 * share:.1f}"
