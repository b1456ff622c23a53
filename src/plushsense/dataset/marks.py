"""Marks: what people decided about recordings. Append-only; a raw file never changes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from filelock import FileLock

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.tomlfile import refuse_unknown

MARKS = "marks.jsonl"
ACTIONS = ("trim", "untrim", "exclude", "include")


@dataclass(frozen=True)
class Mark:
    """One decision: ``trim`` keeps rows ``start`` to ``stop``; ``untrim`` and ``include`` undo."""

    recording: str
    action: str
    who: str
    why: str = ""
    start: int = 0
    stop: int = -1
    when: str = ""


@dataclass(frozen=True)
class Standing:
    """Where the marks leave one recording."""

    excluded: bool = False
    start: int = 0
    stop: int = -1


def append_marks(folder: Path, marks: Iterable[Mark]) -> None:
    """Add marks at the end, under a file lock, so that two programs can mark at once."""
    lines = []
    for mark in marks:
        if mark.action not in ACTIONS:
            raise DatasetError(
                f"Unknown mark '{mark.action}': accepted are {', '.join(ACTIONS)}.{nearest(mark.action, ACTIONS)}"
            )
        table = asdict(mark)
        table["when"] = mark.when or datetime.now(timezone.utc).isoformat(timespec="seconds")
        lines.append(json.dumps(table, ensure_ascii=False) + "\n")
    with FileLock(folder / (MARKS + ".lock")), (folder / MARKS).open("a", encoding="utf-8") as file:
        file.write("".join(lines))


def read_marks(folder: Path) -> dict[str, Standing]:
    """Where the marks leave each marked recording; a torn last line (a crash while writing) is passed over."""
    path = folder / MARKS
    standing: dict[str, Standing] = {}
    if not path.is_file():
        return standing
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, 1):
        try:
            table: dict[str, Any] = json.loads(line)
            refuse_unknown(table, Mark.__dataclass_fields__, f"'{path}' line {number}", DatasetError)
            mark = Mark(**table)
        except (json.JSONDecodeError, TypeError):
            if number == len(lines):
                continue
            raise DatasetError(f"'{path}' line {number} is damaged: each line is one mark in JSON.") from None
        now = standing.get(mark.recording, Standing())
        match mark.action:
            case "trim":
                now = Standing(now.excluded, mark.start, mark.stop)
            case "untrim":
                now = Standing(now.excluded)
            case "exclude":
                now = Standing(True, now.start, now.stop)
            case "include":
                now = Standing(False, now.start, now.stop)
            case other:
                raise DatasetError(f"'{path}' line {number}: unknown mark '{other}'.{nearest(other, ACTIONS)}")
        standing[mark.recording] = now
    return standing
