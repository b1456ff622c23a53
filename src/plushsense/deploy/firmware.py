"""The example firmware for one model: templates of ``c/toy`` filled in for its layout."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from plushsense.core.errors import LayoutError
from plushsense.core.layouts import DELAY_MS, DEVICE_MS, Channel, Layout
from plushsense.deploy.emit import c_names, comment
from plushsense.deploy.golden import measured
from plushsense.windows.features import Scaler

TEMPLATES = (
    "plush_wire.h",
    "plush_wire.c",
    "plush_reaction.h",
    "plush_reaction.c",
    "plush_fake.h",
    "plush_fake.c",
    "PlushToy.ino",
    "main.c",
)
# Touch pads of the ESP32 as (pad, GPIO); the last ones also decide how the chip starts.
_PADS = ((0, 4), (3, 15), (4, 13), (6, 14), (7, 27), (8, 33), (9, 32), (2, 2), (5, 12), (1, 0))
_NO_PAD = 255
# One count of the MPU-6050 in these units.
_MOTION = {
    "acceleration": {"count": 1.0, "g": 1 / 16384, "m/s²": 9.80665 / 16384, "m/s2": 9.80665 / 16384},
    "angular rate": {"count": 1.0, "°/s": 1 / 131, "deg/s": 1 / 131, "rad/s": math.radians(1 / 131)},
}
_FIRST_AXIS = {"acceleration": 0, "angular rate": 3}
_PADDED = ("capacitive", "proximity")
# Channels that the toy adds up (the paper's Table 1: "cumulative signal, based on all the capacitive sensors").
_TOTALS = ("cap_all",)
_MOST_DECIMALS = 9


@dataclass(frozen=True)
class _ChannelSource:
    """Source of a channel: ``kind`` as in the C enum, pad, GPIO or axis, factor in steps of 1/65536."""

    kind: str
    pad: int = 0
    pin: int = 0
    factor: int = 0


def firmware(layout: Layout, scaler: Scaler, facts: Mapping[str, Any]) -> dict[str, str]:
    """Render the files of `TEMPLATES` for a model with these ``facts`` (of ``export.json``), by name.

    Raises:
        LayoutError: for a step that no line can carry.
    """
    sources = _sources(layout)
    kinds = {s.kind for s in sources}
    written = [_written(c) for c in layout.channels]
    decimal = any(w != (1, 0) for w in written)
    conditions = {
        "decimal": decimal,
        "integer": not decimal,
        "delay_only": DEVICE_MS not in layout.wire,
        **{kind.lower(): kind in kinds for kind in ("TOUCH", "TOTAL", "MOTION", "OTHER")},
    }
    names = {c.name: f"PLUSH_CHANNEL_{n}" for c, n in zip(layout.channels, c_names(layout.names), strict=True)}
    words = {
        "title": comment(facts["title"]),
        "layout": f"layout {comment(layout.name)}",
        "n_channels": str(layout.n_channels),
        "n_classes": str(facts["classes"]),
        "period": f"{layout.period_us / 1000:g}",
        "gap": str(layout.gap_ms),
        "warm": f"{facts['span'] * layout.period_us / 1e6:.2g}",
        "fields": textwrap.fill(
            comment(" ".join(layout.wire)), 110, initial_indent=" *     ", subsequent_indent=" *     "
        ),
        "line_bytes": str(_line_bytes(layout, written)),
        "n_fields": str(len(layout.wire)),
        "number": "uint64_t" if decimal else "uint32_t",
        "order": "\n".join(f"    {names.get(field, field.upper())}," for field in layout.wire),
        "written": _rows(layout, [f"{times}, {decimals}" for times, decimals in written]),
        "usual": _rows(layout, [f"{usual}, {spread}" for usual, spread in _statistics(layout, scaler)]),
        "eyes": "18, 19, 23",
        "voice": "5",
    }
    found = {}
    for name in TEMPLATES:
        number = "pad" if name == "main.c" else "pin"
        wiring = {"sources": _table(layout, sources, number), "read": _READ}
        # The body of read_sensors has conditions of its own: conditions last.
        text = (files("plushsense.deploy") / "c" / "toy" / name).read_text(encoding="utf-8")
        found[name] = _chosen(_filled(text, wiring), conditions, words)
    return found


_READ = """\
@if motion@
    int16_t motion[6];
    const bool moved = read_motion(motion);
@end@
@if total@
    int32_t total = 0;
@end@

    for (uint32_t i = 0; i < PLUSH_MODEL_CHANNELS; i++) {
        switch (sources[i].from) {
@if touch@
        case FROM_TOUCH:
            values[i] = read_touch(sources[i].number);
@if total@
            if (values[i] != MISSING)
                total += values[i];
@end@
            break;
@end@
@if motion@
        case FROM_MOTION:
            values[i] = moved ? (int32_t)((int64_t)motion[sources[i].number] * sources[i].factor / 65536) : MISSING;
            break;
@end@
@if other@
        case FROM_OTHER:
            values[i] = read_other(sources[i].number);
            break;
@end@
        default:
            values[i] = MISSING;
        }
    }
@if total@
    for (uint32_t i = 0; i < PLUSH_MODEL_CHANNELS; i++)
        if (sources[i].from == FROM_TOTAL)
            values[i] = total;
