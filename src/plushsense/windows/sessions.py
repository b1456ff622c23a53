"""Read streams and recordings as even samples, with what the session gave before them.

Without a self-calibration in the layout (`plushsense.windows.self_calibration`), these are the samples of
`plushsense.windows.clock.resample`. With one, its state at the beginning of a recording is what all earlier frames of
the person's session gave since the last reboot (rule 4 of the clock): those of the stream that contains it, or else the
earlier recordings of the session, by time, without excluded ones. A recording with nothing before it, or of nobody,
uses only itself. So every score is causal.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plushsense.core.gestures import NOBODY
from plushsense.dataset.quality.measurements import rows_at_one_time
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset, RecordingInfo
from plushsense.windows.clock import Segment, is_reboot, resample
from plushsense.windows.self_calibration import SelfCalibration


class SessionReader:
    """Reads the streams and recordings of a data set as segments of even samples, in any order."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self.standing = set[str]()
        """Ids of the recordings whose clock stands still, of those that were read."""
        self._states: dict[str, SelfCalibration] = {}  # at the beginning of each recording

    def stream(self, stream: str) -> list[Segment]:
        """Return the segments of a stream, as a toy that begins with its first frame has them."""
        dataset = self._dataset
        segments = resample(dataset.read_stream(stream), dataset.layout)
        if not dataset.layout.self_calibration:
            return segments
        mine = [r for r in dataset.recordings if r.stream == stream and r.stream_row >= 0]
        mine.sort(key=lambda r: r.stream_row + r.start)
        state, calibrated = SelfCalibration(dataset.layout), []
        for segment in segments:
            if segment.rebooted:
                state.reset()
            parts, at = [], 0
            while mine and mine[0].stream_row + mine[0].start <= segment.row_of[-1]:
                begin = int(np.searchsorted(segment.row_of, mine[0].stream_row + mine[0].start, side="left"))
                parts.append(state.apply(segment.data[at:begin]))
                at, self._states[mine.pop(0).id] = begin, state.copy()
            parts.append(state.apply(segment.data[at:]))
            calibrated.append(replace(segment, data=np.concatenate(parts)))
        for r in mine:
            self._states[r.id] = state
        return calibrated

    def recording(self, recording: RecordingInfo) -> list[Segment]:
        """Return the segments of a recording; none if its clock stands still, since nothing is known of its times."""
        dataset = self._dataset
        frames = dataset.read(recording)
        if rows_at_one_time(frames.device_ms):
            self.standing.add(recording.id)
            return []
        segments = resample(frames, dataset.layout)
        if not dataset.layout.self_calibration:
            return segments
        if recording.id not in self._states:
            self._follow(recording)
        state = self._states[recording.id].copy()
        return [state.calibrated(segment) for segment in segments]

    def _follow(self, recording: RecordingInfo) -> None:
        """Store the state at the beginning of all recordings of the same stream, or session."""
        if recording.stream_row >= 0:
            self.stream(recording.stream)
            return
        dataset = self._dataset
        if recording.subject in (NOBODY, UNKNOWN_SUBJECT):
            self._states[recording.id] = SelfCalibration(dataset.layout)
            return
        session = [
            r
            for r in dataset.recordings
            if (r.subject, r.session) == (recording.subject, recording.session) and r.stream_row < 0
        ]
        session.sort(key=lambda r: (r.epoch_ms, r.start_ms, r.id))
        read = [dataset.read(r) for r in session]
        state, before = SelfCalibration(dataset.layout), None
        for r, frames in zip(session, read, strict=True):
            if before is not None and is_reboot(before, frames):
                state.reset()
            self._states[r.id] = state.copy()
            if not r.excluded:
                before = frames
                for segment in resample(frames, dataset.layout):
                    state.calibrated(segment)
