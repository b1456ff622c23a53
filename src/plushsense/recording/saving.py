"""A finished recording on its way to the disk, and what is said when the disk takes no more."""

from __future__ import annotations

from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.devices.base import Counters
from plushsense.recording.session import OpenSession
from plushsense.recording.sessionfile import Event
from plushsense.recording.take import Ended, Take, sidecar
from plushsense.recording.writer import save_take, to_frames


def keep_take(
    session: OpenSession, take: Take, counters: Counters, ended: Ended, saved_ms: int, earlier: str, **more: Any
) -> tuple[str, str]:
    """Write a recording, its sidecar and its line in the log; ``earlier`` is the file that it stands in for, or "".

    Returns:
        The file's name, and what the person should know about it, or "".

    Raises:
        OSError: when the disk refuses; nothing half is left.
    """
    layout, step = session.layout, take.step
    frames = to_frames(take.frames, layout.n_channels)
    beside = sidecar(take, frames, layout, session.head, counters, ended, saved_ms=saved_ms, **more)
    path = save_take(session.folder, frames, layout, step.gesture, saved_ms, beside)
    key = {"gesture": step.gesture, "repetition": step.repetition}
    says = {"rows": len(frames), "lost": take.lost, "gaps": len(take.gaps), "ended": ended}
    events = [Event("take", saved_ms, {"file": path.name} | key | says)]
    if earlier:
        events.append(Event("redo", saved_ms, {"file": earlier} | key))
    session.log.write(events)
    said = ""
    if ended == "longest":
        longest_s = session.protocol.longest_s
        said = f"Nobody stopped it: it ended by itself after {longest_s:g} s; r makes it again."
    elif take.gaps:
        longest = max(gap["missing_ms"] for gap in take.gaps) / 1000.0
        what = f"has a hole of {longest:.1f} s" if longest >= 0.05 else "has a jump in the toy's clock"
        said = f"This recording {what}; it is kept, r makes it again."
    return path.name, said


def refusal(session: OpenSession, recordings: int, cause: Exception) -> DatasetError:
    """The sentence with which a session stops that cannot be written any more."""
    why = getattr(cause, "strerror", None) or cause
    return DatasetError(
        f"'{session.folder}' cannot be written any more ({why}): the session has stopped. "
        f"What was recorded until then is kept ({recordings} recordings); "
        "make room, and go on with the same session."
    )
