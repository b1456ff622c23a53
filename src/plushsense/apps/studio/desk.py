"""The sessions that this studio records: begun and taken up here, driven by any page, none of it lost with a page."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from plushsense import __version__
from plushsense.apps.studio.house import VIRTUAL, Bell, House
from plushsense.apps.studio.signals import TappedDevice
from plushsense.core.errors import ConfigError
from plushsense.core.signal import layout_names
from plushsense.core.tomlfile import builtin_names
from plushsense.devices.opening import parse_url
from plushsense.recording.beginning import Wanted, check_speed, head_of, is_pseudo, lacks_consent, layout_of, place
from plushsense.recording.engine import Recorder
from plushsense.recording.session import OpenSession, is_finished
from plushsense.recording.sessionfile import SESSION_HEAD, SessionHead
from plushsense.recording.shelf import Shelved, sessions_in
from plushsense.recording.status import Status, StepStanding
from plushsense.recording.toy import is_virtual, open_toy, prompt_virtual, speed_of, with_speed

PROTOCOLS, LAYOUTS = "protocols", "layouts"
"""Folders in the studio's folder for a user's own."""
NO_CONSENT, PSEUDO = "no_consent", "pseudo"
"""What should be known before anything is recorded: keys of the page's words."""
SOFTWARE = f"plushsense {__version__} studio"


