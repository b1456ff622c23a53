"""Control access to the studio: admit local requests or those with a one-time token; forbid content from elsewhere.

`Guard` wraps the whole application, including NiceGUI's own routes and its websocket.
"""

from __future__ import annotations

import hmac
import io
import ipaddress
import secrets
import zipfile
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs, quote, urlsplit

from fastapi import APIRouter
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse, RedirectResponse, Response
from jinja2 import ChoiceLoader, DictLoader, Environment
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from plushsense.core.errors import ConfigError
from plushsense.dataset.files import list_package_files
from plushsense.dataset.importing.archives import zip_entry
from plushsense.studio.app.workspace import BACKUPS, EXPORTS, PACKAGES, Workspace

COOKIE = "plushsense_visitor"
TOKEN = "token"
WELCOME = "welcome"
UPLOAD_BYTES = 501_000_000
"""Maximum size of the body of an upload, in bytes."""
BODY_BYTES = 4_000_000
"""Maximum size of the body of any other request, in bytes."""
HEAD_BYTES = 65_536
"""Maximum size of the head of a request (request line and headers), in bytes."""
_UNANSWERED = "No response returned"
"""Part of Starlette's error message when a browser disconnected before the response was ready."""
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]", "::1")

# Nothing is loaded from elsewhere. NiceGUI's Vue templates are compiled in the browser, which needs eval.
CONTENT_POLICY = (
    "default-src 'self'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'none'"
)
"""Content security policy; a page's own inline scripts have the ``nonce`` of its response, and no others run."""
NONCE = "plushsense.nonce"
"""Key of the nonce in the scope of a request, see `mark_scripts`."""


