"""A drawing of scores against sizes as SVG: every point labelled, the front drawn, readable in both lights."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from typing import NamedTuple

At = Callable[[float, float], tuple[float, float]]
Box = tuple[float, float, float, float]

WIDTH, HEIGHT = 760, 380
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 24, 20, 56
_LETTER, _LINE = 6.4, 15
# So many labels beyond the front's at most; the table has them all.
_LABELS = 24


class Point(NamedTuple):
    """One network: ``x`` in parameters, ``y`` a share, ``spread`` around it (None: unknown)."""

    x: float
    y: float
    spread: float | None
    label: str
    front: bool
    leaky: bool


def drawing(points: Sequence[Point], *, title: str, x: str, y: str, leaky: str) -> str:
    """SVG text. ``leaky``: the word beside leaky points, which are hollow diamonds."""
    low_x, high_x = _span_x([p.x for p in points])
    low_y, high_y = _span_y(points)

    def at(px: float, py: float) -> tuple[float, float]:
        wide = (math.log10(px) - low_x) / (high_x - low_x)
        high = (py - low_y) / (high_y - low_y)
        return (
            _LEFT + wide * (WIDTH - _LEFT - _RIGHT),
            HEIGHT - _BOTTOM - high * (HEIGHT - _TOP - _BOTTOM),
        )

    out = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}" class="ps-pareto" '
        'xmlns="http://www.w3.org/2000/svg">'
    ]
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    for tick in _ticks_x(low_x, high_x):
        cx, _ = at(tick, low_y)
        out.append(f'<line class="g" x1="{cx:.1f}" x2="{cx:.1f}" y1="{_TOP}" y2="{bottom}"/>')
        out.append(f'<text x="{cx:.1f}" y="{bottom + 18}" text-anchor="middle">{_short(tick)}</text>')
    for tick in _ticks_y(low_y, high_y):
        _, cy = at(10**low_x, tick)
        out.append(f'<line class="g" x1="{_LEFT}" x2="{right}" y1="{cy:.1f}" y2="{cy:.1f}"/>')
        out.append(f'<text x="{_LEFT - 8}" y="{cy + 4:.1f}" text-anchor="end">{tick:.2f}</text>')
    out.append(f'<text x="{(_LEFT + right) / 2:.0f}" y="{HEIGHT - 12}" text-anchor="middle">{escape(x)}</text>')
    middle = (_TOP + bottom) / 2
    out.append(
        f'<text x="16" y="{middle:.0f}" text-anchor="middle" transform="rotate(-90 16 {middle:.0f})">{escape(y)}</text>'
    )
    line = [at(p.x, p.y) for p in sorted(points) if p.front]
    if len(line) > 1:
        out.append(f'<polyline class="f" points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in line)}"/>')
    for p in points:
        out += _mark(p, at)
    out += _labels(points, at, leaky)
    return "".join(out) + "</svg>"


def _mark(p: Point, at: At) -> list[str]:
    cx, cy = at(p.x, p.y)
    out = []
    if p.spread:
        _, top = at(p.x, p.y + p.spread)
        _, low = at(p.x, p.y - p.spread)
        top, low = max(top, _TOP), min(low, HEIGHT - _BOTTOM)
        out.append(f'<line class="s" x1="{cx:.1f}" x2="{cx:.1f}" y1="{top:.1f}" y2="{low:.1f}"/>')
    kind = "l" if p.leaky else "p"
    said = f"<title>{escape(p.label)}: {p.y:.3f}{'' if p.spread is None else f' ± {p.spread:.3f}'}, {p.x:,.0f}</title>"
    if p.leaky:
        out.append(
            f'<path class="{kind}" d="M{cx:.1f} {cy - 6:.1f}l6 6l-6 6l-6 -6z">{said}</path>',
        )
    else:
        out.append(f'<circle class="{kind}" cx="{cx:.1f}" cy="{cy:.1f}" r="5">{said}</circle>')
    return out


def _labels(points: Sequence[Point], at: At, leaky: str) -> list[str]:
    """Each beside its point, where no other one stands; the front first."""
    taken = [(cx - 6, cy - 6, cx + 6, cy + 6) for cx, cy in (at(p.x, p.y) for p in points)]
    out, shown = [], 0
    for p in sorted(points, key=lambda p: (not p.front, -p.y)):
        if not p.front and shown >= _LABELS:
            continue
        cx, cy = at(p.x, p.y)
        text = f"{p.label} ({leaky})" if p.leaky else p.label
        wide = len(text) * _LETTER
        for step in (0, -1, 1, -2, 2, -3, 3):
            for right in (True, False):
                left = cx + 9 if right else cx - 9 - wide
                middle = cy + step * _LINE
                box = (left, middle - _LINE / 2, left + wide, middle + _LINE / 2)
                inside = box[0] > _LEFT and box[2] < WIDTH and box[1] > 0 and box[3] < HEIGHT - _BOTTOM
                if inside and not any(_meet(box, other) for other in taken):
                    taken.append(box)
                    shown += 1
                    bold = ' class="b"' if p.front else ""
                    out.append(f'<text{bold} x="{left:.1f}" y="{middle + 4:.1f}">{escape(text)}</text>')
                    break
            else:
                continue
            break
    return out


def _meet(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _span_x(values: Sequence[float]) -> tuple[float, float]:
    low, high = math.log10(min(values)), math.log10(max(values))
    pad = max(0.15, 0.08 * (high - low))
    return low - pad, high + pad


def _span_y(points: Sequence[Point]) -> tuple[float, float]:
    low = min(p.y - (p.spread or 0.0) for p in points)
    high = max(p.y + (p.spread or 0.0) for p in points)
    pad = max(0.02, 0.08 * (high - low))
    return max(0.0, low - pad), min(1.0, high + pad) if high < 1.0 else 1.02


def _ticks_x(low: float, high: float) -> list[float]:
    several = [m * 10.0**e for e in range(math.floor(low), math.ceil(high) + 1) for m in (1, 2, 5)]
    return [v for v in several if low <= math.log10(v) <= high]


def _ticks_y(low: float, high: float) -> list[float]:
    step = next(s for s in (0.01, 0.02, 0.05, 0.1, 0.2) if (high - low) / s <= 8)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _short(value: float) -> str:
    return f"{value / 1000:g}k" if value >= 1000 else f"{value:g}"
