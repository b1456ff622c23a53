"""The recordings as a Motion-BIDS-like tree; its README and `DEVIATIONS` state where it differs from the standard.

``sub-P01/[ses-1/]motion/sub-P01_task-backstroke1_tracksys-toy_run-1_motion.tsv``: one trimmed recording per file, no
header, one column per channel and the time since its start; beside it ``_channels.tsv`` and ``_motion.json``. After
Jeung et al., *Motion-BIDS*, Scientific Data 2024.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.layouts import Channel
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.publishing.description import Description
from plushsense.dataset.publishing.readme import bids_readme
from plushsense.dataset.store import RecordingInfo

BIDS = "bids"
BIDS_VERSION = "1.9.0"
TRACKSYS = "toy"
DEVIATIONS = (
    "each gesture is a task and each recording a run of it, where BIDS thinks of one long recording with events",
    "rows are as the toy sent them, not evenly spaced: the LATENCY channel says when, in seconds since the first row",
    "touch channels are of type MISC, since BIDS knows no touch; values are raw readings",
    "the toy's axes are relative to the toy, not to a person's body: no placement is given",
    "session streams are not here, only recordings; excluded recordings are not here, and trimmed rows are left out",
)
_TYPES = {"acceleration": "ACCEL", "angular rate": "GYRO"}


def write_bids(root: Path, d: Description) -> int:
    """Write the tree into ``root/bids`` and return how many recordings it holds."""
    top = root / BIDS
    dataset = d.dataset
    used = dataset.used
    people = sorted({r.subject for r in used})
    names = _letters(people, "x")
    tasks = _letters(list(dict.fromkeys(r.gesture for r in used)), "task")
    sessions = {p: sorted({r.session for r in used if r.subject == p}, key=_by_number) for p in people}
    runs: dict[tuple[str, str, str], int] = {}
    for r in used:
        several = len(sessions[r.subject]) > 1
        number = sessions[r.subject].index(r.session) + 1
        key = (r.subject, r.session, r.gesture)
        runs[key] = runs.get(key, 0) + 1
        sub = f"sub-{names[r.subject]}"
        ses = f"ses-{number}" if several else ""
        folder = top / sub / ses / "motion"
        folder.mkdir(parents=True, exist_ok=True)
        stem = "_".join(
            p for p in (sub, ses, f"task-{tasks[r.gesture]}", f"tracksys-{TRACKSYS}", f"run-{runs[key]}") if p
        )
        _write_run(folder, stem, dataset.read(r), r, d)
    _json(
        top / "dataset_description.json",
        {
            "Name": d.title,
            "BIDSVersion": BIDS_VERSION,
            "DatasetType": "raw",
            "License": d.licence.spdx,
            "Authors": [c.name for c in d.creators],
            "HowToAcknowledge": d.citation,
        },
    )
    rows = [f"sub-{names[p]}\t{p}" for p in people]
    _text(top / "participants.tsv", "participant_id\tsubject\n" + "".join(row + "\n" for row in rows))
    _json(
        top / "participants.json",
        {"subject": {"Description": "the person's code in subjects.csv, where all that is known of the person stands"}},
    )
    _text(top / "README", bids_readme(d, DEVIATIONS))
    return len(used)


def _write_run(folder: Path, stem: str, frames: Frames, r: RecordingInfo, d: Description) -> None:
    layout = d.dataset.layout
    since = (frames.device_ms - frames.device_ms[:1]) / 1000.0
    digits = [max(0, -int(np.floor(np.log10(c.step)))) for c in layout.channels]
    lines = []
    for time, row in zip(since.tolist(), frames.values.tolist(), strict=True):
        cells = [f"{v * c.step:.{n}f}" for v, c, n in zip(row, layout.channels, digits, strict=True)]
        lines.append("\t".join([*cells, f"{time:.3f}"]) + "\n")
    _text(folder / f"{stem}_motion.tsv", "".join(lines))
    table = ["name\tcomponent\ttype\ttracked_point\tunits\n"]
    table += [
        f"{c.name}\t{_component(c)}\t{_TYPES.get(c.kind, 'MISC')}\ttoy\t{c.unit or 'n/a'}\n" for c in layout.channels
    ]
    table.append("latency\tn/a\tLATENCY\tn/a\ts\n")
    _text(folder / f"{stem}_channels.tsv", "".join(table))
    counts = {f"{kind}ChannelCount": 0 for kind in ("ACCEL", "GYRO", "MISC")}
    for c in layout.channels:
        counts[f"{_TYPES.get(c.kind, 'MISC')}ChannelCount"] += 1
    _json(
        folder / f"{stem}_motion.json",
        {
            "TaskName": r.gesture,
            "TaskDescription": g.description if (g := d.dataset.gestures.find(r.gesture)) else "",
            "SamplingFrequency": layout.rate_hz,
            "SamplingFrequencyEffective": round(r.rate_hz, 3),
            "TrackingSystemName": TRACKSYS,
            "Manufacturer": "n/a",
            "DeviceSerialNumber": "n/a",
            "RecordingType": "discontinuous",
            "MotionChannelCount": layout.n_channels + 1,
            "LATENCYChannelCount": 1,
            **counts,
        },
    )


def _component(channel: Channel) -> str:
    axis = next((part for part in channel.name.lower().split("_") if part in ("x", "y", "z")), "")
    return axis if axis and channel.kind in _TYPES else "n/a"


def _letters(words: list[str], empty: str) -> dict[str, str]:
    """Return distinct BIDS labels of letters and digits."""
    labels: dict[str, str] = {}
    for word in words:
        plain = "".join(c for c in word if c.isascii() and c.isalnum()) or empty
        label, number = plain, 2
        while label.casefold() in {v.casefold() for v in labels.values()}:
            label, number = f"{plain}x{number}", number + 1
        labels[word] = label
    return labels


def _by_number(session: str) -> tuple[int, str]:
    digits = "".join(c for c in session if c.isdigit())
    return int(digits) if digits else 0, session


def _json(path: Path, table: dict[str, Any]) -> None:
    _text(path, json.dumps(table, ensure_ascii=False, indent=1) + "\n")


def _text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")
