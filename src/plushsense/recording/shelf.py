"""The sessions that lie in a folder, and how far each came; nothing is opened or changed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from plushsense.core.errors import PlushSenseError
from plushsense.recording.protocol import Protocol
from plushsense.recording.session import Standing, is_finished, replay_log
from plushsense.recording.sessionfile import SESSION_HEAD, SessionHead


@dataclass(frozen=True)
class Shelved:
    """A session as it lies there.

    Attributes:
        folder: the session's; ``head`` and ``protocol``: None where they cannot be read, and ``said`` is why.
        done, skipped, steps: recordings, as its log has them.
        finished: whether it came to its end.
    """

    folder: Path
    head: SessionHead | None = None
    protocol: Protocol | None = None
    done: int = 0
    skipped: int = 0
    steps: int = 0
    finished: bool = False
    said: str = ""


def sessions_in(out: Path) -> list[Shelved]:
    """All sessions in ``out``, the newest first; one that cannot be read is among them, with the reason."""
    found = [shelved(path.parent) for path in sorted(out.glob(f"*/*/{SESSION_HEAD}"))]
    return sorted(found, key=lambda s: -(s.head.started_ms if s.head is not None else 0))


def shelved(folder: Path) -> Shelved:
    """One session."""
    try:
        head = SessionHead.read(folder)
        if head is None:
            return Shelved(folder, said=f"'{folder}' holds no session.")
        protocol = Protocol.from_dict(head.protocol, f"protocol in '{folder / SESSION_HEAD}'")
        standing = Standing()
        replay_log(folder, standing)
        finished = is_finished(folder)
    except PlushSenseError as refusal:
        return Shelved(folder, said=str(refusal))
    steps = len(protocol.steps())
    return Shelved(folder, head, protocol, len(standing.takes), len(standing.skipped), steps, finished)
