"""Print what the bench measured, as Markdown: on the screen, and in docs/measurements/peers.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from plushsense.reports.table import Table, percent

OUR_ROW = "PlushSense C -O2, network only"
WHOLE_ROW = "PlushSense C -O2, frames to answer"
PLAIN_ROW = f"{WHOLE_ROW}, plain C"
AIM = 1.5  # least ratio of a peer's cost to that of our network, on the same algorithm
FAITHFUL = 0.8  # share of decisions that equal the float ones, below which a runtime is reported as broken


def _whole(value: float | None) -> str | None:
    return None if value is None else f"{value:,.0f}".replace(",", " ")


def _times(value: float | None, of: float | None) -> str | None:
    return None if value is None or of is None else f"{value / of:.2f}"


def _near(row: dict[str, Any]) -> tuple[str | None, str | None]:
    check = row["check"]
    return (None, None) if check is None else (percent(check["agreement"]), percent(check["logit_error"]))


def _us(row: dict[str, Any]) -> str:
    return "{median:.1f} ({p10:.1f}–{p90:.1f})".format(**row["us"])


def _streams(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of the stream, ours first, then by instructions."""
    rows = [row for row in rows if row["reads"] != "window"]
    return sorted(rows, key=lambda row: (row["reads"] == "stream", row["instructions"] or 0))


def same_algorithm(rows: list[dict[str, Any]]) -> Table:
    """Return what the kernels give: every runtime with the stream, on this computer."""
    ours = next(row for row in rows if row["name"] == OUR_ROW)
    heads = (
        "stream", "instructions", "× ours", "µs, median (10 to 90 %)", "× ours in time", "model B", "code B",
        "memory B", "decides as float", "logit error",
    )  # fmt: skip
    return Table.of(heads, ([
        row["name"], _whole(row["instructions"]), _times(row["instructions"], ours["instructions"]), _us(row),
        f"{row['times_slower']:.2f}", *(_whole(row[f"{what}_bytes"]) for what in ("model", "code", "memory")),
        *_near(row),
    ] for row in _streams(rows)))  # fmt: skip


def both_algorithms(rows: list[dict[str, Any]]) -> Table:
    """Return what the algorithm gives: each runtime with the window and the stream."""
    heads = (
        "window", "instructions", "÷ stream", "µs, median (10 to 90 %)", "÷ stream in time", "decides as float",
        "logit error",
    )  # fmt: skip
    streams = {row["name"]: row for row in _streams(rows)}
    windows = {row["name"]: row for row in rows if row["reads"] == "window"}
    return Table.of(heads, ([
        name, _whole(windows[name]["instructions"]), _times(windows[name]["instructions"], row["instructions"]),
        _us(windows[name]), _times(windows[name]["us"]["median"], row["us"]["median"]), *_near(windows[name]),
    ] for name, row in streams.items() if name in windows))  # fmt: skip


def on_chip(rows: list[dict[str, Any]], macs: int) -> Table:
    """Return the rows of the emulated chip."""
    ours = next(row["instructions"] for row in rows if row["name"] == OUR_ROW)
    heads = (
        "Cortex-M4 on QEMU",
        "graph",
        "instructions",
        "× ours",
        "a MAC of the stream",
        "decides as float",
        "logit error",
    )
    rows = [*_streams(rows), *(row for row in rows if row["reads"] == "window")]
    return Table.of(heads, ([
        row["name"], "window" if row["reads"] == "window" else "stream", _whole(row["instructions"]),
        _times(row["instructions"], ours), None if row["reads"] == "window" else _times(row["instructions"], macs),
        *_near(row),
    ] for row in rows))  # fmt: skip


def verdict(report: dict[str, Any]) -> str:
    """Say which peers are below the aim, by instructions and by time."""
    counted, slow = [], []
    ours = {where: next((r for r in report[where] if r["name"] == OUR_ROW), None) for where in ("rows", "chip")}
    for where, title in (("rows", ""), ("chip", " on the Cortex-M4")):
        mine = ours[where]
        for row in report[where]:
            if row["reads"] != "stream" or mine is None:
                continue
            if None not in (row["instructions"], mine["instructions"]):
                ratio = row["instructions"] / mine["instructions"]
                counted += [f"{row['name']}{title} ({ratio:.2f})"] if ratio < AIM else []
            if row.get("times_slower", AIM) < AIM:
                slow.append(f"{row['name']} ({row['times_slower']:.2f})")
    return (
        f"Aim: every peer takes at least {AIM:g} times as much as our network with the same algorithm. Below it by "
        f"instructions: {', '.join(counted) or 'none'}; by time: {', '.join(slow) or 'none'}."
    )


def lines(report: dict[str, Any]) -> Iterator[str]:
    """Yield the tables of a network and what belongs to them, in Markdown."""
    case, computer = report["case"], report["machine"]
    yield (
        f"`{case['symbol']}` 8/12/16, {case['channels']} channels, {case['classes']} classes, one decision every "
        f"{case['step_ms']:g} ms: {_whole(case['macs_ours'])} multiply-accumulates with the stream, "
        f"{_whole(case['macs'])} with the window of {case['samples']} samples (form `{case['form']}`)."
    )
    yield from ("", same_algorithm(report["rows"]).markdown(), "")
    if any(row["reads"] == "window" for row in report["rows"]):
        yield from (both_algorithms(report["rows"]).markdown(), "")
    if report["chip"]:
        yield from (on_chip(report["chip"], case["macs_ours"]).markdown(), "")
    yield verdict(report)
    for row in (*report["rows"], *report["chip"]):
        if row["check"] is not None and row["check"]["agreement"] < FAITHFUL:
            share = percent(row["check"]["agreement"], 0)
            yield f"Broken: {row['name']} ({row['reads']}) agrees with the floats in {share} only."
    if report["absent"]:
        yield "Not measured:"
        yield from (f"{name}: {reason}" for name, reason in report["absent"].items())
    load = "" if computer["load"] is None else f", load {computer['load'][0]:.1f} before"
    versions = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    yield from ("", f"{computer['cpu']}, {computer['cores']} cores{load}; {report['compiler']}; {versions}.")


def page_of(text: str, results: dict[str, dict[str, Any]]) -> str:
    """Return the page with the tables of ``results`` between each network's marks; raise ValueError without them."""
    for name, report in results.items():
        mark, end = f"<!-- bench/peers.json: {name} -->\n", "<!-- end -->"
        before, found, rest = text.partition(mark)
        _, ended, after = rest.partition(end)
        if not (found and ended):
            raise ValueError(f"The page has no place for the network {name}: it begins with {mark.strip()}")
        text = "\n".join([f"{before}{mark}", *lines(report), "", f"{end}{after}"])
    return text
