"""Record three gestures, train a network on them and watch it live: the first minute with a toy, on one screen."""

from __future__ import annotations

import math
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import tomli_w
from nicegui import context, run, ui

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.core.gestures import load_gestures, plain_label
from plushsense.core.sentences import Message
from plushsense.core.version import __version__
from plushsense.dataset.privacy.removed import refuse_removed
from plushsense.devices.opening import is_virtual, speed_of, with_speed
from plushsense.models.bundle import Bundle
from plushsense.recording.recorder import AutoRecording, Recorder, open_toy, prompt_virtual
from plushsense.recording.session import OpenSession, SessionRequest, change_subject, session_folder, session_head
from plushsense.recording.status import RecorderStatus
from plushsense.studio.app.jobs import DONE, READY, RUNNING, UNFINISHED, Jobs, StudioJob
from plushsense.studio.app.shell import Page, button, heading, named, on_change, tag
from plushsense.studio.app.toys import TappedDevice, Toys, ToyUse
from plushsense.studio.app.workspace import BUNDLES, VIRTUAL, WORK, ChangeSignal, Workspace
from plushsense.studio.pages.live.feed import Feed, LiveView, follow
from plushsense.studio.pages.live.live_state import LiveChoice
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.widgets.elements import errors_beside, notice

TITLE = "Try it with three gestures of your own"
_SET = "plush-18"
_GESTURES = ("Back stroke 1", "Tail pull", "Hold strong")
_REPETITIONS = 5
_COUNTDOWN_S = 2.0
_PACE = AutoRecording(take_s=4.0, rest_s=0.5)
_NOBODY_YET = "P01"
"""Code of the person in a trial; a person who keeps the recordings chooses another."""
_LOOK_S = 0.1
_CHOOSING, _RECORDING, _LEARNING, _LIVE = "choosing", "recording", "learning", "live"


