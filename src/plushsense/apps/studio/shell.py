"""What every page stands in: the bar with the pages, language and light, and the place where sentences appear."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import urlencode

from nicegui import background_tasks, context, ui
from nicegui.translations import translations

from plushsense.apps.studio.house import Bell, House
from plushsense.apps.studio.words import LANGUAGES, Words
from plushsense.core.errors import PlushSenseError

LANGUAGE_COOKIE, LIGHT_COOKIE = "plushsense_language", "plushsense_light"
PAGES = {
    "home": "/",
    "record": "/record",
    "review": "/review",
    "train": "/train",
    "live": "/live",
    "export": "/export",
    "publish": "/publish",
}
"""The pages in the order of the work, and where each is."""

AFFECT_SIGNS = {"positive": "+", "neutral": "○", "negative": "−", "none": "·"}
"""Affect is never told by colour alone: a sign and a word stand with it."""
AFFECT_COLOURS = {"positive": "#00805c", "neutral": "#3a6ea5", "negative": "#b84a00", "none": "#767676"}
"""After Okabe and Ito's palette for colour-blind eyes, darkened to read as text on white."""
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8a8a00", "#7f3c8d", "#a06000", "#444444")
"""Colours of lines in plots (Okabe and Ito, and four more)."""

_QUASAR = {"en": "en-US", "lv": "lv"}
_LIGHTS = {"system": "brightness_auto", "light": "light_mode", "dark": "dark_mode"}
# The colour of Quasar's dark page.
_NIGHT = "#121212"
_BEAR = (
    '<svg viewBox="0 0 32 32" width="28" height="28"><g fill="#e0a872"><circle cx="8" cy="8" r="5"/>'
    '<circle cx="24" cy="8" r="5"/><circle cx="16" cy="18" r="12"/></g><g fill="#3a2410"><circle cx="11.5" cy="16" '
    'r="1.8"/><circle cx="20.5" cy="16" r="1.8"/><ellipse cx="16" cy="21" rx="3" ry="2"/></g></svg>'
)

# One look of all fields.
for _field in (ui.input, ui.number, ui.select, ui.textarea):
    _field.default_props("outlined dense")

E = TypeVar("E", bound=ui.element)
Kind = Literal["info", "good", "warning", "error"]

_CSS = Path(__file__).with_name("studio.css")


@dataclass
class Page:
    """An open page: its words, and the place for sentences."""

    house: House
    name: str
    words: Words
    dark: bool
    _said: Any = None

    def say(self, sentence: str, kind: Kind = "info") -> None:
        """Show a sentence at the top, for eyes and screen readers; "" takes it away."""
        self._said.clear()
        if not sentence:
            return
        with self._said:
            role = "alert" if kind == "error" else "status"
            box = ui.row().classes(f"ps-said ps-said-{kind} w-full items-center no-wrap").props(f'role="{role}"')
            with tag(box, "said"):
                ui.label(sentence).classes("flex-grow")
                close = ui.button(icon="close", on_click=lambda: self.say("")).props("flat round dense color=inherit")
                close.props(f'aria-label="{self.words("shell.close")}"')

    @contextmanager
    def refusing(self) -> Iterator[None]:
        """Show what is refused in here as a sentence, and go on."""
        try:
            yield
        except PlushSenseError as refusal:
            self.say(str(refusal), "error")
        except OSError as cause:
            where = f" '{cause.filename}'" if cause.filename else ""
            self.say(self.words("shell.system_refused", where=where, why=cause.strerror or str(cause)), "error")


def visitor() -> tuple[Words, bool | None]:
    """The words and the light (dark, light, None: as the system has it) that this visitor chose."""
    request = context.client.request
    cookies = request.cookies if request is not None else {}
    chosen = cookies.get(LANGUAGE_COOKIE) or _preferred(request.headers.get("accept-language", "") if request else "")
    return Words(chosen), {"dark": True, "light": False}.get(cookies.get(LIGHT_COOKIE, ""))


def _preferred(accepted: str) -> str:
    for part in accepted.split(","):
        code = part.split(";")[0].strip()[:2].lower()
        if code in LANGUAGES:
            return code
    return next(iter(LANGUAGES))


@contextmanager
def frame(house: House, name: str) -> Iterator[Page]:
    """The bar and an empty page to fill; ``name`` is a key of `PAGES`."""
    words, dark = visitor()
    page = Page(house, name, words, bool(dark))
    _lit(words, dark)
    ui.page_title(f"{words(f'pages.{name}')} · PlushSense")
    ui.add_head_html(f"<style>{_CSS.read_text(encoding='utf-8')}</style>")
    with ui.header().classes("ps-header items-center no-wrap"):
        # A link of NiceGUI's would load the page once more.
        ui.html(f'<a class="ps-skip" href="#content">{escape(words("shell.skip"))}</a>', sanitize=False)
        ui.html(_BEAR, sanitize=False, tag="span").classes("ps-bear").props("aria-hidden=true")
        ui.label("PlushSense").classes("ps-brand")
        with ui.element("nav").classes("ps-bar row items-center").props(f'aria-label="{words("shell.pages")}"'):
            for key, path in PAGES.items():
                link = ui.link(words(f"pages.{key}"), path)
                if key == name:
                    link.props('aria-current="page"')
        ui.space()
        _choices(words, dark)
    with ui.element("div").classes("ps-main column no-wrap items-start").props('id="content" tabindex="-1"'):
        tag(ui.html(escape(words(f"{name}.title")), sanitize=False, tag="h1"), "title")
        page._said = ui.column().classes("w-full ps-sayings")
        yield page


