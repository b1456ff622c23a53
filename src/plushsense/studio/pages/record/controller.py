"""Manage the recording sessions of a studio, which any page can start, resume and control."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from plushsense.core.errors import ConfigError, DatasetError, LayoutError, PlushSenseError
from plushsense.core.layouts import Layout, layout_names
from plushsense.core.sentences import Message
from plushsense.core.toml import builtin_names
from plushsense.core.version import __version__
from plushsense.devices.lsl import MARKERS, LslMarkers
from plushsense.devices.opening import is_virtual, parse_url, speed_of, with_speed
from plushsense.devices.virtual.stream import VirtualDevice
from plushsense.recording.plan import save_protocol
from plushsense.recording.recorder import Recorder, open_toy, prompt_virtual, send_markers
from plushsense.recording.session import (
    OpenSession,
    SessionRequest,
    SessionSummary,
    change_subject,
    check_speed,
    is_finished,
    is_pseudo_terminal,
    lacks_consent,
    list_sessions,
    mark_finished,
    session_folder,
    session_head,
    session_layout,
)
from plushsense.recording.writer import SESSION_HEAD, SessionHead
from plushsense.studio.app.toys import TappedDevice, Toys, ToyUse
from plushsense.studio.app.workspace import PROTOCOLS, VIRTUAL, ChangeSignal, Workspace

LAYOUTS = "layouts"
"""Folder of the workspace for the user's own layouts."""
NO_CONSENT, PSEUDO = "no_consent", "pseudo"
"""Notices shown before recording; each is the key of a text in the table ``record``."""
SOFTWARE = f"plushsense {__version__} studio"


@dataclass
class ActiveSession:
    """A session that is being recorded.

    Attributes:
        name: ``<subject>/<session>``, as used in the address of the page.
        notices: those of `NO_CONSENT` and `PSEUDO` that apply.
        repairs: descriptions of repairs made to the files after a crash.
        mark_first: whether the first countdown is to mark the moment for a video.
        markers: LSL stream of the markers of its recordings, None for none.
    """

    name: str
    recorder: Recorder
    device: TappedDevice
    request: SessionRequest
    notices: tuple[str, ...] = ()
    repairs: tuple[Message, ...] = ()
    mark_first: bool = False
    markers: LslMarkers | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def head(self) -> SessionHead:
        """The session's metadata."""
        return self.recorder.session.head

    @property
    def ended(self) -> bool:
        """Whether all is recorded, or the toy is gone."""
        return self.recorder.status().state in ("finished", "stopped")

    def press(self, key: str, seen: str) -> bool:
        """Run a command, but only if the status is still the displayed one; return whether it was run.

        This way, simultaneous presses on two pages run only one command, and a delayed press runs none.

        Args:
            key: " ", "r", "s", "b" or "p" as in the terminal recorder, or ``go:<number of the step>``.
            seen: `plushsense.recording.status.RecorderStatus.seen` of the status that the page displayed.

        Raises:
            ConfigError: for an unknown command.
        """
        recorder = self.recorder
        with self._lock:
            status = recorder.status()
            commands: dict[str, Callable[[], None]] = {
                " ": recorder.space,
                "r": recorder.redo,
                "s": recorder.skip,
                "b": recorder.back,
                "p": recorder.resume if status.state == "paused" else recorder.pause,
            }
            number = key.removeprefix("go:")
            if number != key and number.isdecimal() and int(number) < status.steps:
                commands[key] = lambda: recorder.go(int(number))
            if key not in commands:
                raise ConfigError("The key {key} is no command here.", key=key)
            if status.seen != seen:
                return False
            commands[key]()
            return True


