"""Record: how well the toy is heard, and what it sends right now."""

from __future__ import annotations

from nicegui import ui

from plushsense.apps.studio.desk import Sitting
from plushsense.apps.studio.pages.record_start import unfolding
from plushsense.apps.studio.plot import Plot
from plushsense.apps.studio.shell import LINES, Page, tag
from plushsense.recording.status import Status

_WINDOW_S = 10.0
_POINTS_A_PUSH = 12
_LIGHTS = {
    "good": ("✔", "#00664a"),
    "fair": ("◑", "#7a4e00"),
    "poor": ("▲", "#9d2b00"),
    "none": ("✖", "#6b1d1d"),
    "unreadable": ("?", "#6b1d1d"),
}
"""A sign and a colour for each word of `plushsense.recording.meter.SIGNAL`."""


def percent(share: float, language: str) -> str:
    """A share in per cent: one place under ten."""
    text = f"{100 * share:.1f}" if share < 0.1 else f"{100 * share:.0f}"
    text = text.removesuffix(".0")
    return text.replace(".", ",") if language == "lv" else text


class Signals:
    """The light, its words, and curves of the last seconds, a plot a kind of channel."""

    def __init__(self, page: Page, sitting: Sitting) -> None:
        self._page, self._device = page, sitting.device
        words = page.words
        with ui.column().classes("ps-card w-full").style("gap: 6px"):
            with ui.row().classes("items-center w-full").style("gap: 4px 16px"):
                ui.label(words("record.signal")).classes("text-bold")
                self._light = tag(ui.label(), "signal").classes("q-px-md q-py-xs rounded-borders text-bold")
                self._lost = tag(ui.label(), "lost")
                self._rate = tag(ui.label(), "rate")
            self._more = tag(ui.label(), "counters").classes("ps-dim")
            with tag(ui.element("details").props("open").classes("w-full"), "live"):
                unfolding(words("record.live"))
                self._plots = self._build(max(1.0, sitting.wanted.speed))
        rate = self._device.layout.rate_hz * max(1.0, sitting.wanted.speed)
        self._place = max(0, self._device.ring.count - int(_WINDOW_S * rate))
        self._word = ""

    def _build(self, speed: float) -> list[tuple[Plot, list[int]]]:
        words, kinds = self._page.words, dict[str, list[int]]()
        channels = self._device.layout.channels
        for n, channel in enumerate(channels):
            kinds.setdefault(channel.kind, []).append(n)
        plots = []
        with ui.row().classes("w-full items-start").style("gap: 8px"):
            for kind, which in kinds.items():
                key = f"record.kind_{kind}"
                title = words(key) if words.has(key) else kind
                names = ", ".join(channels[n].name for n in which)
                label = words("record.live_label", s=f"{_WINDOW_S * speed:g}", channels=names)
                series = [{"label": channels[n].name, "stroke": LINES[i % len(LINES)]} for i, n in enumerate(which)]
                wide = "2 1 420px" if len(which) > 5 else "1 1 260px"
                with ui.column().classes("gap-0").style(f"flex: {wide}; min-width: 0"):
                    ui.label(title).classes("text-bold")
                    plot = Plot(
                        label,
                        series,
                        x=words("record.live_x"),
                        y=words.unit(channels[which[0]].unit),
                        height=190,
                        window_s=_WINDOW_S * speed,
                    )
                    plots.append((tag(plot, f"plot-{kind}"), which))
        return plots

    def draw(self, s: Status) -> None:
        """Show this moment; called as often as the page is drawn."""
        words = self._page.words
        if self._word != s.signal:
            self._word = s.signal
            sign, colour = _LIGHTS[s.signal]
            self._light.text = f"{sign} {words(f'record.signal_{s.signal}')}"
            self._light.style(f"background: {colour}; color: #fff").props(f'data-signal="{s.signal}"')
        shares = {"recent": percent(s.bad_share, words.language), "ever": percent(s.bad_ever, words.language)}
        # Of a toy that is not heard, the last seconds say nothing.
        hears = s.signal not in ("none", "unreadable")
        self._lost.text = words("record.signal_lost", **shares) if hears else ""
        self._rate.text = words("record.signal_rate", rate=f"{s.rate_hz:.0f}") if hears else ""
        counts = {k: getattr(s, k) for k in ("lost", "malformed", "garbage", "gaps", "reconnects")}
        self._more.text = words("record.signal_more", **counts)

    def push(self) -> None:
        """Bring what has come since the last time to the plots."""
        piece = self._device.ring.since(self._place)
        self._place = piece.upto
        if not len(piece.seconds):
            return
        # A toy in a hurry sends more than anybody can see.
        step = max(1, len(piece.seconds) // _POINTS_A_PUSH)
        seconds = piece.seconds[::step].tolist()
        values = piece.values[::step]
        channels = self._device.layout.channels
        for plot, which in self._plots:
            curves = [
                ((values[:, n] * channels[n].step - channels[n].offset) * channels[n].scale).tolist() for n in which
            ]
            plot.push(seconds, curves)