@end@"""

_SOURCES = """\
enum {{ FROM_TOUCH, FROM_TOTAL, FROM_MOTION, FROM_OTHER }};
#define MISSING INT32_MIN /* no reading: out of its valid range, so that the last valid value stands in for it */

static const struct {{
    uint8_t from;
    uint8_t number; /* touch: {what}; motion: 0 to 2 acceleration x, y, z; 3 to 5 rotation x, y, z. */
    int32_t factor; /* motion: from counts of the sensor to steps of the channel, in 1/65536 */
}} sources[PLUSH_MODEL_CHANNELS] = {{
{rows}
}};"""


def _table(layout: Layout, sources: list[_ChannelSource], number: str) -> str:
    rows = []
    for channel, s in zip(layout.channels, sources, strict=True):
        at = s.pin if s.kind == "TOUCH" and number == "pin" else s.pad
        note = {"TOTAL": ": the sum of all pads", "OTHER": ": see read_other()"}.get(s.kind, "")
        note = ": NO PAD IS LEFT for it" if s.kind == "TOUCH" and at == _NO_PAD else note
        rows.append(
            f"    {{FROM_{s.kind}, {at}, {s.factor}}}, /* {comment(channel.name)}, {comment(channel.unit)}{note} */"
        )
    what = "the GPIO" if number == "pin" else "the touch pad (T0 is GPIO 4; T2 2, T3 15, T4 13, T5 12, T6 14, T7 27)"
    return _SOURCES.format(what=what, rows="\n".join(rows))


def _sources(layout: Layout) -> list[_ChannelSource]:
    found: list[_ChannelSource] = []
    pads = iter(_PADS)
    axes = dict(_FIRST_AXIS)
    others = 0
    for channel in layout.channels:
        factor = _motion_factor(channel)
        if channel.kind in _PADDED and channel.step == 1.0:
            if channel.name in _TOTALS:
                found.append(_ChannelSource("TOTAL"))
            else:
                found.append(_ChannelSource("TOUCH", *next(pads, (_NO_PAD, _NO_PAD))))
        elif factor is not None and axes[channel.kind] < _FIRST_AXIS[channel.kind] + 3:
            found.append(_ChannelSource("MOTION", axes[channel.kind], 0, factor))
            axes[channel.kind] += 1
        else:
            found.append(_ChannelSource("OTHER", others))
            others += 1
    return found


def _motion_factor(channel: Channel) -> int | None:
    """Return the factor from sensor counts to steps of the channel, in 1/65536; None for an unknown unit."""
    unit = _MOTION.get(channel.kind, {}).get(channel.unit)
    if unit is None or channel.offset != 0:
        return None
    factor = round(65536 * unit / ((1.0 if channel.unit == "count" else channel.scale) * channel.step))
    return factor if 0 < abs(factor) < 1 << 31 else None


def _written(channel: Channel) -> tuple[int, int]:
    """Return how the line format writes a channel's integer: its multiplier and the number of decimals."""
    decimals = 0
    while decimals < _MOST_DECIMALS and round(channel.step * 10**decimals, 6) != round(channel.step * 10**decimals):
        decimals += 1
    times = round(channel.step * 10**decimals)
    if not 1 <= times < 1 << 29:
        raise LayoutError(
            f"Channel '{channel.name}': a step of {channel.step:g} cannot be written on the toy's lines, which have up "
            f"to {_MOST_DECIMALS} decimals: choose another step."
        )
    return times, decimals


def _line_bytes(layout: Layout, written: list[tuple[int, int]]) -> int:
    clocks = sum(10 for field in layout.wire if field in (DEVICE_MS, DELAY_MS))
    values = sum(1 + max(len(str((1 << 31) * times)), 1 + decimals) + (decimals > 0) for times, decimals in written)
    return clocks + values + len(layout.wire) + 1


def _statistics(layout: Layout, scaler: Scaler) -> list[tuple[int, int]]:
    """Return mean and spread of each channel in training, as far as the scaler has them, within the valid range."""
    mean, spread = measured(layout, scaler)
    rows = []
    for at, wide, low, high in zip(
        mean.tolist(), spread.tolist(), layout.valid_min_int.tolist(), layout.valid_max_int.tolist(), strict=True
    ):
        middle = min(max(round(at), low), high)
        rows.append((middle, min(round(wide), (high - middle) // 2, (middle - low) // 2)))
    return rows


def _rows(layout: Layout, values: list[str]) -> str:
    return "\n".join(f"    {{{v}}}, /* {comment(c.name)} */" for c, v in zip(layout.channels, values, strict=True))


def _filled(text: str, words: Mapping[str, str]) -> str:
    return re.sub(r"@(\w+)@", lambda m: words.get(m[1], m[0]), text)


def _chosen(text: str, conditions: Mapping[str, bool], words: Mapping[str, str]) -> str:
    """Drop the parts between ``@if name@`` and ``@end@`` whose condition is false, and fill in the variables."""
    kept: list[str] = []
    holding: list[bool] = []
    for line in text.split("\n"):
        opened = re.fullmatch(r"@if (\w+)@", line)
        if opened:
            holding.append(conditions[opened[1]])
        elif line == "@end@":
            holding.pop()
        elif all(holding):
            kept.append(re.sub(r"@(\w+)@", lambda m: words[m[1]], line))
    return "\n".join(kept)
