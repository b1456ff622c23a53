"""Running the studio: its pages, its guard, its address."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from filelock import FileLock, Timeout

from plushsense.apps.studio.guard import TOKEN, Guard, Visitors, is_loopback
from plushsense.apps.studio.house import WORK, House
from plushsense.core.errors import ConfigError
from plushsense.core.extras import need

PORT = 8137
_OPENING_S = 30.0
_EVERYWHERE = ("0.0.0.0", "::")
_ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><g fill="#b07a4a"><circle cx="8" cy="8" r="5"/>'
    '<circle cx="24" cy="8" r="5"/><circle cx="16" cy="18" r="12"/></g><circle cx="11.5" cy="16" r="1.8"/>'
    '<circle cx="20.5" cy="16" r="1.8"/><ellipse cx="16" cy="21" rx="3" ry="2"/></svg>'
)


def run(
    house: House,
    *,
    host: str = "127.0.0.1",
    port: int | None = None,
    names: tuple[str, ...] = (),
    show: bool = True,
    told: Callable[[str], None],
) -> None:
    """Serve a house until it is interrupted.

    Args:
        host: where to listen; any other than 127.0.0.1 asks visitors for a token.
        port: `PORT`, or the next free one, by default; 0: any.
        names: further names under which browsers may call the machine.
        show: whether to open a browser.
        told: called with the address when it answers.

    Raises:
        MissingExtraError: without the extra ``studio``.
        ConfigError: for an address that cannot be listened on, and a folder that another studio serves.
    """
    need("nicegui", "studio")
    # NiceGUI would keep things in the working directory, or far away: we keep none there, and it shall not begin to.
    os.environ["NICEGUI_STORAGE_PATH"] = str(house.folder / WORK / "nicegui")
    os.environ.pop("NICEGUI_REDIS_URL", None)
    from nicegui import app, ui

    from plushsense.apps.studio.downloads import router
    from plushsense.apps.studio.shell import PAGES

    alone = _alone(house)
    port = _free_port(host, port)
    for name, path in PAGES.items():
        ui.page(path, response_timeout=30.0)(_page(house, name))
    app.include_router(router(house))
    everywhere = host in _EVERYWHERE
    if everywhere:
        names = (*names, socket.gethostname(), *_addresses())
    visitors = Visitors(host, names)
    inner: Any = app.build_middleware_stack
    # Outermost, also around what answers when something failed: middleware that is added stands within NiceGUI's own.
    vars(app)["build_middleware_stack"] = lambda: Guard(inner(), visitors)
    shown = (_addresses() or [socket.gethostname()])[0] if everywhere else host
    address = f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/"
    if not visitors.open:
        house.invite = lambda: f"{address}?{TOKEN}={visitors.invite()}"

    def tell() -> None:
        # Whoever is told may come at once, and start-up ends before the port is open.
        _wait_open(shown, port)
        told(house.invite() if house.invite else address)

    # At the end NiceGUI's own loops may miss that they are to stop; that is nothing for people.
    logging.getLogger("nicegui").addFilter(lambda record: "Could not cancel" not in str(record.msg))
    # A bar that nobody has named, for screen readers, at every request.
    app.config.quasar_config["loadingBar"] = {"skipHijack": True}
    app.on_startup(lambda: threading.Thread(target=tell, daemon=True).start())
    app.on_shutdown(house.close)
    ui.run(
        host=host,
        port=port,
        title="PlushSense",
        favicon=_ICON,
        show=show and visitors.open,
        reload=False,
        show_welcome_message=False,
        reconnect_timeout=10.0,
        uvicorn_logging_level="error",
    )
    if alone is not None:
        alone.release()


def _alone(house: House) -> FileLock | None:
    """A lock on the folder, held until this process ends: two studios would each take the other's work for left over.

    Raises:
        ConfigError: when another studio has it.
    """
    lock = FileLock(house.folder / WORK / "studio.lock", timeout=0)
    try:
        (house.folder / WORK).mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        raise ConfigError(
            f"A studio is open on '{house.folder}' already: use that one, or give another folder with --home."
        ) from None
    except (OSError, NotImplementedError):
        # Where nothing can be written there is nothing to keep apart.
        return None
    return lock


def _page(house: House, name: str) -> Callable[[], Any]:
    """The function that builds a page, whose module is imported when somebody first looks."""

    async def build() -> None:
        from plushsense.apps.studio.shell import frame

        module = importlib.import_module(f"plushsense.apps.studio.pages.{name}")
        with frame(house, name) as page:
            built = module.show(page)
            if inspect.isawaitable(built):
                await built

    return build


def _free_port(host: str, port: int | None) -> int:
    """The port itself where it is free; of the default, the next free one.

    Raises:
        ConfigError: for an address that is taken, or not this machine's.
    """
    for tried in (port,) if port is not None else range(PORT, PORT + 20):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
            if os.name == "posix":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, tried))
                return int(probe.getsockname()[1])
            except (OSError, OverflowError) as cause:
                why = str(getattr(cause, "strerror", None) or cause)
    raise ConfigError(f"The studio cannot listen on {host}, port {port or PORT}: {why}. Give another --port or --host.")


def _wait_open(host: str, port: int) -> None:
    for _ in range(int(_OPENING_S / 0.05)):
        with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=1.0):
            return
        time.sleep(0.05)


def _addresses() -> list[str]:
    """This machine's addresses on its network, found without sending anything."""
    found = []
    with contextlib.suppress(OSError):
        found = [str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        # A connected datagram socket knows its own address; no packet leaves.
        probe.connect(("192.0.2.1", 9))
        found.insert(0, str(probe.getsockname()[0]))
    return list(dict.fromkeys(a for a in found if not is_loopback(a)))
