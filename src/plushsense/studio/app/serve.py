"""Run the studio's web server: register the pages, control access and choose the address."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import importlib
import inspect
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from plushsense.core.errors import ConfigError, need
from plushsense.studio.app.connections import ConnectionLimits, drop_slow_clients, limited_protocol
from plushsense.studio.app.guard import HEAD_BYTES, TOKEN, Guard, Visitors, is_loopback, mark_scripts
from plushsense.studio.app.workspace import WORK, Workspace

PORT = 8137
_OPENING_S = 30.0
_COLLECT_S = 10.0
_LOOK_S = 1.0
_ICONS = Path(__file__).with_name("icons.js")
# Announce a lost connection to screen readers.
_ALERTS = "document.querySelectorAll('.nicegui-error-popup').forEach(box => box.setAttribute('role', 'alert'));\n"
# Imported by NiceGUI's socket library for clients: 15 MB that a server does not need.
_CLIENTS = ("aiohttp", "requests")
# Parameters of `mallopt` in malloc.h of glibc.
_M_TRIM_THRESHOLD, _M_ARENA_MAX = -1, -8
_EVERYWHERE = ("0.0.0.0", "::")
_ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><g fill="#b07a4a"><circle cx="8" cy="8" r="5"/>'
    '<circle cx="24" cy="8" r="5"/><circle cx="16" cy="18" r="12"/></g><circle cx="11.5" cy="16" r="1.8"/>'
    '<circle cx="20.5" cy="16" r="1.8"/><ellipse cx="16" cy="21" rx="3" ry="2"/></svg>'
)


def run(
    workspace: Workspace,
    *,
    host: str = "127.0.0.1",
    port: int | None = None,
    names: tuple[str, ...] = (),
    show: bool = True,
    on_ready: Callable[[str], None],
) -> None:
    """Serve a workspace until interrupted.

    Args:
        host: address to listen on; if it is not a loopback address, visitors need a token.
        port: port to listen on; by default the first free one from `PORT`, and 0 lets the system choose.
        names: further host names under which browsers may reach this computer.
        show: whether to open a browser.
        on_ready: called with the address as soon as the server accepts connections.

    Raises:
        MissingExtraError: without the extra ``studio``.
        ConfigError: if the server cannot listen on the address, or another studio serves the folder.
    """
    _limit_heaps()
    # By default, NiceGUI stores files in the working directory or in Redis.
    os.environ["NICEGUI_STORAGE_PATH"] = str(workspace.folder / WORK / "nicegui")
    os.environ.pop("NICEGUI_REDIS_URL", None)
    with _without_clients():
        need("nicegui", "studio")
        from nicegui import app

    lock = _lock_folder(workspace)
    port = _free_port(host, port)
    everywhere = host in _EVERYWHERE
    if everywhere:
        names = (*names, socket.gethostname(), *_addresses())
    visitors = Visitors(host, names)
    host_name = (_addresses() or [socket.gethostname()])[0] if everywhere else host
    address = f"http://{f'[{host_name}]' if ':' in host_name else host_name}:{port}/"
    if not visitors.open:
        workspace.invite = lambda: f"{address}?{TOKEN}={visitors.invite()}"

    def announce() -> None:
        # The callback may open a browser at once, but NiceGUI calls the start-up handlers before the port is open.
        _wait_open(host_name, port)
        on_ready(workspace.invite() if workspace.invite else address)

    _configure(workspace, visitors)
    app.on_startup(lambda: threading.Thread(target=announce, daemon=True).start())
    _listen(host, port, show and visitors.open)
    if lock is not None:
        lock.release()


def _listen(host: str, port: int, show: bool) -> None:
    """Run the web server until it is interrupted."""
    from nicegui import ui

    limits = ConnectionLimits.of_process()
    ui.run(
        host=host,
        port=port,
        title="PlushSense",
        favicon=_ICON,
        show=show,
        reload=False,
        tailwind=False,
        show_welcome_message=False,
        reconnect_timeout=10.0,
        uvicorn_logging_level="error",
        http=limited_protocol(limits),
        timeout_keep_alive=limits.keep_alive_s,
        backlog=limits.backlog,
        h11_max_incomplete_event_size=HEAD_BYTES,
    )


def _configure(workspace: Workspace, visitors: Visitors) -> None:
    """Add the pages, the guard and the tasks of the studio to NiceGUI's application."""
    from nicegui import app, ui
    from nicegui.client import templates

    from plushsense.studio.app.guard import router
    from plushsense.studio.app.shell import PAGES

    for name, path in PAGES.items():
        ui.page(path, response_timeout=30.0)(_page(workspace, name))
    app.include_router(router(workspace))
    inner: Any = app.build_middleware_stack
    # The guard must be the outermost layer, even around error responses; app.add_middleware would put it further in.
    vars(app)["build_middleware_stack"] = lambda: Guard(inner(), visitors)
    # NiceGUI warns about its own tasks that are still running at shutdown; users cannot act on that.
    logging.getLogger("nicegui").addFilter(lambda record: "Could not cancel" not in str(record.msg))
    mark_scripts(templates.env, "index.html")
    # Switch off Quasar's loading bar, because it has no accessible name.
    app.config.quasar_config["loadingBar"] = {"skipHijack": True}
    app.config.vue_config_script = _ALERTS + _ICONS.read_text(encoding="utf-8") + app.config.vue_config_script
    app.on_startup(_watch_clients)
    app.on_delete(_release_memory())
    app.on_shutdown(workspace.close)