def _lit(words: Words, dark: bool | None) -> None:
    """Language and light of the answer itself, so that nothing shows in the wrong one before scripts have run."""
    client = context.client
    # The page object is the route's, shared by all visitors: each gets a copy.
    own = copy(client.page)
    own.dark, own.language = dark, _QUASAR[words.language]  # type: ignore[assignment]
    client.page = own
    translations[own.language] = {  # type: ignore[index]
        "connection_lost": words("shell.connection_lost"),
        "trying_to_reconnect": words("shell.trying_to_reconnect"),
        "message_too_long": words("shell.message_too_long"),
        "message_too_long_body": words("shell.message_too_long_body"),
    }
    night = f":root {{ color-scheme: dark; background: {_NIGHT}; }}"
    early = night if dark else "" if dark is False else f"@media (prefers-color-scheme: dark) {{ {night} }}"
    ui.add_head_html(f"<style>{early}</style>")
    # The connection's loss is said to screen readers, too.
    ui.add_body_html(
        "<script>addEventListener('DOMContentLoaded', () => document.querySelectorAll('.nicegui-error-popup')"
        ".forEach(box => box.setAttribute('role', 'alert')))</script>"
    )


def _choices(words: Words, dark: bool | None) -> None:
    """Language and light, kept as cookies of this browser."""
    language = ui.toggle({code: code.upper() for code in LANGUAGES}, value=words.language)
    language.props(
        f"dense unelevated color=blue-grey-9 toggle-color=blue-grey-1 toggle-text-color=black "
        f'aria-label="{words("shell.language")}"'
    )
    tag(language, "language").on_value_change(lambda e: _keep(LANGUAGE_COOKIE, str(e.value)))
    now = "dark" if dark else "system" if dark is None else "light"
    button = ui.button(icon=_LIGHTS[now]).props("flat round dense color=white")
    tag(button, "light").props(f'aria-label="{words("shell.lights")}: {words(f"shell.{now}")}" aria-haspopup="menu"')
    with button, ui.menu():
        for light, icon in _LIGHTS.items():
            item = ui.menu_item(on_click=lambda light=light: _keep(LIGHT_COOKIE, light))
            tag(item, f"light-{light}").props(f"role=menuitemradio aria-checked={str(light == now).lower()}")
            with item, ui.row().classes("items-center no-wrap q-gutter-sm"):
                ui.icon(icon).props("aria-hidden=true")
                ui.label(words(f"shell.{light}")).classes("text-weight-bold" if light == now else "")


def _keep(cookie: str, value: str) -> None:
    ui.run_javascript(
        f"document.cookie = '{cookie}={value}; path=/; max-age=31536000; SameSite=Strict'; location.reload()"
    )


def on_ring(bell: Bell, callback: Callable[[], Any]) -> None:
    """Call ``callback`` (it may be async) in this page after the bell rang (many rings as one), for as long as the page
    is open."""
    client = context.client

    async def going_on(made: Awaitable[Any]) -> None:
        with client:
            await made

    def called() -> None:
        with client:
            made = callback()
        if inspect.isawaitable(made):
            background_tasks.create(going_on(made))

    client.on_delete(bell.hear(called))


def address(page: str, **query: str | Path) -> str:
    """The address of a page that begins with something chosen, such as ``address("review", dataset=path)``."""
    chosen = {key: str(value) for key, value in query.items() if str(value)}
    return PAGES[page] + (f"?{urlencode(chosen)}" if chosen else "")


def asked(key: str) -> str:
    """What this page's address says of ``key``; "" where it says nothing. Paths go through `House.inside`."""
    request = context.client.request
    return str(request.query_params.get(key, "")) if request is not None else ""


def asked_path(house: House, key: str, among: Iterable[str]) -> str:
    """The path that this page's address names, where it is one of these; else the first of them, or ""."""
    there = list(among)
    with suppress(PlushSenseError):
        if (path := str(house.inside(asked(key)))) in there:
            return path
    return next(iter(there), "")


def tag(element: E, name: str) -> E:
    """Give an element a name that browsers see, ``data-test``: for tests and the manual, never for looks."""
    element.props["data-test"] = name
    return element


def named(element: E, label: str) -> E:
    """Give an element a name for screen readers, whatever characters that holds."""
    element.props["aria-label"] = label
    return element


def focus(element: ui.element) -> None:
    """Give an element the keyboard, as soon as it is shown."""
    ui.run_javascript(f"setTimeout(() => getHtmlElement({element.id})?.focus())")


def affect_badge(words: Words, affect: str | None) -> ui.label:
    """An affect as sign, word and colour."""
    key = affect or "none"
    badge = ui.label(f"{AFFECT_SIGNS[key]} {words.affect(affect)}").classes("q-px-sm rounded-borders")
    return badge.style(f"background: {AFFECT_COLOURS[key]}; color: #fff; font-weight: 600")
