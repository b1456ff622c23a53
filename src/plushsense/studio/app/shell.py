"""Build the frame of every page (navigation bar, language, colour scheme, messages) and elements that pages share."""

from __future__ import annotations

import inspect
import json
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import urlencode

from markupsafe import Markup, escape
from nicegui import background_tasks, context, run, ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments
from nicegui.translations import translations

from plushsense.core.errors import PlushSenseError
from plushsense.studio.app.choices import Choices
from plushsense.studio.app.toys import ToyInUseError, Toys, ToyUse
from plushsense.studio.app.words import LANGUAGES, PageTexts, Texts, Words
from plushsense.studio.app.workspace import ChangeSignal, Workspace, refusal_of

_CONNECTION: Texts = {
    "connection_lost": "The connection to the studio is lost.",
    "trying_to_reconnect": "Everything recorded so far is saved. Trying to reconnect …",
    "message_too_long": "The message is too long",
    "message_too_long_body": "The page sent more than the studio accepts.",
}

_LIGHT_TEXTS: Texts = {
    "system": "Same as the system",
    "light": "Light",
    "dark": "Dark",
}

_CLICKED = "(e) => emit({seen: document.querySelector('[data-seen]').dataset.seen, times: e.detail})"


class Keys(Element, component="keys.js"):
    """Element that handles the keyboard commands of a page; a key that is held down counts once.

    Args:
        keys: the characters that are commands.
        on_press: called with the key and the state that the browser displayed when the key was pressed (see `show`).
        fields: maps a key to the CSS selector of the field that it moves the focus to.
        aliases: maps further keys, such as "pagedown" or "enter", to those commands.

    The space bar and Enter press the button or link that has the focus; a click by mouse or finger leaves none there.
    """

    def __init__(
        self,
        keys: str,
        on_press: Callable[[str, str], Any],
        fields: Mapping[str, str] | None = None,
        aliases: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__()
        self._props["keys"] = keys
        self._props["seen"] = ""
        self._props["fields"] = dict(fields or {})
        self._props["aliases"] = dict(aliases or {})

        def pressed(event: GenericEventArguments) -> Any:
            return on_press(str(event.args["key"]), str(event.args["seen"]))

        self.on("press", pressed)

    def show(self, seen: str) -> None:
        """Set the state that the page now displays; the browser sends it with every later key press."""
        if self._props["seen"] != seen:
            self._props["seen"] = seen
            self.update()


def on_click(button: ui.button, call: Callable[[str], Any], once: bool = False) -> None:
    """Call ``call`` on a click with the state set by `Keys.show`; with ``once``, a double click counts as one."""

    def clicked(event: GenericEventArguments) -> Any:
        if not (once and int(event.args["times"] or 0) > 1):
            return call(str(event.args["seen"]))
        return None

    button.on("click", clicked, js_handler=_CLICKED)


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
"""The pages: maps name to path, in the order of the navigation bar.

To add a page, add a line here and a folder ``pages/<name>`` with a module ``<name>_page``, whose function
``show(page)`` adds the content below the title. The folder's ``__init__`` holds its `PageTexts` as ``TEXTS``.
"""

CHILD = "child"
"""Value of ``view`` in the address of a screen for a child, which has nothing to press."""

TOUR = "tour"
"""Query parameter of the address with which a page shows its sentences of the tour."""

AFFECT_SIGNS = {"positive": "+", "neutral": "○", "negative": "−", "none": "·"}
"""Sign of each affect. Pages never mark affect by colour alone, but also by this sign and a word."""
AFFECT_COLOURS = {"positive": "#00805c", "neutral": "#3a6ea5", "negative": "#b84a00", "none": "#767676"}
"""Colour of each affect, from Okabe and Ito's colour-blind palette, darkened to make white text readable on it."""
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8a8a00", "#7f3c8d", "#a06000", "#444444")
"""Colours of lines in plots: Okabe and Ito's palette and a few more."""

_QUASAR = {"en": "en-US", "lv": "lv"}
_LIGHTS = {"system": "brightness_auto", "light": "light_mode", "dark": "dark_mode"}
# The background colour of Quasar's dark pages.
_DARK_BACKGROUND = "#121212"
_LOGO = Markup(
    '<svg viewBox="0 0 32 32" width="28" height="28"><g fill="#e0a872"><circle cx="8" cy="8" r="5"/>'
    '<circle cx="24" cy="8" r="5"/><circle cx="16" cy="18" r="12"/></g><g fill="#3a2410"><circle cx="11.5" cy="16" '
    'r="1.8"/><circle cx="20.5" cy="16" r="1.8"/><ellipse cx="16" cy="21" rx="3" ry="2"/></g></svg>'
)

# Give all fields the same design.
for _field in (ui.input, ui.number, ui.select, ui.textarea):
    _field.default_props("outlined dense")

E = TypeVar("E", bound=ui.element)
Kind = Literal["info", "good", "warning", "error"]

_CSS = Path(__file__).with_name("studio.css")
# The browser has drawn what was sent before.
_DRAWN_MS = 60


def page_texts(name: str) -> PageTexts:
    """Return title, help and the like of the page ``name``."""
    texts: PageTexts = import_module(f"plushsense.studio.pages.{name}").TEXTS
    return texts


@dataclass
class Page:
    """An open page: its workspace, its texts, and the places where messages and the progress of jobs appear."""

    workspace: Workspace
    name: str
    words: Words
    dark: bool
    work: ui.element | None = None
    _messages: Any = None

    def show_work(self) -> None:
        """Reveal the progress of the job that was just started."""
        if self.work is not None:
            reveal(self.work)

    def say(
        self, sentence: str, kind: Kind = "info", undo: Callable[[], Any] | None = None, label: str = "Undo"
    ) -> None:
        """Show a message at the top of the page and announce it to screen readers; "" removes the message.

        With ``undo``, the message has a button that calls it, with the English text ``label``.
        """
        self._messages.clear()
        if not sentence:
            return
        with self._messages, tag(message_row(kind), "message"):
            ui.label(sentence).classes("flex-grow")
            if undo is not None:
                button("undo", self.words(label), on_page(undo), "outline color=inherit")
            icon_button(
                "close", self.words("Close this message"), lambda: self.say(""), "flat round dense color=inherit"
            )

    @contextmanager
    def show_errors(self, again: Callable[[], Any] = lambda: None) -> Iterator[None]:
        """Show errors raised in the block as a message on the page.

        If another page uses the toy, the message has a button that stops that and calls ``again``.
        """
        try:
            yield
        except ToyInUseError as refusal:
            use = refusal.use

            async def free() -> None:
                self.say("")
                with self.show_errors():
                    await run.io_bound(use.stop)
                    if inspect.isawaitable(result := again()):
                        await result

            self.say(self.words.error(refusal), "warning", free, STOP_USE)
        except PlushSenseError as refusal:
            self.say(self.words.error(refusal), "error")
        except OSError as cause:
            self.say(self.words.error(refusal_of(cause)), "error")


STOP_USE = "Stop that and use the toy here"


def message_row(kind: Kind) -> ui.row:
    """Add a coloured box for a message, which screen readers announce."""
    box = ui.row().classes(f"ps-message ps-message-{kind} w-full items-center no-wrap")
    return box.props(f'role="{"alert" if kind == "error" else "status"}"')


def visitor() -> tuple[Words, bool | None]:
    """Return the texts in the visitor's language and the colour scheme: True dark, False light, None the system's."""
    request = context.client.request
    cookies = request.cookies if request is not None else {}
    accepted = request.headers.get("accept-language", "") if request is not None else ""
    codes = [part.strip()[:2].lower() for part in accepted.split(",")]
    language = cookies.get(LANGUAGE_COOKIE) or next((code for code in codes if code in LANGUAGES), "")
    return Words(language), {"dark": True, "light": False}.get(cookies.get(LIGHT_COOKIE, ""))


@contextmanager
def frame(workspace: Workspace, name: str) -> Iterator[Page]:
    """Build the navigation bar and title of the page ``name`` (a key of `PAGES`), and yield the page to fill.

    A screen for a child has neither, nor a place for messages.
    """
    words, dark = visitor()
    texts = page_texts(name)
    page = Page(workspace, name, words, bool(dark))
    _set_appearance(words, dark)
    ui.page_title(f"{words(texts.name)} · PlushSense")
    add_style(_CSS.read_text(encoding="utf-8"))
    if query().get("view") == CHILD:
        yield page
        return
    with ui.header().classes("ps-header items-center no-wrap"):
        # Written as HTML because a link made by NiceGUI would reload the page.
        html(Markup('<a class="ps-skip" href="#content">{}</a>').format(words("Skip to the content")))
        html(_LOGO, "span").classes("ps-logo").props("aria-hidden=true")
        ui.label("PlushSense").classes("ps-brand")
        with ui.element("nav").classes("ps-bar row items-center").props(f'aria-label="{words("Pages")}"'):
            for key, path in PAGES.items():
                link = ui.link(words(page_texts(key).name), path)
                if key == name:
                    link.props('aria-current="page"')
        # On a phone, the link may be outside the visible part of the bar.
        ui.run_javascript("document.querySelector('.ps-bar [aria-current]')?.scrollIntoView({inline: 'center'})")
        ui.space()
        if texts.help:
            _help(words, texts)
        _choices(words, dark)
    with ui.element("div").classes("ps-main column no-wrap items-start").props('id="content" tabindex="-1"'):
        _in_use_bar(page)
        if TOUR in query() and texts.tour:
            _tour(words, name)
        tag(html(words(texts.title), "h1"), "title")
        page._messages = ui.column().classes("w-full ps-messages")
        yield page


_IN_USE: Texts = {"record": "Recording now: {name}.", "live": "Live now: {toy}."}
_SHOW_USE: Texts = {"record": "Show the recording", "live": "Show it"}


def _in_use_bar(page: Page) -> None:
    """Add a bar that names what other pages record or read now, with a link to each; hide it while there is nothing."""
    bar = tag(ui.column().classes("ps-message ps-message-recording w-full").props('role="status"'), "in-use")
    toys, words = page.workspace.part(Toys), page.words

    async def stop(use: ToyUse) -> None:
        with page.show_errors():
            await run.io_bound(use.stop)

    def draw() -> None:
        uses = [use for use in toys.in_use if use.page != page.name]
        bar.clear()
        bar.set_visibility(bool(uses))
        with bar:
            for use in uses:
                text = words(_IN_USE[use.page], name=use.name, toy=words.toy(use.toy))
                with ui.row().classes("w-full items-center"):
                    ui.label(f"● {text}").classes("text-bold ps-break")
                    show = words(_SHOW_USE[use.page])
                    link = ui.link(show, address(use.page, session=use.name)).classes("ps-link")
                    named(link, f"{show}: {use.name or words.toy(use.toy)}")
                    if not use.name:
                        button(
                            "stop-use",
                            words("Stop"),
                            on_page(partial(stop, use)),
                            "outline color=white",
                            about=words.toy(use.toy),
                        )

    draw()
    on_change(toys.in_use_changed, draw)


def _help(words: Words, texts: PageTexts) -> None:
    """Add the button that opens the help of a page, which leads to the tour."""
    with ui.dialog() as dialog:
        named(dialog.props("transition-duration=0"), words("Help"))
        with tag(ui.card(), "help"):
            heading(f"{words('Help')}: {words(texts.name)}", 2)
            for paragraph in words(texts.help).split("\n"):
                ui.label(paragraph)
            with ui.row().classes("w-full justify-end"):
                button("tour", words("Tour of two minutes"), lambda: ui.navigate.to(address("home", **{TOUR: "1"})))
                button("", words("Close"), dialog.close, "unelevated autofocus")
    opener = icon_button("help", words("Help"), dialog.open, "flat round dense color=white")
    tag(opener.props('aria-haspopup="dialog"'), "open-help")


def _tour(words: Words, name: str) -> None:
    """Add the sentences of the tour about the page ``name``, with buttons to the next and the former page."""
    pages = [page for page in PAGES if page_texts(page).tour]
    at, texts = pages.index(name), page_texts(name)

    def go(key: str, look: str, label: str, place: str) -> None:
        button(key, words(label), lambda: ui.navigate.to(place), look)

    with tag(named(ui.element("section").classes("ps-card ps-next w-full"), words("Tour of two minutes")), "tour-step"):
        heading(words("Tour {n} of {m}: {page}", n=at + 1, m=len(pages), page=words(texts.name)), 2)
        ui.label(words(texts.tour))
        with ui.row().classes("w-full"):
            if at + 1 < len(pages):
                go("tour-next", "unelevated", "Next page", address(pages[at + 1], **{TOUR: "1"}))
            if at:
                go("tour-back", "outline", "Page before", address(pages[at - 1], **{TOUR: "1"}))
            last = at + 1 == len(pages)
            go("tour-end", "unelevated" if last else "flat", "End the tour", address("home" if last else name))


def _set_appearance(words: Words, dark: bool | None) -> None:
    """Set language and colour scheme in the HTML of the response, so that they apply before scripts run."""
    client = context.client
    # The page object belongs to the route and is shared by all visitors, so change a copy.
    own = copy(client.page)
    own.dark, own.language = dark, _QUASAR[words.language]  # type: ignore[assignment]
    client.page = own
    translations[own.language] = {key: words(text) for key, text in _CONNECTION.items()}  # type: ignore[index]
    style = f":root {{ color-scheme: dark; background: {_DARK_BACKGROUND}; }}"
    if dark is not False:
        add_style(style if dark else f"@media (prefers-color-scheme: dark) {{ {style} }}")


def _choices(words: Words, dark: bool | None) -> None:
    """Add the selectors of language and colour scheme; the choices are stored in cookies."""
    language = ui.toggle({code: code.upper() for code in LANGUAGES}, value=words.language)
    language.props(
        f"dense unelevated color=blue-grey-9 toggle-color=blue-grey-1 toggle-text-color=black "
        f'aria-label="{words("Language")}"'
    )
    tag(language, "language").on_value_change(lambda e: _set_cookie(LANGUAGE_COOKIE, str(e.value)))
    now = "dark" if dark else "system" if dark is None else "light"
    button = ui.button(icon=_LIGHTS[now]).props("flat round dense color=white")
    tag(button, "light").props(
        f'aria-label="{words("Colour scheme")}: {words(_LIGHT_TEXTS[now])}" aria-haspopup="menu"'
    )
    with button, ui.menu():
        for light, icon in _LIGHTS.items():
            item = ui.menu_item(on_click=lambda light=light: _set_cookie(LIGHT_COOKIE, light))
            tag(item, f"light-{light}").props(f"role=menuitemradio aria-checked={str(light == now).lower()}")
            with item, ui.row().classes("items-center no-wrap q-gutter-sm"):
                ui.icon(icon).props("aria-hidden=true")
                ui.label(words(_LIGHT_TEXTS[light])).classes("text-bold" if light == now else "")


def _set_cookie(cookie: str, value: str) -> None:
    ui.run_javascript(
        f"document.cookie = '{cookie}={value}; path=/; max-age=31536000; SameSite=Strict'; location.reload()"
    )


def on_change(signal: ChangeSignal, callback: Callable[[], Any]) -> None:
    """Call ``callback``, which may be async, after each notification of ``signal`` until this page is closed."""
    client = context.client

    async def finish(result: Awaitable[Any]) -> None:
        with client:
            await result

    def called() -> None:
        with client:
            result = callback()
        if inspect.isawaitable(result):
            background_tasks.create(finish(result))

    client.on_delete(signal.subscribe(called))


def on_page(call: Callable[..., Any]) -> Callable[..., Awaitable[None]]:
    """Return a handler that calls ``call`` in the slot of the page, which outlives the element that was clicked."""

    async def called(*values: Any) -> None:
        with context.client.content:
            result = call(*values)
            if inspect.isawaitable(result):
                await result

    return called


def address(page: str, **query: str | Path) -> str:
    """Return the address of a page with a query, such as ``address("review", dataset=path)``; skip empty values."""
    values = {key: str(value) for key, value in query.items() if str(value)}
    return PAGES[page] + (f"?{urlencode(values, safe='/')}" if values else "")


def query() -> dict[str, str]:
    """Return the query parameters of this page's address; check paths in them with `Workspace.inside`."""
    request = context.client.request
    return dict(request.query_params) if request is not None else {}


def query_path(workspace: Workspace, key: str, allowed: Iterable[str], default: str | None = None) -> str:
    """Return the path in the query parameter ``key`` if allowed, else the last choice, ``default`` or the first."""
    paths = list(allowed)
    with suppress(PlushSenseError):
        if (path := str(workspace.inside(query().get(key, "")))) in paths:
            return path
    return workspace.part(Choices).last(key, paths, default)


def set_address(path: str) -> None:
    """Change the address displayed by the browser without loading a page."""
    ui.run_javascript(f"history.replaceState(history.state, '', {json.dumps(path)})")


def moment(seconds: float) -> str:
    """Format seconds since 1970 as date and time in the time zone of this computer."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def html(content: str = "", kind: str = "div") -> ui.html:
    """Add an HTML element with the tag ``kind`` that shows ``content``.

    A plain string is escaped, also when the content is set later. Only `markupsafe.Markup` is used as HTML; build it
    with ``Markup("…{}…").format(…)``, which escapes the values. Pages create HTML elements only with this function.
    """
    return ui.html(content, sanitize=lambda given: str(escape(given)), tag=kind)


def add_style(css: str) -> None:
    """Add styles to the page; `ui.add_css` would do so by a script, which the content security policy refuses."""
    ui.add_head_html(f"<style>{css}</style>")


def tag(element: E, name: str) -> E:
    """Set the attribute ``data-test``, by which tests find an element; never use it for styles."""
    element.props["data-test"] = name
    return element


def named(element: E, label: str) -> E:
    """Set the name of an element for screen readers; the label may contain any characters."""
    element.props["aria-label"] = label
    return element


def section(label: str, classes: str = "ps-card", level: int = 2) -> ui.element:
    """Add a section with a heading; screen readers list it as a region named ``label``."""
    box = named(ui.element("section").classes(f"{classes} w-full column no-wrap ps-small-gap"), label)
    with box:
        heading(label, level)
    return box


def heading(text: str, level: int) -> ui.label:
    """Add a heading; use `section` instead for the heading of a region."""
    look = "text-lg" if level < 4 else "text-weight-bold"
    return ui.label(text).classes(look).props(f'role="heading" aria-level="{level}"')


def scroll_region(label: str) -> ui.element:
    """Add a box in which wide content scrolls sideways and which the keyboard can focus."""
    return named(ui.element("div").classes("ps-scroll-x").props('role="region" tabindex="0"'), label)


def button(
    name: str,
    label: str,
    call: Callable[..., Any] | None = None,
    look: str = "outline",
    *,
    about: str = "",
    **more: Any,
) -> ui.button:
    """Add a button with text.

    Args:
        name: the value of ``data-test``, see `tag`; "" for none.
        call: called on a click.
        look: Quasar properties, such as "outline", "flat", or "unelevated" for the main action.
        about: what the action applies to; screen readers read it after the label.
        more: further arguments of `ui.button`.
    """
    element = ui.button(label, on_click=call, **more).props(f"no-caps {look}")
    if about:
        named(element, f"{label}: {about}")
    return tag(element, name) if name else element


def icon_button(
    icon: str, label: str, call: Callable[..., Any], look: str = "flat round dense", **more: Any
) -> ui.button:
    """Add a button that displays an icon; screen readers read ``label``."""
    return named(ui.button(icon=icon, on_click=call, **more).props(look), label)


def focus(element: ui.element) -> None:
    """Move the keyboard focus to an element as soon as it is displayed."""
    ui.run_javascript(f"setTimeout(() => getHtmlElement({element.id})?.focus())")


def reveal(element: ui.element) -> None:
    """Scroll to the effect of a click as soon as it is displayed, and move the keyboard focus there.

    A page that moves under a pressed button loses that click, so the page is moved after the button is released.
    """
    go = "at.tabIndex = -1; at.focus({ preventScroll: true }); at.scrollIntoView();"
    wait = f"const at = getHtmlElement({element.id}); if (document.querySelector(':active')) later(); else if (at)"
    ui.run_javascript(f"const later = () => setTimeout(() => {{ {wait} {{ {go} }} }}, {_DRAWN_MS}); later()")
