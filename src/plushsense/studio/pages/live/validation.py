"""Lead a person through the paper's live validation (section 4.6), and score it when it ends.

The signals are recorded as a session (see `plushsense.studio.pages.live.signal_recording`), so that a crash loses
nothing; at the end its parts are labelled with the gestures that were prompted, and the result is written to
``validations/<subject>/``.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.dataset.index import open_dataset
from plushsense.devices.base import Frame
from plushsense.experiments.protocol.run_protocol import RESULT, live_protocol
from plushsense.experiments.protocol.sittings import GestureTrial, Sitting
from plushsense.models.bundle import Bundle
from plushsense.studio.app.toys import TappedDevice
from plushsense.studio.app.workspace import ChangeSignal, Workspace
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.signal_recording import SignalRecording
from plushsense.windows.clock import row_times_us

FOLDER = "validations"
"""Name of the folder in the studio's home that holds the results."""
COUNTDOWN_S, GESTURE_S, AFTER_S = 3.0, 5.0, 2.0
"""Time to get ready, to make the gesture, and in which a late answer still counts, by the clock of the toy."""
_LONGEST_S = 3600.0
_WAIT_S = 30.0
"""Time by the clock of the toy within which a virtual person begins the prompted gesture."""

Phase = Literal["", "countdown", "doing", "after", "paused", "scoring"]


@dataclass(frozen=True)
class ValidationStatus:
    """State of the validation; ``phase`` is "" while none is led.

    Attributes:
        at, total: number of the current trial, from 0, and of all trials.
        label, repetition: the gesture that is prompted.
        left_s: whole seconds until the phase ends.
        done: number of trials that were made.
        reactions: number of the toy's own reactions that were noted; None where they are not noted.
        result: folder of the last result, None before the first.
        failed: the error that ended the last validation, if any.
    """

    phase: Phase = ""
    at: int = 0
    total: int = 0
    label: str = ""
    repetition: int = 1
    left_s: int = 0
    done: int = 0
    reactions: int | None = None
    result: Path | None = None
    failed: PlushSenseError | None = None

    @property
    def can_pause(self) -> bool:
        """Whether there is a trial to wait for; after the last one there is none."""
        return self.phase in ("countdown", "doing", "paused") or (self.phase == "after" and self.at + 1 < self.total)


@dataclass
class _Run:
    """A validation that is being led: the trials to make, and those that were made."""

    subject: str
    key: str
    plan: list[tuple[str, int]]
    bundle: Bundle
    engine: str
    simulated: bool
    tune_on: Path | None
    device: TappedDevice
    trials: list[GestureTrial]
    reactions: list[tuple[float, str]] | None = None
    until_s: float = 0.0
    start_s: float = 0.0
    performed: int = 0