class FirstTrial:
    """Service for one trial at a time; every change notifies `changed`.

    All its files are in a temporary folder, which is removed when the trial or the studio ends. Its methods block.

    Attributes:
        state: `_CHOOSING`, `_RECORDING`, `_LEARNING` or `_LIVE`.
        failed: why the last trial broke off; empty if it did not.
        kept: name of the session that was kept, "" if it was not.
    """

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self.state, self.failed = _CHOOSING, Message()
        self.recorder: Recorder | None = None
        self.job: StudioJob | None = None
        self.kept = ""
        self._workspace, self._jobs = workspace, workspace.part(Jobs)
        self._reader, self._toys = workspace.part(LiveReader), workspace.part(Toys)
        self._device: TappedDevice | None = None
        self._folder: Path | None = None
        self._lock = threading.RLock()

    def begin(self, gestures: Sequence[str]) -> None:
        """Record the gestures with the chosen toy, then train and go live; end an earlier trial first.

        Raises:
            PlushSenseError: if two gestures are equal, or the toy cannot be used.
        """
        if len(set(map(plain_label, gestures))) < len(gestures):
            raise ConfigError("Choose three different gestures.")
        url = self._workspace.toy or self._toys.choose(VIRTUAL)
        for label in set(gestures) - set(load_gestures(_SET).labels):
            self._workspace.check_name(label)
            if is_virtual(url):
                raise ConfigError("The virtual person cannot make “{gesture}”. Choose one of the list.", gesture=label)
        with self._lock:
            self.end()
            self._reader.stop()
            work = self._workspace.folder / WORK
            work.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f"{UNFINISHED}trial-", dir=work))
            try:
                self._record(url, gestures, self._folder)
            except BaseException:
                self.end()
                raise
            self.state = _RECORDING
        self._toys.update_uses()
        self.changed.notify()

    def _record(self, url: str, gestures: Sequence[str], folder: Path) -> None:
        own = dict.fromkeys(set(gestures) - set(load_gestures(_SET).labels), "neutral")
        protocol = {"name": "trial", "gesture_set": _SET, "gestures": list(gestures), "affects": own}
        table = protocol | {"repetitions": _REPETITIONS, "countdown_s": _COUNTDOWN_S}
        plan = folder / "protocol.toml"
        plan.write_text(tomli_w.dumps(table), encoding="utf-8")
        speed = self._workspace.speed if is_virtual(url) else speed_of(url)
        request = SessionRequest(url, _NOBODY_YET, str(plan), speed=speed)
        session, _ = session_folder(folder / "recordings", request)
        self._device = self._toys.open(ToyUse(url, "live", self.end), lambda: open_toy(with_speed(url, speed)))
        self._device.try_out()
        head = session_head(request, session, True, self._device.layout, f"plushsense {__version__} studio")
        self.recorder = Recorder(OpenSession(session, head), self._device, speed=speed, auto=_PACE)
        prompt_virtual(self.recorder)
        self.recorder.subscribe(self._follow)
        # The process imports what it needs while the person records, which takes longer than the training.
        spec = {"dry": True, "session": str(session), "place": str(folder)}
        self.job = self._jobs.start("trial", spec, "trial")
        self.recorder.start()

    def _follow(self, change: str, status: RecorderStatus) -> None:
        """React to a change of the recorder, in a thread that must not wait for it."""
        if status.state in ("finished", "stopped") and change in ("finished", "stopped"):
            threading.Thread(target=self._learn, args=(self._folder,), daemon=True).start()
        self.changed.notify()

    def _learn(self, folder: Path | None) -> None:
        """Close the session, let the network learn and start it; end the trial if that fails."""
        with self._lock:
            job, recorder = self.job, self.recorder
            if folder is None or self._folder != folder or job is None or recorder is None:
                return
            status = recorder.status()
            self._close_toy()
            if status.state == "stopped":
                self.end(status.message or Message(status.failed))
                return
            (folder / READY).touch()
            self.state = _LEARNING
        self.changed.notify()
        while job.state == RUNNING:
            time.sleep(_LOOK_S)
        with self._lock:
            if self._folder != folder:
                return
            if job.state != DONE:
                self.end(Message.from_json(job.refusal) if job.refusal else Message("The training was stopped."))
                return
            try:
                self._reader.start(LiveChoice(self._workspace.toy, Path(job.result["bundle"]), reactions=""))
                if self._reader.person is not None:
                    # By themselves, virtual people make all gestures, most of which this network does not know.
                    self._reader.direct("")
            except PlushSenseError as refusal:
                self.end(refusal.message)
                return
            self.state = _LIVE
        self.changed.notify()

    def keep(self, code: str) -> None:
        """Move the session to the recorded ones, as that of the person ``code``, and copy the network to the others.

        Raises:
            PlushSenseError: if there is none to keep, or for an invalid code.
        """
        with self._lock:
            folder = self._folder
            if self.state != _LIVE or folder is None or self.job is None or self.kept:
                raise ConfigError("There are no recordings to keep.")
            (session,) = (folder / "recordings").glob("*/*")
            workspace = self._workspace
            refuse_removed(workspace.recordings, [code])
            place = change_subject(session, code, workspace.recordings)
            bundle, person = Bundle.load(Path(self.job.result["bundle"])), [code]
            origin = {**bundle.provenance, "subjects": person, "validation_subjects": person}
            name = workspace.free_name(BUNDLES, f"trial {place.parent.name}", ".plush", separator=" ")
            replace(bundle, provenance=origin).save(workspace.new(BUNDLES, f"{name}.plush"))
            self.kept = f"{place.parent.name}/{place.name}"
        self.changed.notify()

    def end(self, why: Message | None = None) -> None:
        """End the trial, because of ``why``, and remove its files; do nothing if there is none."""
        with self._lock:
            folder, job = self._folder, self.job
            self._close_toy()
            self._folder = self.job = None
            self.state, self.failed, self.kept = _CHOOSING, why or Message(), ""
            if folder is not None:
                if job is not None:
                    self._jobs.stop(job.id)
                choice = self._reader.choice
                if choice.bundle is not None and folder in choice.bundle.parents:
                    self._reader.stop()
                    self._reader.choose(None, choice.engine, "standard")
                threading.Thread(target=_remove, args=(folder, job), daemon=True).start()
        self.changed.notify()

    def close(self) -> None:
        """End the trial because the studio ends."""
        self.end()

    def _close_toy(self) -> None:
        recorder, device, self.recorder, self._device = self.recorder, self._device, None, None
        if recorder is not None:
            recorder.close()
        if device is not None:
            device.close()


def _remove(folder: Path, job: StudioJob | None) -> None:
    """Remove the files of a trial when its training has ended."""
    while job is not None and job.state == RUNNING:
        time.sleep(_LOOK_S)
    shutil.rmtree(folder, ignore_errors=True)


def show(page: Page, person_panel: Callable[[Page, LiveReader], None]) -> None:
    """Build the page of a trial; ``person_panel`` adds the buttons that direct the person of a virtual toy."""
    trial, reader = page.workspace.part(FirstTrial), page.workspace.part(LiveReader)
    _TrialSection(page, trial)
    live = ui.column().classes("w-full no-wrap")
    feed: Feed | None = None

    def update() -> None:
        nonlocal feed
        live.set_visibility(trial.state == _LIVE)
        if trial.state == _LIVE and feed is None:
            feed = Feed(reader, page.words.error)
            with live:
                view = LiveView(page.words, feed)
                with view:
                    person_panel(page, reader)
                follow(view, feed, reader)

    on_change(trial.changed, update)
    update()
    context.client.on_delete(reader.add_viewer(lambda: trial.state == _RECORDING))