def _security_headers(nonce: str) -> list[tuple[bytes, bytes]]:
    return [
        (b"content-security-policy", CONTENT_POLICY.format(nonce=nonce).encode()),
        (b"x-content-type-options", b"nosniff"),
        (b"referrer-policy", b"no-referrer"),
        (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
    ]


def mark_scripts(templates: Environment, name: str) -> None:
    """Give the scripts in the source of the page template ``name`` the nonce of the request, see `CONTENT_POLICY`.

    What is filled into the template has no nonce, so that a script in it does not run.
    """
    assert templates.loader is not None
    source = templates.loader.get_source(templates, name)[0]
    marked = source.replace("<script", f"<script nonce=\"{{{{ request.scope['{NONCE}'] }}}}\"")
    templates.loader = ChoiceLoader([DictLoader({name: marked}), templates.loader])


def is_loopback(host: str) -> bool:
    """Return whether ``host`` is an address of this machine's loopback interface."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Visitors:
    """The browsers that may use the studio.

    A studio that listens only on the loopback interface admits every browser of this computer. Any other studio admits
    a browser that presents a one-time token; the browser receives a cookie that identifies it from then on.

    Args:
        host: the address that the studio listens on.
        names: further host names under which requests are accepted.
    """

    def __init__(self, host: str, names: Iterable[str] = ()) -> None:
        self.open = is_loopback(host)
        self._names = {n.lower() for n in (*_LOOPBACK, host, *names)}
        self._tokens: set[str] = set()
        self._cookies: set[str] = set()

    def invite(self) -> str:
        """Create and return a new token, which admits one browser."""
        token = secrets.token_urlsafe(24)
        self._tokens.add(token)
        return token

    def refusal_of(self, headers: dict[str, str]) -> str:
        """Return why a request must be refused because of its host or origin, or "" if it is acceptable."""
        origin = headers.get("origin")
        foreign = "This request came from another web page: open the studio by its own address."
        try:
            host = urlsplit(f"//{headers.get('host', '')}").hostname or ""
            origin_host = urlsplit(origin or "").netloc
        except ValueError:
            return "The address of this request is not valid: use the address that the studio printed."
        if host.lower() not in self._names and f"[{host.lower()}]" not in self._names:
            return f"This studio does not answer under the name '{host}': use the address that it printed."
        # Browsers report which page sent the request. A link to the studio on another page is harmless.
        if headers.get("sec-fetch-site") == "cross-site" and headers.get("sec-fetch-mode") != "navigate":
            return foreign
        return foreign if origin and origin_host.lower() != headers.get("host", "").lower() else ""

    def admits(self, headers: dict[str, str]) -> bool:
        """Return whether a request comes from an admitted browser."""
        if self.open:
            return True
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return cookie is not None and any(hmac.compare_digest(cookie.value.encode(), v.encode()) for v in self._cookies)

    def admit(self, query: str) -> str:
        """Use up the token in a query string and return a new cookie value, or "" if the token is not valid."""
        given = parse_qs(query).get(TOKEN, [""])[0].encode()
        token = next((t for t in self._tokens if hmac.compare_digest(t.encode(), given)), None)
        if token is None:
            return ""
        self._tokens.discard(token)
        visitor = secrets.token_urlsafe(24)
        self._cookies.add(visitor)
        return visitor


class Guard:
    """ASGI middleware that rejects browsers not admitted by `Visitors`, limits bodies and sets security headers."""

    def __init__(self, app: ASGIApp, visitors: Visitors) -> None:
        self._app, self._visitors = app, visitors

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        query = scope.get("query_string", b"").decode("latin-1")
        if reason := self._visitors.refusal_of(headers):
            await _refuse(scope, send, 400, reason)
        elif scope["type"] == "websocket":
            if self._visitors.admits(headers):
                await self._app(scope, receive, send)
            else:
                await _refuse(scope, send, 401, _TOKEN_NEEDED)
        elif not self._visitors.open and scope["method"] == "GET" and (visitor := self._visitors.admit(query)):
            await _to_start(scope, send, "" if self._visitors.admits(headers) else visitor)
        elif self._visitors.admits(headers):
            await _bounded(self._app, scope, receive, send, headers)
        elif scope["path"] == "/" and query == WELCOME:
            # After a link from another page, a browser does not send the SameSite cookie with its first request.
            page = '<!doctype html><meta http-equiv="refresh" content="0;url=/">'
            await _answer(scope, send, HTMLResponse(page, headers=_CLOSE))
        else:
            await _refuse(scope, send, 401, _TOKEN_NEEDED)


_TOKEN_NEEDED = "This studio can only be opened with the address that it printed at start; its token is valid once."


async def _bounded(app: ASGIApp, scope: Scope, receive: Receive, send: Send, headers: dict[str, str]) -> None:
    """Call ``app``, limit the size of the request body (even if its length is unknown) and add security headers."""
    limit = UPLOAD_BYTES if _is_upload(scope) else BODY_BYTES
    refusal = f"This is larger than the {limit / 1e6:g} MB that are accepted here."
    length = headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > limit:
        await _refuse(scope, send, 413, refusal)
        return
    received, too_large, started, disconnected = 0, False, False, False
    scope[NONCE] = nonce = secrets.token_urlsafe(16)

    async def receiving() -> Message:
        nonlocal received, too_large, disconnected
        if too_large:
            return {"type": "http.disconnect"}
        message = await receive()
        disconnected = disconnected or message["type"] == "http.disconnect"
        received += len(message.get("body", b""))
        if received > limit:
            too_large = True
            return {"type": "http.disconnect"}
        return message

    async def sending(message: Message) -> None:
        nonlocal started
        if too_large and not started:
            return
        if message["type"] == "http.response.start":
            started = True
            own = list(message.get("headers", []))
            names = {name for name, _ in own}
            message = {**message, "headers": [*own, *(h for h in _security_headers(nonce) if h[0] not in names)]}
        await send(message)

    try:
        await app(scope, receiving, sending)
    except Exception as cause:
        # NiceGUI treats the end of the body as a disconnect; a browser that has disconnected needs no response.
        left = isinstance(cause, ClientDisconnect) or _UNANSWERED in str(cause)
        if not too_large and not (disconnected and left):
            raise
    if too_large and not started:
        await _refuse(scope, send, 413, refusal)


def _is_upload(scope: Scope) -> bool:
    """Return whether a request goes to NiceGUI's upload route ``/_nicegui/client/<page>/upload/<element>``."""
    parts: list[str] = scope["path"].split("/")
    return bool(scope["method"] == "POST" and parts[1:3] == ["_nicegui", "client"] and parts[4:5] == ["upload"])


_CLOSE = {"connection": "close"}


async def _to_start(scope: Scope, send: Send, visitor: str) -> None:
    """Redirect to the home page, which removes the token from the address, and set the cookie ``visitor`` if given."""
    response = RedirectResponse(f"/?{WELCOME}", 303)
    if visitor:
        response.set_cookie(COOKIE, visitor, httponly=True, samesite="strict")
    await _answer(scope, send, response)


async def _refuse(scope: Scope, send: Send, status: int, message: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": message[:100]})
        return
    # Close the connection, except after 413: a browser reads that response only after sending the whole body.
    await _answer(scope, send, PlainTextResponse(f"{message}\n", status, headers=None if status == 413 else _CLOSE))


async def _answer(scope: Scope, send: Send, response: Response) -> None:
    """Send a response that is not that of the application."""
    response.headers["cache-control"] = "no-store"
    response.raw_headers += _security_headers(secrets.token_urlsafe(16))
    await response(scope, _nothing, send)


async def _nothing() -> Message:
    return {"type": "http.disconnect"}


# Downloads --------------------------------------------------------------------------------------------------------

_MAX_NAME = 255
"""Maximum length of a file name in bytes; file systems report longer names in different ways."""


def download_address(kind: str, name: str) -> str:
    """Return the download address of an export, package or backup; ``kind`` is `EXPORTS`, `PACKAGES` or `BACKUPS`."""
    return f"/download/{kind}/{quote(name, safe='')}.zip"


def page_address(name: str) -> str:
    """Return the address of the page of an export."""
    return f"/page/{quote(name, safe='')}"


def router(workspace: Workspace) -> APIRouter:
    """Return a router that serves the addresses made by `download_address` and `page_address`."""
    routes = APIRouter()

    @routes.get("/page/{name}", include_in_schema=False)
    def page(name: str) -> Response:
        from plushsense.deploy.web import PAGE, page_policy

        # Of an export from elsewhere, too, only the script of this version runs.
        headers = {"content-security-policy": page_policy(), "cache-control": "no-store"}
        try:
            content = (path_in(workspace, EXPORTS, name) / PAGE).read_bytes()
        except (ConfigError, OSError):
            content = b""
        if headers["content-security-policy"].encode() not in content:
            return PlainTextResponse("This export has no page of this version of PlushSense: export again.\n", 404)
        return Response(content, media_type="text/html; charset=utf-8", headers=headers)

    @routes.get("/download/{kind}/{name}.zip", include_in_schema=False)
    def download(kind: str, name: str) -> Response:
        if kind not in (EXPORTS, PACKAGES, BACKUPS):
            return PlainTextResponse("Not found\n", 404)
        try:
            path = path_in(workspace, kind, name if kind == EXPORTS else f"{name}.zip")
        except ConfigError as refusal:
            return PlainTextResponse(f"{refusal}\n", 404)
        from plushsense.deploy.code import FACTS

        if kind == EXPORTS and (path / FACTS).is_file():
            headers = {"content-disposition": f"attachment; filename*=UTF-8''{quote(path.name, safe='')}.zip"}
            return Response(zip_of(path), media_type="application/zip", headers=headers)
        if kind != EXPORTS and path.is_file():
            return FileResponse(path, media_type="application/zip", filename=path.name)
        return PlainTextResponse(f"There is no {kind.removesuffix('s')} '{name}' in this studio.\n", 404)

    return routes


def path_in(workspace: Workspace, kind: str, name: str) -> Path:
    """Return the path of ``name`` directly inside the workspace's folder ``kind``.

    Raises:
        ConfigError: if ``name`` leads to another place (also through a link), or is too long.
    """
    place = workspace.inside(workspace.folder / kind / name)
    if place.parent != workspace.folder / kind or len(place.name.encode()) > _MAX_NAME:
        raise ConfigError(
            "“{name}” cannot be a name. Use at most 64 letters, digits, spaces, points and hyphens.",
            name=name,
            field="name",
        )
    return place


def zip_of(folder: Path) -> bytes:
    """Return a zip archive of an export; equal files give equal bytes. Links to places outside are left out."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path in list_package_files(folder):
            if folder.resolve() in path.resolve().parents:
                archive.writestr(zip_entry(f"{folder.name}/{path.relative_to(folder).as_posix()}"), path.read_bytes())
    return packed.getvalue()