class Validation:
    """Service that leads one validation at a time; it notifies `changed` after every change of ``status``."""

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self.status = ValidationStatus()
        self._workspace = workspace
        self._reader = workspace.part(LiveReader)
        self._recording = workspace.part(SignalRecording)
        self._lock = threading.RLock()
        self._run: _Run | None = None

    # Commands ---------------------------------------------------------------------------------------------------

    def begin(self, subject: str, repetitions: int, tune_on: Path | None, noted: bool = False) -> None:
        """Begin with the first trial: every gesture of the bundle but idle ones, ``repetitions`` times in a row.

        Args:
            tune_on: data set on whose people the rule baseline is tuned; None leaves the rules out.
            noted: whether somebody notes the toy's own reactions with `react`.

        Raises:
            ConfigError: if no toy is read, or a validation is under way. DatasetError: as for `SignalRecording.begin`.
        """
        reader = self._reader
        with self._lock:
            if self._run is not None:
                raise ConfigError("A validation is under way. End it first.")
            bundle, device, choice = reader.bundle, reader.device, reader.choice
            key = self._recording.begin(reader, subject, _LONGEST_S)
            assert bundle is not None and device is not None
            labels = [g.label for g in bundle.gestures.gestures if not g.idle]
            plan = [(label, n) for label in labels for n in range(1, repetitions + 1)]
            person = key.partition("/")[0]
            reactions: list[tuple[float, str]] | None = [] if noted else None
            run = _Run(person, key, plan, bundle, choice.engine, choice.simulated, tune_on, device, [], reactions)
            self._run = run
            self.status = ValidationStatus(total=len(plan), reactions=0 if noted else None, result=self.status.result)
            self._prompt(run, 0, 0.0, None)
            device.taps.append(self._tap)
        self.changed.notify()

    def pause(self) -> None:
        """Stop the prompts, or continue with the countdown of the same trial; after a trial, wait for the next one."""
        with self._lock:
            run = self._run
            if run is None or not self.status.can_pause:
                return
            if self.status.phase == "paused":
                self._prompt(run, self.status.at, self._recording.recorded_s, None)
            else:
                if self.status.phase == "after":
                    self._next(run, self._recording.recorded_s, None)
                self.status = replace(self.status, phase="paused", left_s=0)
        self.changed.notify()

    def skip(self) -> None:
        """Go on with the next trial; the current one does not count."""
        with self._lock:
            run = self._run
            if run is not None and self.status.phase in ("countdown", "doing", "paused"):
                self._next(run, self._recording.recorded_s, None)
        self.changed.notify()

    def react(self, affect: str) -> None:
        """Note that the toy's own rules reacted just now; ``affect`` is "positive" or "negative"."""
        with self._lock:
            run = self._run
            if run is not None and run.reactions is not None and self.status.phase != "scoring":
                run.reactions.append((self._recording.recorded_s, affect))
                self.status = replace(self.status, reactions=len(run.reactions))
        self.changed.notify()

    def stop(self) -> None:
        """End the validation and score the trials that were made."""
        with self._lock:
            run = self._run
            if run is not None and self.status.phase != "scoring":
                self._finish(run)
        self.changed.notify()

    def results(self) -> list[Path]:
        """Return the folders of all results, the newest first."""
        found = (self._workspace.folder / FOLDER).glob(f"*/{RESULT}")
        return [p.parent for p in sorted(found, key=lambda p: -p.stat().st_mtime)]

    def read(self, folder: Path) -> dict[str, Any]:
        """Return a result, as `plushsense.experiments.protocol.run_protocol.live_protocol` wrote it."""
        path = self._workspace.inside(folder) / RESULT
        try:
            result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise ConfigError("The result {name} cannot be read.", name=folder.name) from None
        return result

    # By the clock of the toy, in the thread of the reader ---------------------------------------------------------

    def _tap(self, frames: list[Frame]) -> None:
        with self._lock:
            run, before = self._run, self.status
            if run is None or before.phase in ("", "scoring"):
                return
            if self._recording.key != run.key:
                # It reached its longest length, or cannot be written.
                self._finish(run)
            else:
                self._advance(run, self._recording.recorded_s, frames[-1].device_ms)
            changed = self.status != before
        if changed:
            self.changed.notify()

    def _advance(self, run: _Run, now_s: float, device_ms: int) -> None:
        """Go on to the next phase when it is time; the caller must hold the lock."""
        phase = self.status.phase
        if phase == "countdown" and now_s >= run.until_s:
            run.start_s, run.until_s = now_s, now_s + GESTURE_S
            self.status = replace(self.status, phase="doing")
        elif phase == "doing":
            self._watch(run, now_s, device_ms)
        elif phase == "after" and now_s >= run.until_s:
            self._next(run, now_s, device_ms)
        if self.status.phase in ("countdown", "doing"):
            self.status = replace(self.status, left_s=max(0, int(np.ceil(run.until_s - now_s))))

    def _watch(self, run: _Run, now_s: float, device_ms: int) -> None:
        """End the trial when its time is over or, of a virtual person, when the gesture is made."""
        start_s, stop_s = run.start_s, run.until_s
        if self._reader.person is not None:
            made = self._made(run, now_s)
            if made is None:
                if now_s < run.start_s + _WAIT_S:
                    return
                self._next(run, now_s, device_ms)
                return
            start_s, stop_s = made
        if now_s >= stop_s:
            label, repetition = run.plan[self.status.at]
            run.trials.append(GestureTrial(label, repetition, start_s, start_s, stop_s))
            run.until_s = now_s + AFTER_S
            self.status = replace(self.status, phase="after", left_s=0, done=len(run.trials))

    def _made(self, run: _Run, now_s: float) -> tuple[float, float] | None:
        """Return when in the recording the virtual person makes the prompted gesture; None if it has not begun."""
        made = [p for p in self._reader.performed(run.performed) if p.label == self.status.label]
        if not made:
            return None
        shift_s = now_s - float(run.device.buffer.since(run.device.buffer.count - 1).seconds[-1])
        return made[-1].start_s + shift_s, made[-1].end_s + shift_s

    def _next(self, run: _Run, now_s: float, device_ms: int | None) -> None:
        if self.status.at + 1 < len(run.plan):
            self._prompt(run, self.status.at + 1, now_s, device_ms)
        else:
            self._finish(run)

    def _prompt(self, run: _Run, at: int, now_s: float, device_ms: int | None) -> None:
        """Begin the countdown of a trial; a virtual person is asked to begin at its end."""
        label, repetition = run.plan[at]
        run.until_s = now_s + COUNTDOWN_S
        run.performed = len(self._reader.performed())
        if (person := self._reader.person) is not None:
            person.follow()
            person.perform(label, None if device_ms is None else device_ms + round(1000.0 * COUNTDOWN_S))
        left_s = round(COUNTDOWN_S)
        self.status = replace(
            self.status, phase="countdown", at=at, label=label, repetition=repetition, left_s=left_s, failed=None
        )

    def _finish(self, run: _Run) -> None:
        """Score in a thread of its own; the caller must hold the lock."""
        self.status = replace(self.status, phase="scoring", left_s=0)
        if (person := self._reader.person) is not None:
            person.release()
        threading.Thread(target=self._score, args=(run,), name="plushsense-validation", daemon=True).start()

    # At the end ---------------------------------------------------------------------------------------------------

    def _score(self, run: _Run) -> None:
        failed: PlushSenseError | None = None
        result = self.status.result
        try:
            with contextlib.suppress(ValueError):
                run.device.taps.remove(self._tap)
            self._recording.end()
            failed = self._recording.failed
            if run.trials:
                result = self._write(run)
        except PlushSenseError as cause:
            failed = cause
        except Exception as cause:  # noqa: BLE001, RUF100
            what = f"{type(cause).__name__}: {cause}"
            failed = ConfigError("The validation cannot be scored ({what}). Its signals are recorded.", what=what)
        with self._lock:
            self._run = None
            self.status = ValidationStatus(done=len(run.trials), total=len(run.plan), result=result, failed=failed)
        self.changed.notify()

    def _write(self, run: _Run) -> Path:
        """Label the parts of the recording, score the trials and write the result; return its folder."""
        frames, layout = self._recording.read(run.key)
        times_s = row_times_us(frames, layout) / 1e6
        self._recording.label(run.key, list(_parts(run.trials, times_s.tolist())))
        home = self._workspace
        out = home.new(FOLDER, home.free_name(FOLDER, run.subject))
        tune_on = open_dataset(home.inside(run.tune_on)) if run.tune_on is not None else None
        reactions = None if run.reactions is None else tuple(run.reactions)
        sitting = Sitting(run.subject, frames, tuple(run.trials), reactions)
        live_protocol(run.bundle, [sitting], engine=run.engine, tune_on=tune_on, simulated=run.simulated, out=out)
        return out


def _parts(trials: list[GestureTrial], times_s: list[float]) -> Iterator[tuple[str, int, int]]:
    """Yield the gesture of each trial with the first and the last row, exclusive, of its part of the recording."""
    for trial in trials:
        first, last = np.searchsorted(times_s, (trial.start_s, trial.stop_s)).tolist()
        if last - first >= 2:
            yield trial.label, first, last
