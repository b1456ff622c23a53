"""Every page opens, in both languages and lights, and nothing on it is beyond reach."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode
from xml.dom import minidom

import pytest

from plushsense.dataset.importing.importers import import_recordings
from plushsense.deploy.code import FACTS
from plushsense.recording.writer import SESSION_HEAD, SESSION_LOG
from plushsense.studio.app import shell
from plushsense.studio.app.shell import LIGHT_COOKIE, PAGES, TOUR, page_texts
from plushsense.studio.app.stored_results import Confusion
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.review.controller import VIEWS
from plushsense.studio.pages.train.result_details import confusion_table
from plushsense.studio.widgets.elements import link, picture, verdict
from plushsense.workflow.api import simulate
from plushsense.workflow.reporting import SCORES
from support.browsing import DESK, PHONE, TABLET, Studio, axe, connected, marked
from support.recorded import record
from support.study import evaluation

pytestmark = pytest.mark.early

Fixture = Callable[..., Any]
_IN_VIEW = "e => { const r = e.getBoundingClientRect(); return r.left >= 0 && r.right <= innerWidth }"


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of an empty studio that all tests may look at."""
    one = Studio(tmp_path_factory.mktemp("empty") / "home").start()
    yield one.url
    one.stop()
    assert not [line for line in one.errors if "Traceback" in line], "".join(one.errors)


def test_the_first_page_imports_little() -> None:
    """Each of these modules would make everybody wait who starts the studio."""
    code = (
        "import sys, plushsense.cli.studio, plushsense.studio.app.serve, plushsense.studio.pages.home.home_page as _\n"
        "print(*(m for m in sys.modules if m.startswith('plushsense.') or '.' not in m))"
    )
    found = set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())
    assert found.isdisjoint({"babel", "matplotlib", "pandas", "polars", "sklearn", "torch"})
    packages = ("dataset.publishing", "dataset.quality", "deploy", "models", "runtime", "training", "workflow")
    assert [m for m in sorted(found) if m.removeprefix("plushsense.").startswith(packages)] == []
    # Of 112 before.
    assert sum(m.startswith("plushsense.") for m in found) < 75


@pytest.mark.parametrize(
    ("language", "dark", "size"),
    [("en", False, DESK), ("lv", True, PHONE)],
    ids=["en-light-desk", "lv-dark-phone"],
)
@pytest.mark.exhaustive_for("en-light-desk")
def test_pages_open_without_complaint(
    language: str, dark: bool, size: tuple[int, int], empty: str, look: Fixture
) -> None:
    browser = look(size, dark, language, own=True)
    for name, path in PAGES.items():
        page = browser.open(empty + path)
        assert marked(page, "title").inner_text()
        assert axe(page) == [], name
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{name} scrolls sideways"
        assert page.locator(".ps-bar [aria-current]").evaluate(_IN_VIEW), name
        browser.leave(page)
    assert browser.complaints == []
    # The icons are drawn, see `icons.js`: their font would be a third of a page.
    fonts = [url for url in browser.asked if url.endswith(".woff2")]
    assert len(set(fonts)) <= 2, fonts


@pytest.mark.parametrize(
    ("page", "text"),
    [
        ("review", "There is no data set yet"),
        ("train", "There are no results yet"),
        ("export", "Train one first"),
        ("publish", "There is no data set yet"),
    ],
)
def test_an_empty_page_says_what_to_do(page: str, text: str, empty: str, look: Fixture) -> None:
    look().open(empty + PAGES[page]).get_by_text(text).first.wait_for()


def test_every_icon_is_drawn() -> None:
    folder = Path(shell.__file__).parent
    drawn = set(re.findall(r"(?m)^  ([a-z0-9_]+): \[", (folder / "icons.js").read_text(encoding="utf-8")))
    source = "\n".join(path.read_text(encoding="utf-8") for path in folder.parent.rglob("*.py"))
    named = set(re.findall(r'(?:icon=|ui\.icon\(|icon_button\(\s*)"([a-z0-9_]+)"', source))
    assert len(named) > 20
    assert named - drawn == set()


