"""How figures and marks read on the train page."""

from __future__ import annotations

from html import escape

from plushsense.apps.studio.words import Words


def figure(value: float | None) -> str:
    """Three digits; a dash for what could not be computed."""
    return "–" if value is None else f"{value:z.3f}"


def spread(mean: float | None, sd: float | None) -> str:
    """``0.573 ± 0.120``"""
    return figure(mean) if mean is None or sd is None else f"{mean:z.3f} ± {sd:.3f}"


def lasting(words: Words, seconds: float) -> str:
    """A time in words."""
    if seconds < 60:
        return words("train.time.short")
    minutes = round(seconds / 60)
    if minutes < 90:
        return words("train.time.min", n=minutes)
    return words("train.time.hours", h=minutes // 60, n=minutes % 60)


def marks(words: Words, leaky: bool, simulated: bool) -> str:
    """What must stand beside a score, as HTML: that its split is leaky, that it is a simulation's."""
    said = []
    if simulated:
        said.append(f'<span class="ps-mark ps-mark-simulation">{escape(words("train.simulation"))}</span>')
    if leaky:
        said.append(f'<span class="ps-mark ps-mark-leaky">{escape(words("train.leaky"))}</span>')
    return " ".join(said)


def over(words: Words, kind: str, units: int) -> str:
    """What a mean goes over."""
    return words(f"train.over.{kind}{'_one' if units == 1 else ''}", n=units)
