"""Sessions for tests, made by the recorder itself."""

from __future__ import annotations

from pathlib import Path

from plushsense.recording.plan import load_protocol
from plushsense.recording.recorder import AutoRecording, Recorder, open_toy, prompt_virtual
from plushsense.recording.writer import SessionHead
from plushsense.studio.app.workspace import Workspace


def record(workspace: Workspace, subject: str, session: str = "1", simulated: bool = True) -> Path:
    """A session of the quick protocol, made by the recorder itself."""
    folder = workspace.recordings / subject / session
    device = open_toy("virtual://?person=3&speed=50")
    protocol = load_protocol("quick")
    head = SessionHead(
        subject,
        session,
        1_700_000_000_000,
        device.layout.to_dict(),
        protocol.to_dict(),
        device=device.url,
        simulated=simulated,
    )
    recorder = Recorder.open(folder, device, head, speed=50.0, auto=AutoRecording(1.0))
    prompt_virtual(recorder)
    with device, recorder:
        assert recorder.wait("finished", timeout_s=60.0)
    return folder