def test_a_first_page_is_small(empty: str, look: Fixture) -> None:
    browser = look(own=True)
    page = browser.context.new_page()
    session = browser.context.new_cdp_session(page)
    session.send("Network.enable")
    sizes: list[float] = []
    session.on("Network.loadingFinished", lambda event: sizes.append(event["encodedDataLength"]))
    page.goto(empty)
    connected(page)
    assert 100_000 < sum(sizes) <= 400_000


@pytest.mark.exhaustive
def test_help_and_tour(empty: str, look: Fixture) -> None:
    browser = look()
    page = browser.open(empty + PAGES["publish"])
    marked(page, "open-help").click()
    marked(page, "help").wait_for()
    assert "makes a package" in marked(page, "help").inner_text()
    assert axe(page) == []
    marked(page, "tour").click()
    for n, (name, path) in enumerate(PAGES.items(), 1):
        page.wait_for_url(f"{empty}{path}?{TOUR}=1")
        step = marked(page, "tour-step")
        assert page_texts(name).tour in step.inner_text()
        connected(page)
        marked(page, "tour-next" if n < len(PAGES) else "tour-end").click()
    page.wait_for_url(empty + "/")
    assert marked(page, "tour-step").count() == 0
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_language_and_light_are_kept(empty: str, look: Fixture) -> None:
    browser = look()
    page = browser.open(empty)
    assert marked(page, "title").inner_text() == "Home"
    assert page.title() == "Home · PlushSense"
    with page.expect_navigation():
        marked(page, "language").get_by_text("LV").click()
    assert marked(page, "title").inner_text() == "Sākums"
    assert page.title() == "Sākums · PlushSense"
    assert page.evaluate("document.documentElement.lang") == "lv"
    marked(page, "light").click()
    marked(page, "light-dark").wait_for()
    assert axe(page) == []
    with page.expect_navigation():
        marked(page, "light-dark").click()
    page.wait_for_selector("body.body--dark")
    page.reload()
    assert marked(page, "title").inner_text() == "Sākums"
    assert page.locator("body.body--dark").count() == 1
    connected(page)
    marked(page, "light").click()
    with page.expect_navigation():
        marked(page, "light-system").click()
    page.wait_for_selector("body.body--light")
    assert browser.complaints == []


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("chosen", ["", "light", "dark"])
def test_no_flash_of_the_wrong_light(dark: bool, chosen: str, empty: str, look: Fixture) -> None:
    """What stands there before any script has run is of the right light already."""
    browser = look(dark=dark, own=True)
    if chosen:
        browser.context.add_cookies([{"name": LIGHT_COOKIE, "value": chosen, "url": empty}])
    browser.context.route("**/*.js", lambda route: route.abort())
    page = browser.context.new_page()
    page.goto(empty, wait_until="commit")
    page.wait_for_selector("html > head > style", state="attached")
    page.wait_for_selector("#app", state="attached")
    night = page.evaluate("getComputedStyle(document.documentElement).backgroundColor") == "rgb(18, 18, 18)"
    assert night is (chosen == "dark" or (dark and not chosen))


def test_a_lost_connection_is_said_and_found_again(studio: Fixture, look: Fixture) -> None:
    one = studio()
    said = {"en": "connection to the studio is lost", "lv": "ir zudis"}
    pages = {language: look(language=language).open(one.url) for language in said}
    one.kill()
    for language, page in pages.items():
        box = page.locator('#popup[aria-hidden="false"]')
        box.wait_for()
        assert said[language] in box.inner_text()
        assert box.get_attribute("role") == "alert"
    one.start()
    for page in pages.values():
        connected(page)
        assert marked(page, "title").count() == 1


def test_the_first_key_leads_to_the_content(empty: str, look: Fixture) -> None:
    page = look().open(empty + PAGES["publish"])
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "content"
    # The focus of everything that the Tab key reaches is visible.
    for _ in range(12):
        page.keyboard.press("Tab")
        at = page.evaluate("(e => [e.tagName, e.innerText, getComputedStyle(e).outlineWidth])(document.activeElement)")
        assert at[2] == "3px" or at[0] in ("INPUT", "BODY"), at
    assert page.get_by_role("main").count() == 1
    assert page.locator("[aria-current=page]").inner_text() == "Publish"