@dataclass
class Sitting:
    """One session that is being recorded.

    Attributes:
        name: ``<subject>/<session>``, as it stands in the page's address.
        notices: `NO_CONSENT`, `PSEUDO`. ``mended``: sentences about what a crash had left.
    """

    name: str
    recorder: Recorder
    device: TappedDevice
    wanted: Wanted
    notices: tuple[str, ...] = ()
    mended: tuple[str, ...] = ()
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def head(self) -> SessionHead:
        """Whose session it is."""
        return self.recorder.session.head

    def status(self) -> Status:
        """This moment."""
        return self.recorder.status()

    def steps(self) -> tuple[StepStanding, ...]:
        """All recordings and what came of each."""
        return self.recorder.steps()

    def press(self, key: str, seen: str) -> bool:
        """Give a command upon what somebody saw; False when that is no longer so: nothing is done then.

        Two pages that press at the same moment, and a press that a slow network held back, are one press.

        Args:
            key: " ", "r", "s", "b", "p" as in the terminal, or ``go:<number of the step>``.
            seen: `plushsense.recording.status.Status.seen` of what was on the screen.

        Raises:
            ConfigError: for a key that is none.
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
                raise ConfigError(f"'{key}' is no command of the recorder.")
            if status.seen != seen:
                return False
            commands[key]()
            return True


class Desk:
    """All sittings of a studio. `bell` rings whenever one of them changes, comes or goes.

    What blocks (`begin`, `resume`, `close_sitting`, `sessions`) is not for an event loop.
    """

    def __init__(self, house: House) -> None:
        self.bell = Bell()
        self._house = house
        self._lock = threading.RLock()
        self._opening = threading.Lock()
        self._sittings: dict[str, Sitting] = {}

    def sittings(self) -> list[Sitting]:
        """What is being recorded now."""
        with self._lock:
            return list(self._sittings.values())

    def get(self, name: str) -> Sitting | None:
        """The sitting of this name; None where it is not open here."""
        with self._lock:
            return self._sittings.get(name)

    def sessions(self) -> list[Shelved]:
        """All sessions in the studio's folder, the newest first."""
        return sessions_in(self._house.recordings)

    def begin(self, wanted: Wanted, anew: bool = False) -> Sitting:
        """Begin a session, or give the one of this person that is open.

        Args:
            anew: begin another one although the person's last is unfinished.

        Raises:
            PlushSenseError: what the recorder or the toy refuses; also when the last one is unfinished.
        """
        self._check(wanted)
        with self._opening:
            folder, known = place(self._house.recordings, wanted, new=anew)
            sitting = self._beside(wanted, folder.parent.name)
            if sitting is not None:
                return sitting
            if known is not None:
                raise ConfigError(
                    f"{folder.parent.name} has an unfinished session, {folder.name}: go on with it, or say that "
                    "another one is to be begun."
                )
            return self._sit(wanted, folder, None)

    def _beside(self, wanted: Wanted, subject: str) -> Sitting | None:
        """The person's sitting, where a second tab begins at the same moment; one that is over makes way."""
        for sitting in self.sittings():
            over = sitting.status().state in ("finished", "stopped")
            if over and (sitting.head.subject == subject or sitting.wanted.device == wanted.device):
                self._end(sitting)
            elif sitting.head.subject == subject:
                return sitting
        return None

    def resume(self, name: str, device: str = "") -> Sitting:
        """Go on with an unfinished session, or give it where it is open.

        Args:
            device: the toy's URL; "": the one that it was begun with.

        Raises:
            PlushSenseError: what the recorder or the toy refuses.
        """
        folder = self._folder(name)
        with self._opening:
            sitting = self.get(name)
            if sitting is not None:
                return sitting
            known = SessionHead.read(folder)
            if known is None:
                raise ConfigError(f"There is no session '{name}' in '{self._house.recordings}'.")
            if is_finished(folder):
                raise ConfigError(f"The session '{name}' is finished: begin a new one.")
            url = device or known.device
            wanted = Wanted(device=url, subject=known.subject, speed=self.speed_for(url, known.simulated))
            self._check(wanted, known.device)
            return self._sit(wanted, folder, known)

    def close_sitting(self, name: str) -> None:
        """End a session's work for now; a recording that runs is broken off, all else is kept. Twice is harmless."""
        with self._opening:
            with self._lock:
                sitting = self._sittings.get(name)
            if sitting is not None:
                self._end(sitting)

    def _end(self, sitting: Sitting) -> None:
        sitting.recorder.close()
        sitting.device.close()
        with self._lock:
            self._sittings.pop(sitting.name, None)
        self.bell.ring()

    def close(self) -> None:
        """End all."""
        for sitting in self.sittings():
            self.close_sitting(sitting.name)

    # What may be chosen ---------------------------------------------------------------------------------------

    def speed_for(self, url: str, simulated: bool) -> float:
        """Times real time at which a toy runs in this studio; a real toy runs in real time."""
        if not simulated and not is_virtual(url):
            return speed_of(url)
        return speed_of(url) if "speed" in parse_url(url).query else self._house.speed

    def toys(self) -> list[str]:
        """Toys to choose from: the chosen one, those named at start, the virtual one."""
        return list(dict.fromkeys(u for u in (self._house.toy, *self._house.devices, VIRTUAL) if u))

    def protocols(self) -> dict[str, str]:
        """What may be recorded: the name or path of a protocol, and how it is called."""
        own = self._house.folder / PROTOCOLS
        return {n: n for n in sorted(builtin_names("protocols"), key=lambda n: (n != "plush-17", n))} | {
            str(p): p.name for p in sorted(own.glob("*.toml"))
        }

    def layouts(self) -> dict[str, str]:
        """Firmware that may be chosen: the name or path of a layout, and how it is called."""
        own = self._house.folder / LAYOUTS
        return {n: n for n in layout_names()} | {str(p): p.name for p in sorted(own.glob("*.toml"))}

    def _check(self, wanted: Wanted, known_device: str = "") -> None:
        """A browser may name toys and this studio's own files, but no file elsewhere."""
        check_speed(wanted.speed)
        if wanted.protocol and wanted.protocol not in self.protocols():
            raise ConfigError(f"'{wanted.protocol}' is no protocol of this studio: choose one that is listed.")
        if wanted.layout and wanted.layout not in self.layouts():
            raise ConfigError(f"'{wanted.layout}' is no layout of this studio: choose one that is listed.")
        address = parse_url(wanted.device)
        given = wanted.device in (*self.toys(), known_device)
        strange = address.scheme == "replay" or address.query.get("layout", "plush-15") not in self.layouts()
        if strange and not given:
            raise ConfigError(
                f"'{wanted.device}' names a file: start the studio with --device {wanted.device} to record from it."
            )

    def _folder(self, name: str) -> Path:
        folder = self._house.inside(self._house.recordings / name)
        if folder.parent.parent != self._house.recordings or not (folder / SESSION_HEAD).is_file():
            raise ConfigError(f"There is no session '{name}' in '{self._house.recordings}'.")
        return folder

    def _sit(self, wanted: Wanted, folder: Path, known: SessionHead | None) -> Sitting:
        layout = layout_of(wanted, folder, known)
        device = TappedDevice(open_toy(with_speed(wanted.device, wanted.speed), layout))
        try:
            head = head_of(wanted, folder, known is None, device.layout, SOFTWARE)
            said = ((PSEUDO, is_pseudo(wanted, known or head)), (NO_CONSENT, lacks_consent(known or head)))
            session = OpenSession(folder, head)
            try:
                recorder = Recorder(session, device, speed=wanted.speed, software=SOFTWARE)
                prompt_virtual(recorder)
                recorder.listen(lambda _what, _status: self.bell.ring())
                recorder.start()
            except BaseException:
                session.close()
                raise
        except BaseException:
            device.close()
            raise
        sitting = Sitting(
            _name(folder),
            recorder,
            device,
            replace(wanted, subject=head.subject),
            tuple(key for key, true in said if true),
            tuple(session.standing.mended),
        )
        with self._lock:
            self._sittings[sitting.name] = sitting
        self.bell.ring()
        return sitting


def _name(folder: Path) -> str:
    return f"{folder.parent.name}/{folder.name}"