@contextlib.contextmanager
def _without_clients() -> Iterator[None]:
    """Hide the packages in `_CLIENTS` from the imports in the block."""
    hidden = [name for name in _CLIENTS if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


def _limit_heaps() -> None:
    """Let all threads share two heaps where the C library is glibc, whose heap for each thread cost 16 MB in all."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_ARENA_MAX, 2)
        mallopt(_M_TRIM_THRESHOLD, 1 << 17)


def _release_memory() -> Callable[[], None]:
    """Return a function to call when a page was left, which soon frees the memory of all pages that were left.

    A page is a circle of references, which Python finds too rarely: 10 MB more after 70 pages.
    """
    scheduled = False

    def collect() -> None:
        nonlocal scheduled
        scheduled = False
        gc.collect()
        with contextlib.suppress(OSError, AttributeError, TypeError):
            ctypes.CDLL(None).malloc_trim(0)

    def release() -> None:
        nonlocal scheduled
        # Pages may also be deleted while the server ends, without a running loop.
        with contextlib.suppress(RuntimeError):
            if not scheduled:
                asyncio.get_running_loop().call_later(_COLLECT_S, collect)
                scheduled = True

    return release


async def _watch_clients() -> None:
    """Drop the clients for which too many messages wait, every `_LOOK_S`."""
    from nicegui import core

    while True:
        await asyncio.sleep(_LOOK_S)
        await drop_slow_clients(core.sio.eio)


def _lock_folder(workspace: Workspace) -> FileLock | None:
    """Lock the folder until this process ends, because a second studio would remove the unfinished work of the first.

    Raises:
        ConfigError: if another studio serves the folder.
    """
    lock = FileLock(workspace.folder / WORK / "studio.lock", timeout=0)
    try:
        (workspace.folder / WORK).mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        raise ConfigError(
            f"A studio is already running in '{workspace.folder}': use that one, or give another folder with --home.",
        ) from None
    except (OSError, NotImplementedError):
        # A read-only folder needs no lock.
        return None
    return lock


def _page(workspace: Workspace, name: str) -> Callable[[], Any]:
    """Return a function that builds the page ``name``; it imports the module of the page on the first visit."""

    async def build() -> None:
        from nicegui import context

        from plushsense.studio.app.shell import frame

        module = importlib.import_module(f"plushsense.studio.pages.{name}.{name}_page")
        task = asyncio.current_task()
        assert task is not None
        # Stop building a page that was left meanwhile: the elements to which it would add others are deleted.
        context.client.on_delete(lambda: task.cancel())
        with frame(workspace, name) as page:
            built = module.show(page)
            if inspect.isawaitable(built):
                await built

    return build


def _free_port(host: str, port: int | None) -> int:
    """Return ``port`` if it is free; for None, return the first free port from `PORT`.

    Raises:
        ConfigError: if the port is in use, or ``host`` is not an address of this computer.
    """
    for candidate in (port,) if port is not None else range(PORT, PORT + 20):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
            if os.name == "posix":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, candidate))
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
    """Return the network addresses of this computer, without sending a packet."""
    addresses = []
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        # Connecting a datagram socket sends no packet but selects the local address.
        probe.connect(("192.0.2.1", 9))
        addresses.append(str(probe.getsockname()[0]))
    with contextlib.suppress(OSError):
        addresses += [str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    return list(dict.fromkeys(a for a in addresses if not is_loopback(a)))
