"""Nobody comes in who may not, nothing too large is taken, and every answer forbids foreign things."""

from __future__ import annotations

import http.client
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from plushsense.studio.app import guard
from plushsense.studio.app.guard import BODY_BYTES, CONTENT_POLICY, COOKIE, UPLOAD_BYTES, Guard, Visitors, is_loopback
from plushsense.studio.app.shell import PAGES
from support.browsing import Studio, alone, marked
from support.requirements import missing

Fixture = Callable[..., Any]
Answer = tuple[int, dict[str, str], bytes]


async def _echo(scope: dict[str, Any], receive: Any, send: Any) -> None:
    """An application that reads the whole body and says how long it was."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    length = 0
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ConnectionError("the visitor left")
        length += len(message.get("body", b""))
        if not message.get("more_body"):
            break
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": str(length).encode()})


def ask(
    visitors: Visitors,
    path: str = "/",
    *,
    query: str = "",
    kind: str = "http",
    method: str = "GET",
    body: Iterable[bytes] = (b"",),
    app: Any = _echo,
    **headers: str,
) -> Answer:
    """What comes back through the guard; a refused websocket has its close code as the status."""
    sent: list[dict[str, Any]] = []
    parts = list(body)
    given = {"host": "127.0.0.1:8137", **{k.replace("_", "-"): v for k, v in headers.items()}}

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    scope = {
        "type": kind,
        "method": method,
        "path": path,
        "query_string": query.encode(),
        "headers": [(k.encode(), v.encode()) for k, v in given.items()],
    }
    alone(Guard(app, visitors)(scope, receive, send))
    if kind == "websocket":
        return sent[0].get("code", 101), {}, b""
    start = sent[0]
    answered = {k.decode().lower(): v.decode() for k, v in start["headers"]}
    return start["status"], answered, b"".join(m.get("body", b"") for m in sent[1:])


def nonce(headers: dict[str, str]) -> str:
    """The nonce of an answer, which has our policy."""
    policy = headers["content-security-policy"]
    found = re.search(r"'nonce-([\w-]{22,})'", policy)
    assert found is not None and policy == CONTENT_POLICY.format(nonce=found[1])
    return found[1]


AT_HOME = Visitors("127.0.0.1")


def abroad() -> Visitors:
    return Visitors("0.0.0.0", ("tablet.local", "192.168.1.5", "fe80::1"))


@pytest.mark.parametrize(
    ("host", "said"),
    [("127.0.0.1", True), ("127.9.9.9", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("::", False)],
)
def test_loopback(host: str, said: bool) -> None:
    assert is_loopback(host) is said


def test_this_machine_needs_no_token() -> None:
    status, headers, body = ask(AT_HOME)
    assert (status, body) == (200, b"0")
    assert nonce(headers) != nonce(ask(AT_HOME)[1])
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    "headers",
    [
        {"host": "evil.example"},
        {"host": "127.0.0.1.evil.example"},
        {"host": ""},
        {"host": "[::1"},
        {"origin": "http://["},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"sec_fetch_site": "cross-site", "sec_fetch_mode": "no-cors"},
    ],
    ids=lambda h: " ".join(h.values()) or "no name",
)
def test_foreign_pages_and_names_are_refused(kind: str, headers: dict[str, str]) -> None:
    status, answered, _ = ask(AT_HOME, kind=kind, **headers)
    assert status == (1008 if kind == "websocket" else 400)
    if kind == "http":
        assert nonce(answered)


@pytest.mark.parametrize("host", ["localhost:8137", "127.0.0.1", "[::1]:8137", "LOCALHOST"])
def test_own_names_pass(host: str) -> None:
    assert ask(AT_HOME, host=host, origin=f"http://{host.lower()}" if host.islower() else "")[0] == 200


def test_a_link_from_elsewhere_may_be_followed() -> None:
    assert ask(AT_HOME, sec_fetch_site="cross-site", sec_fetch_mode="navigate")[0] == 200


@pytest.mark.parametrize("host", ["192.168.1.5:8137", "tablet.local", "[fe80::1]:8137", "127.0.0.1:8137"])
def test_abroad_a_token_is_asked_for_under_every_name(host: str) -> None:
    visitors = abroad()
    assert ask(visitors, host=host)[0] == 401
    assert ask(visitors, kind="websocket", host=host)[0] == 1008
    assert ask(visitors, "/_nicegui_ws/socket.io/", query="EIO=4&transport=polling", host=host)[0] == 401


def test_a_token_opens_once_and_leaves_the_address() -> None:
    visitors = abroad()
    query = f"token={visitors.invite()}"
    status, headers, _ = ask(visitors, query=query)
    assert status == 303
    assert "token" not in headers["location"]
    name, _, flags = headers["set-cookie"].partition(";")
    assert name.startswith(f"{COOKIE}=")
    assert {f.strip().lower() for f in flags.split(";")} >= {"httponly", "samesite=strict", "path=/"}
    assert nonce(headers)
    assert ask(visitors, query=query)[0] == 401
    assert ask(visitors, cookie=name)[0] == 200
    assert ask(visitors, kind="websocket", cookie=name)[0] == 101
    assert ask(visitors, cookie=f"{COOKIE}=guessed")[0] == 401
    assert ask(visitors, cookie="; = ,;;\x7f")[0] == 401
    # A browser that followed a foreign link keeps its cookie back once, and is sent on by the page itself.
    place = urlsplit(headers["location"])
    assert ask(visitors, place.path, query=place.query)[0] == 200
    assert ask(visitors, place.path, query=place.query)[2].startswith(b"<!doctype html><meta http-equiv")


def test_a_token_that_a_known_visitor_uses_is_used_up_and_leaves_the_address() -> None:
    visitors = abroad()
    cookie = ask(visitors, query=f"token={visitors.invite()}")[1]["set-cookie"].partition(";")[0]
    second = f"token={visitors.invite()}"
    status, headers, _ = ask(visitors, "/record", query=second, cookie=cookie)
    assert status == 303
    assert "set-cookie" not in headers
    assert ask(visitors, query=second)[0] == 401


@pytest.mark.parametrize("query", ["token=", "token=x", "token=%00", "token=x&token=y", "a=b", "&&=", "token=\u00e9"])
def test_no_guess_opens(query: str) -> None:
    visitors = abroad()
    visitors.invite()
    assert ask(visitors, query=query)[0] == 401


def test_tokens_are_for_addresses_not_for_other_methods() -> None:
    visitors = abroad()
    query = f"token={visitors.invite()}"
    assert ask(visitors, query=query, method="HEAD")[0] == 401
    assert ask(visitors, query=query)[0] == 303


def test_a_body_with_a_length_too_large_is_refused_unread() -> None:
    big = str(BODY_BYTES + 1)
    assert ask(AT_HOME, method="POST", content_length=big)[0] == 413
    assert ask(AT_HOME, "/_nicegui/client/abc/upload/4", method="POST", content_length=big)[0] == 200
    assert ask(AT_HOME, "/_nicegui/client/abc/upload/4", method="POST", content_length=str(UPLOAD_BYTES + 1))[0] == 413
    assert ask(AT_HOME, "/upload", method="POST", content_length="-5")[0] == 413
    assert ask(AT_HOME, "/upload", method="POST", content_length="1e3")[0] == 413


def test_a_body_without_a_length_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "BODY_BYTES", 1000)
    monkeypatch.setattr(guard, "UPLOAD_BYTES", 3000)
    status, headers, body = ask(AT_HOME, method="POST", body=[b"x" * 400] * 3)
    assert status == 413
    assert nonce(headers)
    assert b"larger than" in body
    assert ask(AT_HOME, method="POST", body=[b"x" * 400] * 2)[2] == b"800"
    upload = "/_nicegui/client/abc/upload/4"
    assert ask(AT_HOME, upload, method="POST", body=[b"x" * 400] * 7)[2] == b"2800"
    assert ask(AT_HOME, upload, method="POST", body=[b"x" * 400] * 8)[0] == 413


def test_a_failure_of_the_application_is_not_hidden() -> None:
    async def broken(*_: Any) -> None:
        raise ConnectionError("broken")

    with pytest.raises(ConnectionError):
        ask(AT_HOME, app=broken)


# Against the real server ------------------------------------------------------------------------------------------


@pytest.fixture
def nicegui() -> str:
    """The version of NiceGUI, whose name stands in its own routes."""
    try:
        from nicegui import __version__
    except ImportError:
        missing("browser", "nicegui is not installed")
    return str(__version__)


def get(studio: Studio, path: str, method: str = "GET", body: Any = None, **headers: str) -> Answer:
    connection = http.client.HTTPConnection("127.0.0.1", studio.port, timeout=20)
    try:
        connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
        answer = connection.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    finally:
        connection.close()


def routes(version: str) -> list[str]:
    return [
        "/",
        "/record",
        "/nothing-here",
        "/favicon.ico",
        f"/_nicegui/{version}/static/nicegui.css",
        f"/_nicegui/{version}/static/../../../../../../etc/passwd",
        f"/_nicegui/{version}/static/%2e%2e/%2e%2e/nicegui.py",
        f"/_nicegui/{version}/libraries/nothing",
        f"/_nicegui/{version}/components/nothing",
        f"/_nicegui/{version}/resources/x/..%2f..%2fnicegui.py",
        f"/_nicegui/{version}/esm/x/..%2f..%2fnicegui.py",
        "/_nicegui_ws/socket.io/?EIO=4&transport=polling",
        "/docs",
        "/openapi.json",
    ]


def websocket(studio: Studio, **headers: str) -> bool:
    """Whether the socket opens."""
    client = pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import InvalidStatus

    url = f"ws://127.0.0.1:{studio.port}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    given = {k.replace("_", "-").title(): v for k, v in headers.items()}
    try:
        with client.connect(url, additional_headers=given, open_timeout=20) as socket:
            return bool(socket.recv(timeout=20))
    except InvalidStatus as refused:
        assert refused.response.status_code in (400, 401, 403)
        return False


def test_at_home_every_answer_has_the_policy_and_nothing_is_given_away(nicegui: str, studio: Fixture) -> None:
    one = studio()
    for path in routes(nicegui):
        status, headers, body = get(one, path)
        scripts = re.findall(r"<script[^>]*>", body.decode("utf-8", "replace")) if b"<html" in body else []
        assert all(f' nonce="{nonce(headers)}"' in script for script in scripts), path
        assert len(scripts) >= 8 or path not in ("/", "/record")
        assert b"root:" not in body and b"SocketIoApp" not in body, path
        assert status in ((200,) if path in ("/", "/record") else (200, 303, 307, 400, 403, 404)), path
        assert get(one, path, host="evil.example")[0] == 400, path
        assert get(one, path, origin="http://evil.example")[0] == 400, path
    assert get(one, "/docs")[0] == get(one, "/openapi.json")[0] == 404
    # What lies outside is neither opened nor an error of the program: the fixture looks for tracebacks.
    for place in ("..%2f..%2fetc%2fpasswd", "/etc/passwd", "%00", "x" * 300):
        words = "&".join(f"{key}={place}" for key in ("dataset", "model", "recording", "selection", "session", "name"))
        for path in PAGES.values():
            status, _, body = get(one, f"{path}?{words}")
            assert status == 200 and b"root:" not in body, (path, place)
        for kind in ("exports", "packages", "backups", "recordings", ".."):
            assert get(one, f"/download/{kind}/{place}.zip")[0] == 404, (kind, place)
    assert websocket(one)
    assert websocket(one, origin=f"http://127.0.0.1:{one.port}")
    assert not websocket(one, origin="http://evil.example")


def test_abroad_nothing_answers_without_a_token(nicegui: str, studio: Fixture, tmp_path: Path) -> None:
    one = studio("--host", "0.0.0.0")
    query = urlsplit(one.url).query
    for path in routes(nicegui):
        status, headers, _ = get(one, path)
        assert status == 401, path
        assert nonce(headers), path
    assert get(one, "/_nicegui/client/x/upload/1", "POST", b"x")[0] == 401
    assert not websocket(one)
    status, headers, _ = get(one, f"/?{query}")
    assert status == 303
    cookie = headers["set-cookie"].partition(";")[0]
    assert get(one, "/", cookie=cookie)[0] == 200
    assert get(one, f"/?{query}")[0] == 401
    assert not websocket(one)
    assert websocket(one, cookie=cookie)
    assert not websocket(one, cookie=cookie, origin="http://evil.example")
    token = parse_qs(query)["token"][0]
    assert token not in "".join(one.errors)
    assert not [p for p in tmp_path.rglob("*") if p.is_file() and token.encode() in p.read_bytes()]


def test_bodies_are_bounded_on_every_route(studio: Fixture) -> None:
    one = studio()

    for path in ("/", "/_nicegui_ws/socket.io/?EIO=4&transport=polling", "/nothing"):
        assert get(one, path, "POST", content_length=str(BODY_BYTES + 1))[0] == 413
    assert get(one, "/_nicegui/client/x/upload/1", "POST", iter([b"x" * 1_000_000] * 2))[0] in (404, 405)
    assert get(one, "/")[0] == 200


def test_a_tablet_comes_in_by_its_address_once(studio: Fixture, look: Fixture) -> None:
    one = studio("--host", "0.0.0.0")
    query = urlsplit(one.url).query
    at = f"http://127.0.0.1:{one.port}"
    tablet = look((820, 1180), own=True)
    page = tablet.open(f"{at}/?{query}")
    assert "token" not in page.url
    assert "token" not in page.evaluate("document.referrer + performance.getEntries().map(e => e.name).join(' ')")
    page.go_back()
    assert "token" not in page.url
    second = look(own=True)
    stranger = second.context.new_page()
    answer = stranger.goto(f"{at}/?{query}")
    assert answer is not None and answer.status == 401
    assert "token" in stranger.inner_text("body")
    page = tablet.open(at)
    marked(page, "invite-new").click()
    address = marked(page, "invitation").input_value()
    assert marked(page, "invitation-code").locator("svg path").count() > 0
    guest = second.open(f"{at}/?{urlsplit(address).query}")
    assert marked(guest, "title").inner_text() == "Home"


def test_a_link_on_another_page_lets_a_visitor_in(studio: Fixture, look: Fixture) -> None:
    one = studio("--host", "0.0.0.0")
    query = urlsplit(one.url).query
    browser = look(own=True)
    page = browser.context.new_page()
    # Another site: its links are followed without the cookie that was just given.
    browser.context.route("http://localhost:1/", lambda r: r.fulfill(body="<h1>mail</h1>", content_type="text/html"))
    page.goto("http://localhost:1/")
    page.evaluate(f"location.href = 'http://127.0.0.1:{one.port}/?{query}'")
    page.wait_for_selector("[data-test=title]")
    assert "token" not in page.url
