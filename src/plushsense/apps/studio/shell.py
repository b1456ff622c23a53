"""What every page stands in: the bar with the pages, language and light, and the place where sentences appear."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Literal, TypeVar

from nicegui import context, ui

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

AFFECT_SIGNS = {"positive": "＋", "neutral": "○", "negative": "−", "none": "·"}
"""Affect is never told by colour alone: a sign and a word stand with it."""
AFFECT_COLOURS = {"positive": "#00805c", "neutral": "#3a6ea5", "negative": "#b84a00", "none": "#767676"}
"""After Okabe and Ito's palette for colour-blind eyes, darkened to read as text on white."""
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8a8a00", "#7f3c8d", "#a06000", "#444444")
"""Colours of lines in plots (Okabe and Ito, and four more)."""

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
    ui.page_title(f"{words(f'pages.{name}')} · PlushSense")
    ui.add_head_html(f"<style>{_CSS.read_text(encoding='utf-8')}</style>")
    ui.add_head_html(f"<script>document.documentElement.lang = '{words.language}'</script>")
    ui.dark_mode(dark)
    ui.link(words("shell.skip"), "#content").classes("ps-skip")
    with ui.header().classes("items-center q-py-xs").style("background: #123a5c"):
        ui.label("PlushSense").classes("text-lg font-bold q-mr-sm").style("color: #fff")
        with ui.element("nav").classes("ps-bar row items-center").props(f'aria-label="{words("shell.pages")}"'):
            for key, path in PAGES.items():
                link = ui.link(words(f"pages.{key}"), path)
                if key == name:
                    link.props('aria-current="page"')
        ui.space()
        _choices(words, dark)
    with (
        ui.element("main").classes("ps-main column no-wrap items-start q-gutter-md").props('id="content" tabindex="-1"')
    ):
        tag(ui.html(escape(words(f"{name}.title")), sanitize=False, tag="h1"), "title")
        page._said = ui.column().classes("w-full q-mt-none")
        yield page


def _choices(words: Words, dark: bool | None) -> None:
    """Language and light, kept as cookies of this browser."""
    language = ui.toggle({code: code.upper() for code in LANGUAGES}, value=words.language)
    language.props(
        f"dense unelevated color=blue-grey-9 toggle-color=blue-grey-1 toggle-text-color=black "
        f'aria-label="{words("shell.language")}"'
    )
    tag(language, "language").on_value_change(lambda e: _keep(LANGUAGE_COOKIE, str(e.value)))
    icon, other = ("light_mode", "light") if dark else ("dark_mode", "dark")
    light = ui.button(icon=icon, on_click=lambda: _keep(LIGHT_COOKIE, other)).props("flat round color=white")
    tag(light, "light").props(f'aria-label="{words(f"shell.{other}")}"')


def _keep(cookie: str, value: str) -> None:
    ui.run_javascript(
        f"document.cookie = '{cookie}={value}; path=/; max-age=31536000; SameSite=Strict'; location.reload()"
    )


def on_ring(bell: Bell, callback: Callable[[], Any]) -> None:
    """Call ``callback`` in this page after the bell rang (many rings as one), for as long as the page is open."""
    client = context.client

    def called() -> None:
        with client:
            callback()

    client.on_delete(bell.hear(called))


def tag(element: E, name: str) -> E:
    """Give an element a name that browsers see, ``data-test``: for tests and the manual, never for looks."""
    element.props(f'data-test="{name}"')
    return element


def affect_badge(words: Words, affect: str | None) -> ui.label:
    """An affect as sign, word and colour."""
    key = affect or "none"
    badge = ui.label(f"{AFFECT_SIGNS[key]} {words.affect(affect)}").classes("q-px-sm rounded-borders")
    return badge.style(f"background: {AFFECT_COLOURS[key]}; color: #fff; font-weight: 600")
