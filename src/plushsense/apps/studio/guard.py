"""Who may talk to the studio: this machine, or whoever shows the one-time token; and pages may load nothing foreign.

The guard stands around everything, NiceGUI's own routes and its websocket too, so that there is one place to look.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Awaitable, Callable, Iterable
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

Scope = dict[str, Any]
Receive = Callable[[], Awaitable[dict[str, Any]]]
Send = Callable[[dict[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

COOKIE = "plushsense_visitor"
TOKEN = "token"
WELCOME = "welcome"
UPLOAD_BYTES = 501_000_000
"""The largest body of a request that brings a file."""
BODY_BYTES = 4_000_000
"""The largest body of any other request."""
_UNANSWERED = "No response returned"
"""What Starlette fails with where the visitor left before the answer was made."""
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]", "::1")

# NiceGUI's Vue templates are compiled in the browser, which needs eval; nothing may come from elsewhere.
CONTENT_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'none'"
)
_HEADERS = [
    (b"content-security-policy", CONTENT_POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
]


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Visitors:
    """Who may come in: everybody on this machine when the studio listens there alone, else who showed a token.

    Args:
        host: the address that the studio listens on.
        names: more names under which it may be called, such as the machine's.

    A token opens the studio once: whoever shows it gets a cookie, and the token is worth nothing any more.
    """

    def __init__(self, host: str, names: Iterable[str] = ()) -> None:
        self.open = is_loopback(host)
        self._names = {n.lower() for n in (*_LOOPBACK, host, *names)}
        self._tokens: set[str] = set()
        self._known: set[str] = set()

    def invite(self) -> str:
        """A new token, good for one visitor."""
        token = secrets.token_urlsafe(24)
        self._tokens.add(token)
        return token

    def strange(self, headers: dict[str, str]) -> str:
        """Why a request is none of ours; "" for one that is. A foreign page must not reach us under another name."""
        origin = headers.get("origin")
        try:
            host = urlsplit(f"//{headers.get('host', '')}").hostname or ""
            asking = urlsplit(origin or "").netloc
        except ValueError:
            return "This request names no address that there can be: use the one that the studio printed."
        if host.lower() not in self._names and f"[{host.lower()}]" not in self._names:
            return f"This studio is not called '{host}': use the address that it printed."
        # Browsers say whose page asks; a link that somebody follows to us is no harm.
        if headers.get("sec-fetch-site") == "cross-site" and headers.get("sec-fetch-mode") != "navigate":
            return "Another page asked for this: open the studio by its own address."
        if origin and asking.lower() != headers.get("host", "").lower():
            return "Another page asked for this: open the studio by its own address."
        return ""

    def knows(self, headers: dict[str, str]) -> bool:
        """Whether the request may pass."""
        if self.open:
            return True
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return cookie is not None and any(hmac.compare_digest(cookie.value.encode(), v.encode()) for v in self._known)

    def admit(self, query: str) -> str:
        """A cookie's value for whoever shows a token, which is used up; "" for anybody else."""
        given = parse_qs(query).get(TOKEN, [""])[0].encode()
        token = next((t for t in self._tokens if hmac.compare_digest(t.encode(), given)), None)
        if token is None:
            return ""
        self._tokens.discard(token)
        visitor = secrets.token_urlsafe(24)
        self._known.add(visitor)
        return visitor


class Guard:
    """ASGI application around another: lets in whom `Visitors` knows, bounds what they send, and forbids pages to load
    anything foreign."""

    def __init__(self, app: App, visitors: Visitors) -> None:
        self._app, self._visitors = app, visitors

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        query = scope.get("query_string", b"").decode("latin-1")
        if strange := self._visitors.strange(headers):
            await _refuse(scope, send, 400, strange)
        elif scope["type"] == "websocket":
            if self._visitors.knows(headers):
                await self._app(scope, receive, send)
            else:
                await _refuse(scope, send, 401, _UNKNOWN)
        elif not self._visitors.open and scope["method"] == "GET" and (visitor := self._visitors.admit(query)):
            await _to_start(send, "" if self._visitors.knows(headers) else visitor)
        elif self._visitors.knows(headers):
            await _bounded(self._app, scope, receive, send, headers)
        elif scope["path"] == "/" and query == WELCOME:
            # A browser that followed a link of another page keeps the cookie back for one request.
            await _answer(send, 200, b'<!doctype html><meta http-equiv="refresh" content="0;url=/">', "text/html")
        else:
            await _refuse(scope, send, 401, _UNKNOWN)


_UNKNOWN = "This studio needs the address with the token that it printed when it was started; each is good for once."


async def _bounded(app: App, scope: Scope, receive: Receive, send: Send, headers: dict[str, str]) -> None:
    """Have ``app`` answer, with our headers; a body that is too large is refused, also one without a length."""
    most = UPLOAD_BYTES if _is_upload(scope) else BODY_BYTES
    said = f"This is larger than the {most / 1e6:g} MB that are accepted here."
    length = headers.get("content-length", "0")
    if not length.isdecimal() or int(length) > most:
        await _refuse(scope, send, 413, said)
        return
    came, over, begun, gone = 0, False, False, False

    async def receiving() -> dict[str, Any]:
        nonlocal came, over, gone
        if over:
            return {"type": "http.disconnect"}
        message = await receive()
        gone = gone or message["type"] == "http.disconnect"
        came += len(message.get("body", b""))
        if came > most:
            over = True
            return {"type": "http.disconnect"}
        return message

    async def sending(message: dict[str, Any]) -> None:
        nonlocal begun
        if over and not begun:
            return
        if message["type"] == "http.response.start":
            begun = True
            message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
        await send(message)

    try:
        await app(scope, receiving, sending)
    except Exception as cause:
        # Whatever reads a body takes its end for the visitor's leaving; and one who left needs no answer.
        if not over and not (gone and _UNANSWERED in str(cause)):
            raise
    if over and not begun:
        await _refuse(scope, send, 413, said)


def _is_upload(scope: Scope) -> bool:
    """Whether this is NiceGUI's route for files: ``/_nicegui/client/<page>/upload/<element>``."""
    parts: list[str] = scope["path"].split("/")
    return bool(scope["method"] == "POST" and parts[1:3] == ["_nicegui", "client"] and parts[4:5] == ["upload"])


async def _to_start(send: Send, visitor: str) -> None:
    """To the first page, without the token in the address."""
    headers = [(b"location", f"/?{WELCOME}".encode()), (b"cache-control", b"no-store"), *_HEADERS]
    if visitor:
        headers.append((b"set-cookie", f"{COOKIE}={visitor}; Path=/; HttpOnly; SameSite=Strict".encode()))
    await send({"type": "http.response.start", "status": 303, "headers": headers})
    await send({"type": "http.response.body", "body": b""})


async def _refuse(scope: Scope, send: Send, status: int, said: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": said[:100]})
    else:
        await _answer(send, status, f"{said}\n".encode(), "text/plain")


async def _answer(send: Send, status: int, body: bytes, kind: str) -> None:
    headers = [(b"content-type", f"{kind}; charset=utf-8".encode()), (b"cache-control", b"no-store"), *_HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
