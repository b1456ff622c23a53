"""One recording: its signals, the marks, the findings, and all that can be decided with a key or a click."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nicegui import ui

from plushsense.apps.studio.pages.review_list import AFFECTS, SIGNS
from plushsense.apps.studio.pages.review_reason import ask, finding_text
from plushsense.apps.studio.review_plot import ReviewPlot
from plushsense.apps.studio.review_shown import ACTIVITY, ALL
from plushsense.apps.studio.shell import AFFECT_COLOURS, LINES, tag

if TYPE_CHECKING:
    from plushsense.apps.studio.pages.review_desk import Desk

START, STOP = "start", "stop"
KEYS = (
    ("Enter", "accept"),
    ("Backspace", "back"),
    ("↓ ↑", "pass"),
    ("← →", "start"),
    ("Shift + ← →", "stop"),
    (", .", "ten"),
    ("Home, End", "edges"),
    ("s, Esc", "drop"),
    ("x", "exclude"),
    ("u", "undo"),
    ("+ − 0", "zoom"),
)
"""The keys as they are written, and the word that says what each does; only what works without trimming otherwise."""
_PLAIN = ("accept", "back", "pass", "exclude", "undo", "zoom")
_SET, _DRAFT = "--ps-set", "--ps-draft"
_STEPS = {"ArrowLeft": -1, "ArrowRight": 1, ",": -10, "<": -10, ";": -10, ".": 10, ">": 10, ":": 10}
_ZOOMS = {"zoom_in": ("zoom_in", 0.5), "zoom_out": ("zoom_out", 2.0), "zoom_all": ("fit_screen", 0.0)}
_DASHES: tuple[list[int], ...] = ([], [7, 4], [2, 3])


class OneView:
    """The recording on the desk."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.group = ALL
        self.side = START
        self._drawn: Any = None
        words, trims = desk.words, not desk.review.is_labelled
        with tag(ui.element("div").classes("ps-one w-full"), "one") as self.place:
            with ui.column().classes("w-full gap-2 no-wrap"):
                with ui.row().classes("w-full items-center gap-2"):
                    self.heading = tag(ui.label().classes("text-lg font-bold").props("role=status"), "recording")
                    self.heading.style("overflow-wrap: anywhere")
                    self.affect = ui.label().classes("q-px-sm rounded-borders").style("font-weight: 600; color: #fff")
                    self.state = tag(ui.label().classes("ps-chip").props("role=status"), "state")
                self.about = tag(ui.label().classes("ps-dim ps-number"), "about")
                self._actions(trims)
                self.plot = ReviewPlot(
                    words("review.plot"), height=310, on_pick=self.picked, on_key=self.key, on_zoom=self.zoomed
                )
                tag(self.plot, "plot")
                if trims:
                    self._marks()
                self._views()
            with ui.column().classes("w-full gap-2"):
                ui.label(words("review.findings")).classes("font-bold")
                self.findings = tag(ui.column().classes("w-full"), "findings")
                ui.label(words("review.keys")).classes("font-bold q-mt-md")
                with tag(ui.element("dl").classes("ps-keys q-ma-none"), "keys"):
                    for key, does in KEYS:
                        if trims or does in _PLAIN:
                            with ui.element("dt"):
                                ui.label(key).classes("ps-key").style("display: inline-block")
                            with ui.element("dd"):
                                ui.label(words(f"review.key_{'next' if does == 'accept' and not trims else does}"))

    def _button(self, key: str, does: Any, name: str, look: str = "outline") -> ui.button:
        button = ui.button(self.desk.words(f"review.{key}"), on_click=does).props(f"no-caps {look}")
        return tag(button.classes("ps-act"), name)

    def _actions(self, trims: bool) -> None:
        desk = self.desk
        with ui.row().classes("w-full items-center gap-2"):
            self._button("accept" if trims else "next", self.accept, "accept", "unelevated color=primary")
            self._button("back", desk.back, "back")
            self.exclude = self._button("exclude", self._exclude, "exclude")
            self._button("undo", desk.undo, "undo")

    def _marks(self) -> None:
        """For whoever cannot, or would rather not, click into the plot or use the keys."""
        words = self.desk.words
        with ui.row().classes("w-full items-center gap-2"):
            side = ui.toggle({START: words("review.sets_start"), STOP: words("review.sets_stop")}, value=START)
            side.props(f'no-caps dense unelevated aria-label="{words("review.sets")}"').classes("ps-toggle")
            tag(side, "side").on_value_change(lambda e: setattr(self, "side", str(e.value)))
            for sign, by in (("−10", -10), ("−1", -1), ("+1", 1), ("+10", 10)):
                button = ui.button(sign, on_click=lambda by=by: self.step(by, self.side == STOP))
                button.props(f'no-caps outline dense aria-label="{words("review.step", by=sign)}"').classes("ps-act")
                tag(button, f"step{by}")
            self._button("drop", self._drop, "drop", "outline dense")
            self.untrim = self._button("untrim", self._untrim, "untrim", "outline dense")
            ends = ui.switch(words("review.ends"), value=self.desk.ends, on_change=lambda e: self._ends(bool(e.value)))
            tag(ends, "ends")

    def _views(self) -> None:
        words = self.desk.words
        kinds = list(dict.fromkeys(c.kind for c in self.desk.review.dataset.layout.channels))
        groups = [ALL, *(kinds if len(kinds) > 1 else []), ACTIVITY]
        with ui.row().classes("w-full items-center gap-2"):
            shown = ui.toggle({g: self._kind(g) for g in groups}, value=ALL)
            shown.props(f'no-caps dense unelevated aria-label="{words("review.group")}"').classes("ps-toggle")
            tag(shown, "group").on_value_change(lambda e: self._grouped(str(e.value)))
            for key, (icon, factor) in _ZOOMS.items():
                button = ui.button(icon=icon, on_click=lambda factor=factor: self.plot.zoom(factor))
                tag(button.props(f'flat round dense aria-label="{words(f"review.{key}")}"').classes("ps-act"), key)

    def _kind(self, kind: str) -> str:
        key = f"review.kind_{kind}"
        return self.desk.words(key) if self.desk.words.has(key) else kind

    # Showing ------------------------------------------------------------------------------------------------------

    def draw(self, *, keep: bool = False, low: float | None = None, high: float | None = None) -> None:
        """Draw the recording on the desk."""
        desk, words = self.desk, self.desk.words
        identity = desk.current
        self._drawn = None
        if not identity or identity not in desk.review.infos:
            self.heading.set_text(words("review.none_fit"))
            return
        read = desk.review.signals(identity)
        shown = read.shown(self.group, low, high)
        names = [self._kind(n) if n == ACTIVITY else n for n in shown["names"]]
        series = [
            {"label": n, "stroke": LINES[i % len(LINES)], "dash": _DASHES[i // len(LINES) % len(_DASHES)]}
            for i, n in enumerate(names)
        ]
        y_title = words("review.y_axis", unit=words.unit(shown["unit"])) if shown["unit"] else ""
        self.plot.show(
            identity,
            self._label(),
            shown["x"],
            shown["curves"],
            series,
            x_title=words("review.x_axis"),
            y_title=words("review.activity_axis") if self.group == ACTIVITY else y_title,
            lanes=[(at, self._kind(kind)) for at, kind in shown["lanes"]],
            limits=(-1.08 - 2.1 * (len(shown["lanes"]) - 1), 1.08) if shown["lanes"] else None,
            marks=self._lines(),
            cut=self._cut(),
            thinned=shown["thinned"] or low is not None,
            keep=keep,
        )
        self.refresh(moved=False)

    def refresh(self, *, moved: bool = True) -> None:
        """Say how the recording stands now; its curves stay."""
        desk, words, review = self.desk, self.desk.words, self.desk.review
        row = review.rows.get(desk.current)
        if row is None or not review.is_read(row.id):
            return
        standing, draft = review.standing(row.id), review.draft(row.id)
        now = (row.id, row.state, standing, draft, row.findings, desk.ends, row.confidence)
        if now == self._drawn:
            return
        self._drawn = now
        if moved:
            self.plot.remark(row.id, self._lines(), self._cut(), self._label())
        self.heading.set_text(row.id)
        self.affect.set_text(f"{AFFECTS[row.affect]} {words.gesture(row.info.gesture)}")
        self.affect.style(f"background: {AFFECT_COLOURS.get(row.affect, '#767676')}")
        self.state.set_text(f"{SIGNS[row.state]} {words(f'review.state_{row.state}')}")
        self.state.props(f'data-state="{row.state}"')
        self.about.set_text(self._about())
        excluded = row.state == "excluded"
        self.exclude.set_text(words("review.include" if excluded else "review.exclude"))
        if not review.is_labelled:
            self.untrim.set_visibility(standing.trimmed)
        self._fill_findings()

    def _about(self) -> str:
        desk, words = self.desk, self.desk.words
        row, at = desk.review.rows[desk.current], desk.review.signals(desk.current).seconds
        place = desk.order.index(row.id) + 1 if row.id in desk.order else 0
        said = words(
            "review.about", person=desk.person(row.info.subject), seconds=words.number(at[-1], 2), rows=row.info.rows
        )
        said += f" · {words('review.place', at=place, of=len(desk.order))}" if place else ""
        if desk.review.is_labelled:
            return said
        start, stop = desk.review.shown(row.id, desk.ends)
        said += " · " + words("review.kept", start=words.number(at[start], 2), stop=words.number(at[stop], 2))
        if row.state == "suggested":
            said += " · " + words("review.confidence", percent=f"{100 * row.confidence:.0f}")
        return said

    def _label(self) -> str:
        desk, words = self.desk, self.desk.words
        row = desk.review.rows[desk.current]
        return f"{row.id}, {words.gesture(row.info.gesture)}, {words(f'review.state_{row.state}')}. {self._about()}"

    def _lines(self) -> list[dict[str, Any]]:
        """The suggestion dotted, what is set or stands solid."""
        desk, words, review = self.desk, self.desk.words, self.desk.review
        if review.is_labelled:
            return []
        trim, draft = review.trim(desk.current), review.draft(desk.current)
        at, rows, s = trim.seconds, trim.recording.rows, trim.suggestion
        lines: list[dict[str, Any]] = []
        if draft or trim.standing.trimmed:
            start, stop = draft or trim.shown()
            colour = _DRAFT if draft else _SET
            for key, row, edge in ((START, start, 0), (STOP, stop, rows)):
                if row != edge or (key == START and draft):
                    said = words(f"review.mark_{key}", at=words.number(at[row], 2))
                    lines.append({"x": float(at[row]), "label": said, "stroke": colour, "edge": key})
        taken = {line["x"] for line in lines}
        for key, row, visible in ((START, s.start, s.onset_visible), (STOP, s.stop, s.offset_visible)):
            if visible and float(at[row]) not in taken:
                sure = key == START or desk.ends
                said = words(f"review.suggested_{key}", at=words.number(at[row], 2)) if sure else ""
                lines.append({"x": float(at[row]), "label": said, "dash": [2, 4] if sure else [1, 7], "edge": key})
        return lines

    def _cut(self) -> list[tuple[float, float]]:
        review, identity = self.desk.review, self.desk.current
        if review.is_labelled:
            return []
        trim = review.trim(identity)
        if not (review.draft(identity) or trim.standing.trimmed):
            return []
        start, stop = review.shown(identity)
        at = trim.seconds
        return [(a, b) for a, b in ((0.0, float(at[start])), (float(at[stop]), float(at[-1]))) if b > a]

    def _fill_findings(self) -> None:
        desk, words = self.desk, self.desk.words
        review, visit, shown = desk.review, desk.visit, desk.current
        row = review.rows[shown]
        self.findings.clear()
        with self.findings:
            if not row.findings:
                key = "no_findings" if review.prepared.checked else "not_checked"
                ui.label(words(f"review.{key}")).classes("ps-dim")
            for f in row.findings:
                with ui.column().classes("w-full gap-0").props(f'data-check="{f.check}"'):
                    ui.label(finding_text(words, f)).classes("font-bold")
                    ui.label(f.message)
                    if f.accepted:
                        with ui.row().classes("items-center"):
                            ui.label(f"✓ {words('review.accepted_finding')}").classes("ps-dim")
                            ui.button(
                                words("review.reopen"),
                                on_click=lambda f=f: desk.decide(
                                    shown, lambda: review.reopen_finding(visit, f, desk.name)
                                ),
                            ).props("no-caps flat dense").classes("ps-act")
                    else:
                        ui.label(f"→ {f.action}").classes("ps-dim")
                        ui.button(words("review.accept_finding"), on_click=lambda f=f: ask(desk, f)).props(
                            "no-caps flat dense"
                        ).classes("ps-act")

    # Doing --------------------------------------------------------------------------------------------------------

    async def key(self, said: dict[str, Any]) -> None:
        """A key of the page, pressed while the recording ``shown`` was on screen."""
        desk, key, shift = self.desk, str(said["key"]), bool(said["shift"])
        trims = not desk.review.is_labelled
        if key == "Backspace":
            await desk.back()
        elif key == "ArrowDown":
            await desk.next()
        elif key == "ArrowUp":
            await desk.previous()
        elif key == "u":
            await desk.undo()
        elif said["shown"] != desk.current:
            # The next one has come since: nothing is decided about what nobody saw.
            return
        elif key == "Enter":
            await self.accept(str(said["shown"]))
        elif key == "x":
            await self._exclude()
        elif trims and key in ("s", "Escape"):
            self._drop()
        elif trims and key == "Home":
            self._set(start=0)
        elif trims and key == "End":
            self._set(stop=desk.review.info(desk.current).rows)
        elif trims and key in _STEPS:
            self.step(_STEPS[key], shift)

    def picked(self, said: dict[str, Any]) -> None:
        """A click into the plot."""
        desk = self.desk
        if said["shown"] != desk.current or desk.review.is_labelled:
            return
        with desk.page.refusing():
            row = desk.review.signals(desk.current).row_at(float(said["x"]))
            stop = bool(said["shift"]) or said["button"] == "right" or self.side == STOP
            self._set(**({"stop": row} if stop else {"start": row}))

    def step(self, by: int, stop: bool) -> None:
        """Move the start or the end by some rows."""
        with self.desk.page.refusing():
            start, end = self.desk.review.shown(self.desk.current, self.desk.ends)
            self._set(**({"stop": end + by} if stop else {"start": start + by}))

    def _set(self, **rows: int) -> None:
        desk = self.desk
        with desk.page.refusing():
            desk.review.set(desk.current, ends=desk.ends, **rows)
            desk.page.say("")
        self.refresh()

    async def accept(self, shown: Any = None) -> None:
        """Accept what is shown, and show the next."""
        desk = self.desk
        identity = shown if isinstance(shown, str) else desk.current
        if desk.review.is_labelled:
            await desk.next()
        else:
            await desk.decide(
                identity, lambda: desk.review.accept(desk.visit, identity, desk.name, desk.ends), move=True
            )

    async def _exclude(self) -> None:
        desk, identity = self.desk, self.desk.current
        if not identity:
            return
        if desk.review.standing(identity).excluded:
            await desk.decide(identity, lambda: desk.review.include(desk.visit, identity, desk.name))
        else:
            ask(desk)

    def _drop(self) -> None:
        self.desk.review.drop(self.desk.current)
        self.refresh()

    async def _untrim(self) -> None:
        desk, identity = self.desk, self.desk.current
        desk.review.drop(identity)
        await desk.decide(identity, lambda: desk.review.untrim(desk.visit, identity, desk.name))

    def _ends(self, taken: bool) -> None:
        self.desk.ends = taken
        self.refresh()

    def _grouped(self, group: str) -> None:
        self.group = group
        self.draw(keep=True)

    def zoomed(self, said: dict[str, Any]) -> None:
        """Closer to a long recording: its rows there, instead of some of each stretch."""
        if said["shown"] == self.desk.current:
            self.draw(keep=True, low=float(said["low"]), high=float(said["high"]))
