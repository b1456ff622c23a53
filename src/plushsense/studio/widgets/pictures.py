"""Pictures of the gestures, drawn from a few parts: the toy from its side, hands, the place that is touched, arrows.

Each stands on a light ground of its own, so that it reads the same on a light and on a dark page.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from plushsense.core.gestures import plain_label

WIDTH, HEIGHT = 320, 250
FOLDER = "pictures"
"""Where a user's own pictures lie in the studio's folder: ``pictures/<label>.svg`` or ``.png``."""
LARGEST = 1_000_000
_KINDS = {".svg": "image/svg+xml", ".png": "image/png"}

_GROUND, _FUR, _FUR_DARK, _LINE = "#fff7ea", "#cf9a63", "#b27c46", "#4a2d14"
_SKIN, _SKIN_LINE, _SLEEVE = "#f6d3b4", "#7a4a2b", "#5b7fb5"
_TOUCH, _TOUCH_LINE, _ARROW = "#ffb000", "#b84a00", "#0b4f9e"
_TABLE, _TABLE_LINE = "#b9a58b", "#6b5a43"

Point = tuple[float, float]

# Where the toy is touched, in the toy's own coordinates, and the half axes of the place.
_PLACES: dict[str, tuple[Point, Point]] = {
    "back": ((182, 95), (56, 15)),
    "rump": ((226, 108), (27, 15)),
    "head": ((86, 66), (36, 14)),
    "ears": ((97, 60), (18, 13)),
    "neck": ((134, 92), (19, 15)),
    "tail": ((266, 106), (16, 13)),
    "body": ((160, 125), (66, 42)),
}


def _path(d: str, **style: str | float) -> str:
    marks = " ".join(f'{k.replace("_", "-")}="{v}"' for k, v in style.items())
    return f'<path d="{d}" {marks}/>'


def _ellipse(at: Point, half: Point, fill: str, line: str = _LINE, width: float = 3.0, more: str = "") -> str:
    return (
        f'<ellipse cx="{at[0]:g}" cy="{at[1]:g}" rx="{half[0]:g}" ry="{half[1]:g}" fill="{fill}" stroke="{line}" '
        f'stroke-width="{width:g}" {more}/>'
    )


def _limbs(limbs: Sequence[tuple[str, float]], fill: str = _SKIN, line: str = _SKIN_LINE) -> str:
    """Round strokes that grow together: all outlines first, then all insides."""
    style = 'fill="none" stroke-linecap="round" stroke-linejoin="round"'
    outer = "".join(f'<path d="{d}" {style} stroke="{line}" stroke-width="{w + 5:g}"/>' for d, w in limbs)
    return outer + "".join(f'<path d="{d}" {style} stroke="{fill}" stroke-width="{w:g}"/>' for d, w in limbs)


def _moved(parts: str, at: Point, turned: float = 0.0, scale: float = 1.0) -> str:
    return f'<g transform="translate({at[0]:g} {at[1]:g}) rotate({turned:g}) scale({scale:g})">{parts}</g>'


def _arrow(d: str, end: Point, towards: float, width: float = 6.0) -> str:
    """Draw a line along ``d`` and its head at ``end``, pointing ``towards`` (degrees, 0: right, 90: down)."""
    size = 2.3 * width
    corners = []
    for angle, reach in ((0.0, size), (130.0, size), (230.0, size)):
        a = math.radians(towards + angle)
        corners.append(f"{end[0] + reach * math.cos(a):.1f} {end[1] + reach * math.sin(a):.1f}")
    line = _path(d, fill="none", stroke=_ARROW, stroke_width=width, stroke_linecap="round", stroke_linejoin="round")
    return line + f'<path d="M{" L".join(corners)} Z" fill="{_ARROW}" stroke="{_ARROW}" stroke-linejoin="round"/>'


def _toy(touched: str = "", tail: str = "M244 118 Q268 116 278 88") -> str:
    """Draw the toy from its side, looking left; ``touched`` is a key of `_PLACES`."""
    legs = "".join(
        f'<rect x="{x}" y="150" width="24" height="50" rx="11" fill="{fill}" stroke="{_LINE}" stroke-width="3"/>'
        for x, fill in ((128, _FUR_DARK), (216, _FUR_DARK), (108, _FUR), (196, _FUR))
    )
    parts = [
        _limbs([(tail, 13)], _FUR, _LINE),
        legs,
        _ellipse((176, 134), (80, 44), _FUR),
        _ellipse((170, 152), (52, 20), "#e9c79c", "none", 0),
        _ellipse((119, 66), (14, 17), _FUR_DARK),
        _ellipse((96, 102), (43, 40), _FUR),
        _ellipse((73, 66), (14, 17), _FUR),
        _ellipse((73, 68), (7, 9), "#e9b9a0", "none", 0),
        _ellipse((68, 116), (23, 17), "#e9c79c"),
        _ellipse((52, 109), (7, 5.5), _LINE, "none", 0),
        _path("M56 122 Q66 130 78 124", fill="none", stroke=_LINE, stroke_width=2.5, stroke_linecap="round"),
        _ellipse((87, 95), (4.5, 5.5), _LINE, "none", 0),
    ]
    if touched:
        at, half = _PLACES[touched]
        marked = 'fill-opacity="0.75" stroke-dasharray="7 5"'
        parts.append(_ellipse(at, half, _TOUCH, _TOUCH_LINE, 3, marked))
    return "".join(parts)


def _table(y: float) -> str:
    return (
        f'<rect x="14" y="{y:g}" width="292" height="14" rx="4" fill="{_TABLE}" stroke="{_TABLE_LINE}" '
        f'stroke-width="3"/><rect x="40" y="{y + 14:g}" width="14" height="{HEIGHT - y - 14:g}" fill="{_TABLE_LINE}"/>'
        f'<rect x="266" y="{y + 14:g}" width="14" height="{HEIGHT - y - 14:g}" fill="{_TABLE_LINE}"/>'
    )


def _holding() -> str:
    """Draw a hand that carries the toy from below."""
    return _limbs([("M168 262 L168 222", 34)], _SLEEVE) + _limbs(
        [
            ("M168 224 L168 200", 26),
            ("M120 190 Q168 208 216 190", 24),
            ("M216 190 Q232 182 232 164", 13),
            ("M120 190 Q104 182 104 164", 13),
            ("M192 196 Q206 186 206 168", 13),
        ]
    )


def _flat_hand() -> str:
    """Draw a flat hand from the upper right; its palm rests on (0, 0)."""
    arm = [("M46 -26 L76 -62", 20)]
    hand = [("M-26 -8 Q4 -12 32 -14", 15), ("M30 -14 L46 -26", 18), ("M18 -12 Q4 -2 -2 6", 9)]
    return _limbs([("M70 -54 L100 -92", 27)], _SLEEVE) + _limbs([*arm, *hand])


def _clawed_hand() -> str:
    """Draw a hand from the upper right whose bent fingertips are at (0, 0)."""
    fingers = [(f"M{14 + 7 * n} {-30 + 3 * n} Q{-8 + 9 * n} {-20 + n} {-12 + 9 * n} {-1 + n}", 7) for n in range(4)]
    return (
        _limbs([("M64 -70 L94 -108", 27)], _SLEEVE)
        + _limbs([("M30 -32 L70 -78", 20), ("M22 -30 L32 -28", 24)])
        + _limbs(fingers)
    )


def _fist() -> str:
    """Draw a fist around (0, 0), its arm to the right."""
    return (
        _limbs([("M46 -2 L78 -6", 27)], _SLEEVE)
        + _limbs([("M8 0 L48 -2", 20), ("M-2 0 L6 0", 27)])
        + "".join(
            _path(f"M-11 {y} L2 {y}", fill="none", stroke=_SKIN_LINE, stroke_width=2, stroke_linecap="round")
            for y in (-6, 1, 8)
        )
    )


def _burst(at: Point) -> str:
    """Draw a mark where something strikes."""
    points = []
    for n in range(20):
        reach = 33 if n % 2 == 0 else 15
        a = 2 * math.pi * n / 20
        points.append(f"{at[0] + reach * math.cos(a):.1f} {at[1] + reach * math.sin(a):.1f}")
    return f'<path d="M{" L".join(points)} Z" fill="{_TOUCH}" stroke="{_TOUCH_LINE}" stroke-width="3"/>'


def _stroke_back() -> str:
    return _moved(_flat_hand(), (160, 88), 6) + _arrow("M128 62 Q172 42 226 66", (228, 67), 22)


def _stroke_head() -> str:
    return _moved(_flat_hand(), (92, 60), -8) + _arrow("M44 76 Q52 38 82 28", (84, 27), -18)


def _zigzag(at: Point) -> str:
    """Draw small strokes to and fro."""
    x, y = at
    there = _arrow(f"M{x + 20:g} {y:g} L{x - 12:g} {y:g}", (x - 14, y), 180, 5)
    return there + _arrow(f"M{x - 16:g} {y + 15:g} L{x + 16:g} {y + 15:g}", (x + 18, y + 15), 0, 5)


def _scratch_ears() -> str:
    return _moved(_clawed_hand(), (98, 56)) + _zigzag((50, 26))


def _scratch_neck() -> str:
    return _moved(_clawed_hand(), (134, 88)) + _zigzag((204, 70))


def _scratch_rump() -> str:
    return _moved(_clawed_hand(), (230, 104), -14) + _zigzag((176, 62))


def _tap_rump() -> str:
    arcs = "".join(
        _path(d, fill="none", stroke=_ARROW, stroke_width=4, stroke_linecap="round")
        for d in ("M200 88 q-9 5 -10 14", "M189 79 q-14 8 -15 21")
    )
    down = _arrow("M176 28 L176 48", (176, 50), 90, 6)
    up = _arrow("M204 54 L204 34", (204, 32), -90, 6)
    return _moved(_flat_hand(), (238, 90), -8, 0.9) + down + up + arcs


def _hit_rump() -> str:
    return _burst((222, 104)) + _moved(_flat_hand(), (238, 46), -22, 1.0) + _arrow("M176 16 L200 62", (201, 64), 62, 11)


def _pull_tail() -> str:
    return _moved(_fist(), (280, 101), -8, 0.85) + _arrow("M228 56 L284 48", (286, 48), -8, 10)


def _rest() -> str:
    """Draw a hand that is crossed out."""
    ring = '<circle cx="0" cy="0" r="34" fill="none" stroke="#b84a00" stroke-width="7"/>'
    bar = _path("M-24 -24 L24 24", stroke="#b84a00", stroke_width=7)
    open_hand = _limbs(
        [("M0 22 L0 4", 20), ("M-9 2 L-12 -16", 6), ("M-2 0 L-3 -22", 6), ("M5 1 L6 -20", 6), ("M10 8 L20 -8", 6)]
    )
    return _moved(open_hand + ring + bar, (266, 34))


def _two_hands() -> str:
    """Draw one hand from each side."""
    left = _limbs([("M-8 232 L38 196", 27)], _SLEEVE) + _limbs(
        [("M36 198 L78 164", 20), ("M78 160 Q100 168 124 164", 13), ("M80 150 Q98 148 112 140", 11)]
    )
    right = _limbs([("M328 232 L284 196", 27)], _SLEEVE) + _limbs(
        [("M286 198 L256 168", 20), ("M254 162 Q230 170 206 166", 13), ("M252 152 Q236 150 222 142", 11)]
    )
    return left + right


def _picked_up() -> str:
    lifted = _moved(_toy("body"), (0, -32))
    up = _arrow("M160 222 L160 190", (160, 187), -90, 8)
    return _table(228) + lifted + _moved(_two_hands(), (0, -32)) + up


def _hugged() -> str:
    """Draw a person who presses the toy to the chest."""
    person = (
        _limbs([("M160 262 L160 150", 130)], _SLEEVE)
        + _ellipse((160, 50), (38, 40), _SKIN, _SKIN_LINE)
        + _path("M122 46 Q126 4 160 6 Q196 4 198 46 Q180 24 160 26 Q138 24 122 46 Z", fill="#5a4030")
        + _path("M141 50 q5 5 10 0 M169 50 q5 5 10 0", fill="none", stroke=_LINE, stroke_width=3)
        + _path("M146 66 Q160 78 174 66", fill="none", stroke=_LINE, stroke_width=3, stroke_linecap="round")
    )
    arms = _limbs([("M84 150 Q76 216 128 216", 27), ("M236 150 Q246 200 190 204", 27)], _SLEEVE) + _limbs(
        [("M130 216 Q150 218 172 206", 19), ("M188 204 Q168 206 150 190", 19)]
    )
    toy = _moved(_toy("body"), (52, 82), 0, 0.68)
    inwards = _arrow("M20 150 L44 150", (48, 150), 0, 9) + _arrow("M300 150 L276 150", (272, 150), 180, 9)
    heart = _path(
        "M262 62 C250 44 226 52 236 72 C240 82 252 90 262 98 C272 90 284 82 288 72 C298 52 274 44 262 62 Z",
        fill="#d6336c",
        stroke="#7a1238",
        stroke_width=3,
    )
    return person + toy + arms + inwards + heart


def _acting(place: str, hand: str, held: bool) -> str:
    """Draw a hand that acts on a toy, which stands on a table or is held."""
    beneath = "" if held else _table(216)
    return beneath + _moved(_toy(place) + (_holding() if held else "") + hand, (0, 16))


_ACTS = {
    "Back stroke": ("back", _stroke_back),
    "Ear scratch": ("ears", _scratch_ears),
    "Head stroke": ("head", _stroke_head),
    "Neck scratch": ("neck", _scratch_neck),
    "Tail hit": ("", _hit_rump),
    "Tail scratch": ("rump", _scratch_rump),
    "Tail tap": ("rump", _tap_rump),
}


def _drawings() -> dict[str, str]:
    drawn = {
        "At rest": _table(216) + _moved(_toy() + _rest(), (0, 16)),
        "Hold in hands": _picked_up(),
        "Hold strong": _hugged(),
        "Tail pull": _moved(_toy("tail", "M244 118 Q262 108 284 100") + _holding() + _pull_tail(), (0, 16)),
    }
    for family, (place, act) in _ACTS.items():
        drawn[f"{family} 1"] = _acting(place, act(), False)
        drawn[f"{family} 2"] = _acting(place, act(), True)
    return drawn


_DRAWN = {plain_label(label): parts for label, parts in _drawings().items()}


def has_picture(label: str) -> bool:
    """Return whether there is a drawing of this very gesture."""
    return plain_label(label) in _DRAWN


def picture(label: str, name: str = "") -> Markup:
    """Return a gesture as SVG; for a label outside plush-18 the toy alone.

    Args:
        name: what a screen reader says; the label by default.
    """
    parts = _DRAWN.get(plain_label(label)) or _table(216) + _moved(_toy(), (0, 16))
    return Markup(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{{name}}">'
        f'<title>{{name}}</title><rect width="{WIDTH}" height="{HEIGHT}" rx="16" fill="{_GROUND}"/>{parts}</svg>'
    ).format(name=name or label)


def own_picture(home: Path, label: str) -> str:
    """Return the user's own picture of a gesture as a ``data:`` address for an ``<img>``, or "".

    In an ``<img>`` nothing in an SVG runs. Only a plain file in ``home/pictures`` of at most `LARGEST` bytes is taken.
    """
    folder = home / FOLDER
    if not folder.is_dir():
        return ""
    for path in sorted(folder.iterdir()):
        kind = _KINDS.get(path.suffix.lower())
        if kind is None or plain_label(path.stem) != plain_label(label) or path.is_symlink() or not path.is_file():
            continue
        if path.stat().st_size <= LARGEST:
            return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
    return ""
