"""From sessions, or from a zip that was brought in, to a data set; or into one that is there."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from plushsense.apps.studio.jobs import UNFINISHED
from plushsense.apps.studio.worker import Tell
from plushsense.dataset.archives import Limits
from plushsense.dataset.importers import import_recordings

UNPACKED = Limits(total_bytes=4_000_000_000, files=50_000)
"""What a zip that came through the browser may unpack to."""


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Import ``sessions`` (folders below ``recordings``, gathered in ``work``) or the zip ``archive`` to ``dest``.

    ``add``: to the data set that is there. The archive is the studio's own copy, and is removed in the end.
    """
    settings: dict[str, Any] = {"add_to": True} if spec.get("add") else {"name": spec.get("name") or None}
    if spec.get("layout"):
        settings["layout"] = spec["layout"]
    archive = Path(spec["archive"]) if spec.get("archive") else None
    try:
        with _itself(archive) if archive is not None else _gathered(spec) as source:
            done = import_recordings(
                source,
                spec["dest"],
                progress=lambda at, total: tell.progress(done=at, total=total),
                limits=UNPACKED,
                **settings,
            )
    finally:
        if archive is not None:
            archive.unlink(missing_ok=True)
    return {
        "dataset": str(spec["dest"]),
        "recordings": done.recordings,
        "subjects": done.subjects,
        "added": done.added,
        "already_there": done.already_there,
        "warnings": done.notes + done.warnings,
        "left_out": done.left_out,
        "rejected": done.rejected,
        "seconds": round(done.seconds, 2),
    }


@contextmanager
def _itself(archive: Path) -> Iterator[Path]:
    yield archive


@contextmanager
def _gathered(spec: dict[str, Any]) -> Iterator[Path]:
    """A folder that holds these sessions and no others, by links to the same files where the disk can do that."""
    recordings = Path(spec["recordings"])
    work = Path(spec["work"])
    work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=work) as place:
        folder = Path(place) / "recordings"
        for session in spec["sessions"]:
            inside = Path(session).relative_to(recordings)
            shutil.copytree(recordings / inside, folder / inside, copy_function=_linked)
        yield folder


def _linked(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target