class _TrialSection:
    """Section that leads through a trial: what to do, the recording, the training, and what becomes of it."""

    def __init__(self, page: Page, trial: FirstTrial) -> None:
        self._page, self._words, self._trial = page, page.words, trial
        self._state = ""
        with named(ui.element("section").classes("ps-card w-full column no-wrap ps-small-gap"), self._words(TITLE)):
            heading(self._words(TITLE), 2)
            if page.workspace.part(Toys).simulated or not page.workspace.toy:
                tag(notice(self._words("Simulation: these data say nothing about a real toy.")), "simulation")
            self._box = tag(ui.column().classes("w-full ps-small-gap"), "trial")
        on_change(trial.changed, self._update)
        on_change(page.workspace.part(Jobs).changed, self._update)
        ui.timer(0.2, self._update)
        self._update()

    def _update(self) -> None:
        trial = self._trial
        state = f"{trial.state} {trial.kept} {trial.failed}"
        if state != self._state:
            self._state = state
            self._box.clear()
            with self._box:
                parts = {_CHOOSING: self._choose, _RECORDING: self._record, _LEARNING: self._learn, _LIVE: self._watch}
                parts[trial.state]()
        if trial.state == _RECORDING and trial.recorder is not None:
            self._show(trial.recorder.status())
        if trial.state == _LEARNING and trial.job is not None:
            self._bar.set_value(trial.job.progress.get("share", 0.0))

    def _choose(self) -> None:
        words, labels = self._words, [g.label for g in load_gestures(_SET).gestures if not g.nobody]
        if self._trial.failed:
            tag(notice(words.failure(self._trial.failed), "error"), "trial-failed")
        about = words(
            "The page asks for each gesture {n} times, counts down, and records for {s} seconds. Then a network learns "
            "them and shows what it feels. It takes about two minutes.",
            n=_REPETITIONS,
            s=f"{_PACE.take_s:g}",
        )
        ui.label(about)
        options = {label: words.gesture(label) for label in labels}
        fields = []
        with ui.row().classes("w-full ps-small-gap"):
            for n, label in enumerate(_GESTURES, start=1):
                name = words("Gesture {n}", n=n)
                # Each has options of its own, to which it adds what is typed.
                field = ui.select({**options}, value=label, label=name, with_input=True, new_value_mode="add-unique")
                fields.append(tag(field.classes("ps-wide"), f"gesture-{n}"))
        ui.label(words("Choose from the lists, or type gestures of your own and press Enter.")).classes("ps-note")
        toy = words.toy(self._page.workspace.toy or VIRTUAL)
        ui.label(words("Toy: {toy}", toy=toy)).classes("ps-dim ps-break")

        async def begin() -> None:
            start.set_enabled(False)
            with errors_beside(self._page, fields[-1]):
                await run.io_bound(self._trial.begin, [str(field.value) for field in fields])
            start.set_enabled(True)

        start = button("trial-start", words("Start"), begin, "unelevated size=lg", icon="play_arrow")

    def _record(self) -> None:
        words = self._words
        with ui.column().classes("w-full items-center ps-small-gap").props('role="status"'):
            self._gesture = tag(ui.label().classes("text-h4 text-bold text-center"), "trial-gesture")
            self._now = tag(ui.label().classes("text-h5"), "trial-now")
        self._bar = named(ui.linear_progress(0.0, show_value=False, size="12px").props("rounded"), words("Recordings"))
        with ui.row().classes("ps-small-gap"):
            recorder = self._trial.recorder
            button("trial-redo", words("Record the last one again"), recorder.redo if recorder else None)
            self._add_end(words("Stop"))

    def _show(self, s: RecorderStatus) -> None:
        words = self._words
        count = words("{n} of {m}", n=s.step.repetition, m=s.repetitions)
        self._gesture.set_text(f"{words.gesture(s.step.gesture)} · {count}")
        now = {"recording": words("● Now!"), "countdown": words("In {n} …", n=max(1, math.ceil(s.countdown_s)))}
        self._now.set_text(now.get(s.state, words("Get ready.")))
        self._bar.set_value(s.done / s.steps)

    def _learn(self) -> None:
        with ui.row().classes("items-center ps-small-gap").props('role="status"'):
            ui.spinner(size="1.5em").props("aria-hidden=true")
            ui.label(self._words("The network learns your three gestures. This takes a few seconds."))
        self._bar = named(ui.linear_progress(0.0, show_value=False, size="12px"), self._words("Training"))
        self._add_end(self._words("Stop"))

    def _watch(self) -> None:
        words = self._words
        ui.label(words("Now touch the toy: below is what the network feels.")).classes("text-bold")
        about = words(
            "This network is only for trying: it knows {n} recordings of one person, and nobody has tested it. A good "
            "one needs more people. Unless you keep it, it is removed with the trial.",
            n=_REPETITIONS * len(_GESTURES),
        )
        tag(ui.label(about), "trial-about")
        with ui.row().classes("items-start ps-small-gap"):
            if self._trial.kept:
                kept = words("The recordings are kept as {name}, and the network, too.", name=self._trial.kept)
                tag(ui.label(kept).classes("text-bold"), "trial-kept")
            else:
                free = self._page.workspace.codes().next_free()
                code = tag(ui.input(words("Code of the person"), value=free), "trial-code")

                async def keep() -> None:
                    with errors_beside(self._page, code):
                        await run.io_bound(self._trial.keep, str(code.value or "").strip())

                button("trial-keep", words("Keep recordings and network"), keep)
            self._add_end(words("End the trial"))

    def _add_end(self, label: str) -> None:
        async def end() -> None:
            await run.io_bound(self._trial.end)

        button("trial-end", label, end)
