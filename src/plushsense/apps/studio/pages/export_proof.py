"""The proof of an export on the page: what to compile for, and what came of it."""

from __future__ import annotations

from typing import Any

from nicegui import run, ui

from plushsense.apps.studio.exports import ExportFacts, newest, targets
from plushsense.apps.studio.jobs import Job, Jobs
from plushsense.apps.studio.pages.export_shown import Cell, WorkShown, moment, table, text, titles, verdict
from plushsense.apps.studio.shell import Page, tag
from plushsense.apps.studio.words import Words
from plushsense.deploy.targets import TARGETS


def state_of(words: Words, export: ExportFacts, proof: Job | None) -> str:
    """The last proof as a verdict, HTML: equal, not equal, of other files, never."""
    if proof is None:
        return verdict(None, words("export.never_proved"))
    if proof.result.get("digest") != export.digest:
        return verdict(None, words("export.proved_before"))
    good = bool(proof.result["passed"])
    return verdict(good, f"{words('export.equal' if good else 'export.unequal')}, {moment(proof.ended_s)}")


class Proof:
    """The part of the page that proves one export."""

    def __init__(self, page: Page, work: WorkShown, export: ExportFacts) -> None:
        self.page, self.words, self.work, self.export = page, page.words, work, export
        self._chosen: dict[str, ui.checkbox] = {}

    async def build(self) -> None:
        words = self.words
        lacking = await run.io_bound(targets) or {}
        with tag(ui.column().classes("ps-card w-full"), "proof"):
            text(words("export.prove"), "h3")
            text(words("export.prove_about"), classes="ps-dim")
            with ui.row().classes("w-full"):
                for name in (n for n, lacks in lacking.items() if not lacks):
                    self._chosen[name] = ui.checkbox(self._title(name), value=True)
                    tag(self._chosen[name], f"target-{name}")
            for name, lacks in lacking.items():
                if lacks:
                    said = words("export.target_missing", target=self._title(name), packages=" ".join(lacks))
                    tag(text(said, classes="ps-dim"), f"missing-{name}")
            with ui.expansion(words("export.more")).classes("w-full"):
                options = {"": words("export.recorded_none")} | await titles(self.page.house)
                self._dataset = ui.select(options, value="", label=words("export.recorded")).classes("w-full")
                self._faults = tag(ui.checkbox(words("export.faults")), "faults")
            button = ui.button(words("export.verify"), icon="fact_check", on_click=self._start).props("no-caps")
            tag(button, "verify").set_enabled(bool(self._chosen))
            proof = newest(self.page.house.part(Jobs), "verify", self.export.folder)
            if proof is not None:
                self._shown(proof)

    def _title(self, name: str) -> str:
        return self.words("export.host") if name == "host" else TARGETS[name].title

    async def _start(self) -> None:
        words, chosen = self.words, [name for name, box in self._chosen.items() if box.value]
        if not chosen:
            self.page.say(words("export.no_target"), "error")
            return
        if self.work.running("verify"):
            self.page.say(words("export.verify_runs"), "warning")
            return
        self.page.say("")
        with self.page.refusing():
            dataset = str(self.page.house.inside(self._dataset.value)) if self._dataset.value else ""
            faults = bool(self._faults.value)
            spec = {"place": str(self.export.folder), "targets": chosen, "dataset": dataset, "faults": faults}
            await self.work.start("verify", spec)

    def _shown(self, proof: Job) -> None:
        words, found = self.words, proof.result
        with tag(ui.column().classes("w-full"), "verdict"):
            if found["digest"] != self.export.digest:
                text(
                    words("export.changed_since", when=moment(proof.ended_s)), classes="ps-said ps-said-warning w-full"
                )
            good = bool(found["passed"])
            with ui.row().classes("items-center"):
                ui.html(verdict(good, words("export.equal" if good else "export.unequal")), sanitize=False)
                text(self._sum(found), "span")
            for sentence in self._sentences(found):
                text(sentence, classes=f"ps-said ps-said-{'warning' if good else 'error'} w-full")
            rows = [
                (
                    words("export.host_short") if r["target"] == "host" else self._title(r["target"]),
                    r["compiler"],
                    r["flags"],
                    f"{r['vectors']:,}",
                    f"{r['mismatches']:,}",
                    f"{r['max_abs_diff']:,}",
                    Cell(verdict(not r["mismatches"], words("export.unequal" if r["mismatches"] else "export.equal"))),
                )
                for r in found["runs"]
            ]
            keys = ("target", "compiler", "flags", "answers", "mismatches", "difference", "verdict")
            caption = words("export.runs_caption", when=moment(proof.ended_s))
            tag(table(caption, [words(f"export.{k}") for k in keys], rows, (3, 4, 5)), "runs")
            fed = [(s["name"], f"{s['samples']:,}", f"{s['frames']:,}", f"{s['answers']:,}") for s in found["streams"]]
            head = [words(f"export.{k}") for k in ("stream", "samples", "frames", "answers")]
            tag(table(words("export.streams_caption"), head, fed, (1, 2, 3)), "streams")
            for each in found["not_run"]:
                text(words("export.not_run", what=each["what"], why=each["why"]), classes="ps-dim")
            self._planted(found)

    def _sum(self, found: dict[str, Any]) -> str:
        settings = len(found["runs"])
        if not found["mismatches"]:
            return self.words("export.all_equal", n=f"{found['vectors']:,}", settings=settings)
        return self.words("export.some_unequal", bad=f"{found['mismatches']:,}", n=f"{found['vectors']:,}")

    def _sentences(self, found: dict[str, Any]) -> list[str]:
        words, said = self.words, []
        if found["first"]:
            said.append(found["first"])
        elif not found["decisions"]:
            said.append(words("export.nothing_proved"))
        elif not found["passed"]:
            said.append(words("export.fault_missed"))
        if not found["own"]:
            said.append(words("export.not_own"))
        if found["changed_copies"]:
            said.append(words("export.changed_copies", files=", ".join(found["changed_copies"])))
        return said

    def _planted(self, found: dict[str, Any]) -> None:
        words = self.words
        if not found["faults"]:
            return
        kinds = {True: "caught", None: "not_shown", False: "not_caught"}
        rows = []
        for each in found["faults"]:
            state = True if each["caught"] else None if each["silent"] else False
            cell = Cell(verdict(state, words(f"export.{kinds[state]}")))
            rows.append((each["kind"], each["fault"], self._title(each["target"]), cell))
        with ui.expansion(words("export.faults_found", n=len(rows))).classes("w-full"):
            head = [words(f"export.{k}") for k in ("fault_kind", "fault", "target", "verdict")]
            table(words("export.faults_caption"), head, rows)
            if any(f["silent"] for f in found["faults"]):
                text(words("export.not_shown_about"), classes="ps-dim")