class RecordController:
    """Service that starts, resumes and ends recording sessions; any change of one notifies `changed`.

    `begin`, `resume`, `close_session` and `sessions` block: do not call them in the event loop.
    """

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self._workspace = workspace
        self._lock = threading.RLock()
        # Opening a toy may end another session, whose toy nobody is using any more.
        self._opening = threading.RLock()
        self._toys = workspace.part(Toys)
        self._active: dict[str, ActiveSession] = {}

    def active_sessions(self) -> list[ActiveSession]:
        """Return the sessions that are open now."""
        with self._lock:
            return list(self._active.values())

    def get(self, name: str) -> ActiveSession | None:
        """Return the active session with this name, or None."""
        with self._lock:
            return self._active.get(name)

    def sessions(self) -> list[SessionSummary]:
        """Return all sessions in the studio's folder, newest first."""
        return list_sessions(self._workspace.recordings)

    def begin(
        self, request: SessionRequest, anew: bool = False, mark_first: bool = False, lsl: bool = False
    ) -> ActiveSession:
        """Start a session, or return the active session of the same person.

        Args:
            anew: whether to start another session even if the last one of the person is unfinished.
            mark_first: see `ActiveSession`.
            lsl: whether to send the markers of the recordings by LSL.

        Raises:
            PlushSenseError: if the request is invalid, the toy cannot be opened, or the last session is unfinished.
        """
        self._check(request)
        with self._opening:
            person = session_folder(self._workspace.recordings, request, new=anew)[0].parent
            session = self._active_of(request, person.name)
            if session is not None:
                return session
            # Again, as the end of a session of this person may have written what it was waiting to write.
            folder, known = session_folder(self._workspace.recordings, request, new=anew)
            if known is not None:
                raise ConfigError(
                    "{subject} has an unfinished session, {name}. Continue it above, or choose a new session under "
                    "“More settings”.",
                    subject=folder.parent.name,
                    name=f"{folder.parent.name}/{folder.name}",
                    field="person",
                )
            session = self._open(request, folder, None, lsl)
            session.mark_first = mark_first
            return session

    def _active_of(self, request: SessionRequest, subject: str) -> ActiveSession | None:
        """Return the active session of ``subject``, if any; first end finished ones of this person or toy."""
        for session in self.active_sessions():
            if session.ended and (session.head.subject == subject or session.request.device == request.device):
                self._end(session)
            elif session.head.subject == subject:
                return session
        return None

    def resume(self, name: str, device: str = "") -> ActiveSession:
        """Resume an unfinished session, or return it if it is already active.

        Args:
            device: the URL of the toy, by default the one with which the session was started.

        Raises:
            PlushSenseError: if the session cannot be resumed, or the toy cannot be opened.
        """
        folder = self._folder(name)
        with self._opening:
            session = self.get(name)
            if session is not None:
                return session
            known = SessionHead.read(folder)
            if known is None:
                raise self._unknown(name)
            if is_finished(folder):
                raise ConfigError("The session {name} is finished. Begin a new one.", name=name)
            url = device or known.device
            request = SessionRequest(device=url, subject=known.subject, speed=self.speed_for(url, known.simulated))
            self._check(request, known.device)
            return self._open(request, folder, known)

    def finish(self, name: str, finished: bool = True) -> None:
        """Mark a session as finished although steps are missing, or take that back.

        Raises:
            PlushSenseError: for an unknown session, or one that is being recorded.
        """
        with self._opening:
            mark_finished(self._closed(name), finished)
        self.changed.notify()

    def rename_person(self, name: str, code: str) -> str:
        """Give a session to the person ``code``, and return its new name.

        Raises:
            PlushSenseError: for an unknown session, one that is being recorded, or an invalid code.
        """
        with self._opening:
            place = change_subject(self._closed(name), code)
        self.changed.notify()
        return f"{place.parent.name}/{place.name}"

    def discard(self, name: str) -> Path:
        """Move a session to the discarded files (`Workspace.discard`), and return its folder there.

        Raises:
            PlushSenseError: for an unknown session, or one that is being recorded.
        """
        with self._opening:
            place = self._workspace.discard(self._closed(name))
        self.changed.notify()
        return place

    def _closed(self, name: str) -> Path:
        """Return the folder of a session; raise ConfigError if it is open."""
        if self.get(name) is not None:
            raise ConfigError("The session {name} is being recorded. End it first.", name=name)
        return self._folder(name)

    def close_session(self, name: str) -> None:
        """Close a session and discard only the recording in progress; do nothing if it is closed already."""
        with self._opening:
            if (session := self.get(name)) is not None:
                self._end(session)

    def _end(self, session: ActiveSession) -> None:
        session.recorder.close()
        session.device.close()
        if session.markers is not None:
            session.markers.close()
        with self._lock:
            self._active.pop(session.name, None)
        self._changed()

    def _changed(self) -> None:
        """Notify `changed`, and update which toys are in use."""
        self._toys.update_uses()
        self.changed.notify()

    def close(self) -> None:
        """Close all active sessions."""
        for session in self.active_sessions():
            self.close_session(session.name)

    # Choices --------------------------------------------------------------------------------------------------

    def speed_for(self, url: str, simulated: bool) -> float:
        """Return the speed of a toy as a multiple of real time, which is 1 for a real toy."""
        if not simulated and not is_virtual(url):
            return speed_of(url)
        return speed_of(url) if "speed" in parse_url(url).query else self._workspace.speed

    def toys(self) -> list[str]:
        """Return the URLs of the toys to choose from: the chosen one, those given at start, and the virtual one."""
        return list(dict.fromkeys(u for u in (self._workspace.toy, *self._workspace.devices, VIRTUAL) if u))

    def protocols(self) -> dict[str, str]:
        """Return the protocols to choose from; keys are names or paths, values are titles."""
        names = sorted(builtin_names("protocols"), key=lambda n: (n != "plush-17", n))
        return {n: n for n in names} | self._own_files(PROTOCOLS)

    def layouts(self) -> dict[str, str]:
        """Return the layouts to choose from; keys are names or paths, values are titles."""
        return {n: n for n in layout_names()} | self._own_files(LAYOUTS)

    def save_protocol(self, name: str, gestures: Sequence[str], repetitions: int, order: str) -> Path:
        """Save a protocol of one's own, and return its path.

        Raises:
            ConfigError: for a name that cannot be used or exists, without gestures, or for invalid repetitions.
        """
        place = self._workspace.new(PROTOCOLS, f"{name.strip()}.toml" if name.strip() else "")
        save_protocol(place, place.stem, gestures, repetitions, order)
        return place

    def _own_files(self, folder: str) -> dict[str, str]:
        return {str(p): p.stem for p in sorted((self._workspace.folder / folder).glob("*.toml"))}

    def _check(self, request: SessionRequest, known_device: str = "") -> None:
        """Raise ConfigError if the toy, protocol or layout is unknown or refers to a file that was not allowed."""
        check_speed(request.speed)
        if request.protocol and request.protocol not in self.protocols():
            raise ConfigError("This list of gestures is gone. Choose another one.", field="protocol")
        if request.layout and request.layout not in self.layouts():
            raise ConfigError("This sensor layout is gone. Choose another one.")
        self._check_toy(request.device, known_device)

    def _check_toy(self, url: str, *known: str) -> None:
        """Raise ConfigError if a toy's URL is invalid, or refers to a file that was not allowed."""
        address = parse_url(url)
        given = url in (*self.toys(), *known)
        is_file = address.scheme == "replay" or address.query.get("layout", "plush-15") not in self.layouts()
        if is_file and not given:
            raise ConfigError(
                "{url} is a file. The studio reads only files that were given to it when it was started.", url=url
            )

    def _folder(self, name: str) -> Path:
        folder = self._workspace.inside(self._workspace.recordings / name)
        if folder.parent.parent != self._workspace.recordings or not (folder / SESSION_HEAD).is_file():
            raise self._unknown(name)
        return folder

    def _unknown(self, name: str) -> ConfigError:
        return ConfigError("There is no session {name}.", name=name)

    def _tried(self, name: str, url: str, speed: float, layout: Layout | str | None) -> TappedDevice:
        """Open a toy for the session ``name``, and wait until it has sent frames.

        Raises:
            DeviceError: if the toy cannot be opened, or sends no frames of the layout.
        """
        try:
            use = ToyUse(url, "record", partial(self._stop_for_others, name), name, partial(self._is_busy, name))
            device = self._toys.open(use, lambda: open_toy(with_speed(url, speed), layout))
        except LayoutError:
            raise LayoutError("The sensor layout “{name}” cannot be read. Choose another one.", name=layout) from None
        if isinstance(device.inner, VirtualDevice):
            # Its person waits for what is requested.
            device.inner.follow()
        try:
            device.try_out()
        except BaseException:
            device.close()
            raise
        with contextlib.suppress(PlushSenseError):  # a file that only this session may read
            self._toys.choose(url)
        return device

    def _is_busy(self, name: str) -> bool:
        """Return whether a session is being opened or recorded."""
        session = self.get(name)
        return session is None or not session.ended

    def _stop_for_others(self, name: str) -> None:
        """Close a session, because its toy is needed elsewhere; raise ConfigError during a recording."""
        session = self.get(name)
        if session is not None and session.recorder.status().state in ("countdown", "recording", "saving"):
            raise ConfigError("The session {name} is recording a gesture just now. Stop that first.", name=name)
        self.close_session(name)

    def exchange(self, name: str, url: str) -> None:
        """Go on with another toy of the same layout in an active session; the former one stays if this fails.

        Raises:
            PlushSenseError: if there is no such session, it is recording, or the toy cannot be used.
        """
        with self._opening:
            session = self.get(name)
            if session is None:
                raise self._unknown(name)
            recorder, former = session.recorder, session.device
            self._check_toy(url, session.head.device)
            if is_virtual(url) and not session.head.simulated:
                raise DatasetError(
                    "The session {name} was begun with a real toy. A virtual toy needs a new session.",
                    name=name,
                    field="toy",
                )
            if self.speed_for(url, session.head.simulated) != session.request.speed:
                raise ConfigError("{url} runs at another speed than this session.", url=url)
            if url == session.request.device:
                if recorder.status().state != "stopped":
                    raise ConfigError("The session uses this toy already. Choose another one.")
                # A port can be opened only once.
                former.close()
            device = self._tried(name, url, session.request.speed, recorder.session.layout)
            try:
                recorder.exchange(device)
            except BaseException:
                device.close()
                raise
            session.device, session.request = device, replace(session.request, device=url)
            prompt_virtual(recorder)
            former.close()
        self._changed()

    def _open(
        self, request: SessionRequest, folder: Path, known: SessionHead | None, lsl: bool = False
    ) -> ActiveSession:
        layout = session_layout(request, folder, known)
        name = f"{folder.parent.name}/{folder.name}"
        device = self._tried(name, request.device, request.speed, layout)
        try:
            head = session_head(request, folder, known is None, device.layout, SOFTWARE)
            notices = ((PSEUDO, is_pseudo_terminal(request, known or head)), (NO_CONSENT, lacks_consent(known or head)))
            markers = LslMarkers(MARKERS) if lsl else None
            files = OpenSession(folder, head)
            try:
                recorder = Recorder(files, device, speed=request.speed, software=SOFTWARE)
                prompt_virtual(recorder)
                if markers is not None:
                    send_markers(recorder, markers.push)
                recorder.subscribe(lambda _what, _status: self._changed())
                recorder.start()
            except BaseException:
                files.close()
                raise
        except BaseException:
            device.close()
            raise
        session = ActiveSession(
            name,
            recorder,
            device,
            replace(request, subject=head.subject),
            tuple(key for key, applies in notices if applies),
            tuple(files.progress.repairs),
            markers=markers,
        )
        with self._lock:
            self._active[session.name] = session
        self._changed()
        return session