@pytest.mark.exhaustive
def test_the_bar_is_one_row_on_a_tablet(empty: str, look: Fixture) -> None:
    for language in ("en", "lv"):
        page = look(TABLET, language=language, touch=True).open(empty)
        tops = page.evaluate("[...document.querySelectorAll('.ps-bar a')].map(a => a.getBoundingClientRect().top)")
        assert len(set(tops)) == 1, language
        box = page.locator(".ps-header").bounding_box()
        assert box is not None and box["height"] < 70
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_nothing_is_made_where_the_studio_was_started(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    one = studio()
    look().open(one.url)
    assert [p.name for p in tmp_path.iterdir()] == ["home"]
    assert [p.name for p in (tmp_path / "home").iterdir()] == ["work"]


HOSTILE = "<img src=x onerror='window.ran=1'>"
RUNS = "javascript:window.ran=1"
WAYS = re.compile(
    r"ui\.(?:html|markdown|add_\w+)\(|sanitize=False|from html import|innerHTML|outerHTML|insertAdjacent|v-html"
)


def test_html_is_made_in_one_way() -> None:
    folder = Path(shell.__file__).parents[1]
    sources = [p for kind in ("*.py", "*.js") for p in folder.rglob(kind) if "vendor" not in p.parts]
    found = {
        f"{path.name}: {line.strip()}"
        for path in sources
        for line in path.read_text("utf-8").splitlines()
        if WAYS.search(line)
    }
    assert found == {
        "shell.py: return ui.html(content, sanitize=lambda given: str(escape(given)), tag=kind)",
        'shell.py: ui.add_head_html(f"<style>{css}</style>")',
        # One of three drawings of ours.
        "live_view.js: this.n.face.innerHTML = face(eyes);",
    }


def test_no_value_is_put_into_html_unescaped() -> None:
    """`Markup` is only made of constants, and of strings whose fields are constants of ours."""
    folder = Path(shell.__file__).parents[1]
    made = {
        f"{path.name}: {ast.unparse(node.args[0])}"
        for path in folder.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("Markup")
        if not isinstance(node.args[0], ast.Constant)
    }
    assert {name.partition(":")[0] for name in made} == {"elements.py", "home_page.py", "results_section.py"}
    assert len(made) == 5


def test_what_is_filled_in_is_escaped() -> None:
    words = Words("en")
    confusion = Confusion((HOSTILE, "b"), ((1, 2), (3, 4)))
    made = [
        confusion_table(words, confusion, False, True),
        picture("", HOSTILE),
        verdict(True, HOSTILE),
        link(HOSTILE, f'/export?name="{HOSTILE}'),
    ]
    for each in made:
        assert "<img" not in each and "&lt;img" in each
        minidom.parseString(each)


def hostile_home(home: Path, made: Path) -> Path:
    """A home whose every folder, file, person, gesture and title has a name that is HTML; its data set."""
    session = record(Workspace(home), "S01").rename(home / "recordings" / "S01" / HOSTILE)
    head = json.loads((session / SESSION_HEAD).read_text("utf-8"))
    taken = {"what": "take", "at_ms": 1, "file": f"{HOSTILE}_1_2.csv", "gesture": HOSTILE, "repetition": 1, "rows": 2}
    with (session / SESSION_LOG).open("a", encoding="utf-8") as log:
        log.write(json.dumps(taken) + "\n")
    # A session that was never finished: the page Record lists it by the names of its head.
    unfinished = Path(shutil.copytree(session, home / "recordings" / HOSTILE / HOSTILE))
    head |= {"subject": HOSTILE, "session": HOSTILE, "device": f"tcp://{HOSTILE}"}
    head["protocol"] |= {"name": HOSTILE, "title": HOSTILE}
    (unfinished / SESSION_HEAD).write_text(json.dumps(head), "utf-8")
    (unfinished / SESSION_LOG).write_text("", "utf-8")
    simulate(made, people=1, repetitions=1)
    for path in (made / "P01").glob("Back stroke 1*.csv"):
        path.rename(path.with_name(path.name.replace("Back stroke 1", HOSTILE)))
    dataset = import_recordings(made, home / "datasets" / HOSTILE, layout="plush-15", name=HOSTILE).dataset.path
    # An import takes such characters out of the codes of people.
    (dataset / "recordings" / "P01").rename(dataset / "recordings" / HOSTILE)
    for index in ("recordings.csv", "index.json"):
        (dataset / index).unlink()
    scored = {
        **evaluation(HOSTILE, HOSTILE, HOSTILE, 0.6, people=3),
        "model": {"symbol": HOSTILE, "filters": [HOSTILE], "padding": HOSTILE, "parameters": 9, "macs_per_step": 9},
        "config": {
            "preset": HOSTILE,
            "training": {"epochs": HOSTILE},
            "windows": {"context": HOSTILE},
            "evaluation": {"train_context": ""},
        },
        "dataset": {"name": HOSTILE, "hash": HOSTILE},
        "simulated": True,
        "over": "subjects",
        "pooled": {"accuracy": 0.6},
        "code_version": HOSTILE,
    }
    scored["confusion"]["labels"] = [f"{HOSTILE}{k}" for k in range(len(scored["confusion"]["labels"]))]
    for one in (*scored["subjects"], *scored["per_class"]):
        one["subject" if "subject" in one else "label"] = HOSTILE
    for name in (HOSTILE, "a"):
        (dataset / "evaluations" / name).mkdir(parents=True)
        (dataset / "evaluations" / name / SCORES).write_text(json.dumps(scored), "utf-8")
    (dataset / "evaluations" / "a" / "picture.svg").write_text(f"<svg onload='window.ran=1'>{HOSTILE}</svg>", "utf-8")
    for kind, suffix in (("bundles", ".plush"), ("protocols", ".toml"), ("packages", ".zip"), ("backups", ".zip")):
        (home / kind).mkdir(exist_ok=True)
        (home / kind / f"{HOSTILE}{suffix}").write_text("{", "utf-8")
    for folder in (f"exports/{HOSTILE}", f"discarded/bundles/{HOSTILE}", f"discarded/recordings/S02/{HOSTILE}"):
        (home / folder).mkdir(parents=True)
    (home / "exports" / HOSTILE / FACTS).write_text("{", "utf-8")
    return dataset


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such names")
def test_no_name_runs_as_script(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    home = tmp_path / "home"
    dataset = hostile_home(home, tmp_path / "made")
    browser, url = look(), studio("--device", f"replay:///{HOSTILE}", home=home).url
    pages = [PAGES[name] for name in ("home", "record", "train", "live")]
    pages += [f"{PAGES[name]}?name={quote(HOSTILE)}" for name in ("export", "publish")]
    pages += [f"/review?{urlencode({'dataset': dataset, 'view': view})}" for view in VIEWS]
    for path in (*pages, f"/record?session={quote(f'{HOSTILE}/{HOSTILE}')}"):
        page = browser.open(url + path)
        page.get_by_text(HOSTILE).first.wait_for(state="attached")
        if path == PAGES["train"]:
            # The tables of the details, by gesture and by affect, and the plot of both results.
            page.locator("[data-row] button").first.click()
            marked(page, "confusion").get_by_text(HOSTILE).first.wait_for()
            marked(page, "people").get_by_text(HOSTILE).first.wait_for()
            marked(page, "pareto").wait_for()
        # What runs when a picture is missing runs after the picture was asked for.
        page.wait_for_load_state("networkidle")
        assert page.locator("img[src=x]").count() == 0, path
        assert page.evaluate("window.ran") is None, path
        browser.leave(page)
    assert browser.complaints == []
    # Even where a name became HTML, the policy would keep it from running.
    page = browser.open(url)
    page.evaluate("html => document.body.insertAdjacentHTML('beforeend', html)", f"{HOSTILE}<a href='{RUNS}'>run</a>")
    page.locator("img[src=x]").wait_for(state="attached")
    page.get_by_role("link", name="run").click()
    page.wait_for_load_state("networkidle")
    assert page.evaluate("window.ran") is None
    assert len([c for c in browser.complaints if "Content Security Policy" in c]) == 2
