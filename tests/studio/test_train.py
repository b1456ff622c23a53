"""The train page in a real browser: trained, stopped, killed, gone on with; proved, compared, and refused in words."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import pytest

from support.browsing import LONG_MS, TABLET, axe, marked
from support.sharing import built_once
from support.trainings import evaluate_apart

pytestmark = pytest.mark.early

if TYPE_CHECKING:
    from playwright.sync_api import Page

Fixture = Callable[..., Any]
PHONE = (390, 844)
MADE = ("Back stroke 1", "Head stroke 2", "Hold in hands", "Hold strong", "Tail hit 1", "Tail pull", "Tail tap 1")
"""The gestures of the lighter data set, which also has recordings at rest."""


def fill(page: Page, name: str, text: str) -> None:
    field = page.locator(f'input[data-test="{name}"], [data-test="{name}"] input')
    field.fill(text)
    field.press("Tab")


def choose(page: Page, name: str, text: str) -> None:
    from playwright.sync_api import TimeoutError as TooSlow

    option = page.get_by_role("option", name=text).first
    for _ in range(100):
        # A list closes when the form is drawn again meanwhile, also between a look at it and the click.
        if not page.get_by_role("listbox").count():
            page.locator(f'[data-test="{name}"]').locator("xpath=ancestor-or-self::label").click()
        if option.is_visible():
            with contextlib.suppress(TooSlow):
                option.click(timeout=2000)
                break
        page.wait_for_timeout(100)
    else:
        raise AssertionError(f"{text} cannot be chosen")
    page.locator(".q-menu").wait_for(state="detached")


def kind(page: Page, name: str) -> None:
    """Choose another job than the recommended one, whose settings are folded away."""
    if not marked(page, "kind").is_visible():
        marked(page, "more").locator(".q-item").first.click()
    marked(page, "kind").get_by_role("radio", name=name).click()


def state(page: Page, wanted: str) -> Any:
    found = page.locator(f'[data-test="job"][data-state="{wanted}"]').first
    found.wait_for(timeout=LONG_MS)
    return found


def command(page: Page) -> list[str]:
    page.wait_for_function("() => document.querySelector('[data-test=command]').textContent.includes('plushsense')")
    return shlex.split(marked(page, "command").text_content())


@pytest.mark.exhaustive
def test_a_training_is_stopped_and_killed_and_ends_in_the_commands_bundle(
    studio: Fixture, look: Fixture, home: Path
) -> None:
    here = studio(home=home)
    browser = look()
    page = browser.open(f"{here.url}/train")
    marked(page, "facts").get_by_text("6 people, 106 recordings, 18 gestures").wait_for()
    assert marked(page, "facts").get_by_text("simulation", exact=True).is_visible()
    kind(page, "Train one network")
    fill(page, "name", "by page")
    fill(page, "epochs", "20")
    page.wait_for_function("() => document.querySelector('[data-test=command]').textContent.includes('--epochs 20')")
    asked = command(page)
    marked(page, "start").click()
    kept = home / "datasets" / "virtual" / "cache" / "unfinished"

    def under_way(least: int) -> None:
        page.wait_for_function(
            "(least) => +((document.querySelector('[data-test=at]')?.textContent.match(/epoch (\\d+) of/) || [])[1]"
            " || 0) >= least",
            arg=least,
            timeout=LONG_MS,
        )
        while not list(kept.glob("[!.]*.npz")):
            page.wait_for_timeout(20)

    under_way(3)
    assert page.locator('[data-test="curve-loss"] canvas').count() == 1
    assert axe(page) == []
    marked(page, "stop").click()
    state(page, "stopped")
    # Another tab, and one that comes later, show the same.
    other = browser.open(f"{here.url}/train")
    marked(other, "resume").click()
    under_way(8)
    here.kill()
    assert not (home / "bundles" / "by page.plush").exists()
    other.close()
    # A page that finds the studio again loads itself, which would cancel the loading below.
    page.goto("about:blank")
    here.start()
    page.goto(f"{here.url}/train")
    state(page, "stopped")
    marked(page, "resume").click()
    done = state(page, "done")
    verdict = done.locator('[data-test="score"]').inner_text()
    assert re.fullmatch(
        r"It reads about [\d.]+ of 10 touches of one person it never met; guessing gives 0.6 of 10.", verdict
    )
    # The curve ends at the figure of the sentence, which stands in the table, too.
    (figure,) = re.findall(r"^Accuracy ([\d.]+), macro-F1", done.locator('[data-test="result"]').inner_text())
    assert done.get_by_text("simulation", exact=True).is_visible()
    # The curve begins with the first epoch, though three runs drew it.
    (job,) = (json.loads(path.read_text(encoding="utf-8")) for path in (home / "work").glob("*.json"))
    first, second = ([r for r in job["reports"] if r["stage"] == s and "epoch" in r] for s in ("training", "refitting"))
    assert [[r["epoch"] for r in part] for part in (first, second)] == [list(range(1, 21)), list(range(1, 8))]
    assert f"{first[-1]['accuracy']:.3f}" == figure
    page.locator('[data-column="kind"]').get_by_text("training").nth(1).wait_for()
    assert page.locator('[data-row$="by page.plush"] [data-column="accuracy"]').inner_text() == figure
    by_page = (home / "bundles" / "by page.plush").read_bytes()
    assert not list(kept.glob("[!.]*.npz"))
    out = home / "bundles" / "by command.plush"
    asked[asked.index("--out") + 1] = str(out)
    subprocess.run([sys.executable, "-m", *asked], check=True, capture_output=True)
    assert out.read_bytes() == by_page
    # Its confusions lead to the recordings of the person that was held back.
    done.locator('[data-test="open-result"]').click()
    marked(page, "show-confusions").click()
    page.locator("[data-test=worst] [data-cell]").first.click()
    marked(page, "cell-list").wait_for()
    assert "dataset=" in (page.locator("[data-test=cell-list] a").first.get_attribute("href") or "")
    assert axe(page) == []
    assert [c for c in browser.complaints if "ERR_CONNECTION" not in c and "WebSocket" not in c] == []


@pytest.fixture(scope="session")
def lighter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of six virtual people and 7 of the gestures, on which jobs take half the time; read only."""
    from plushsense.recording.simulate import SimulationSpec, simulate
    from plushsense.workflow.api import import_simulation

    def build(draft: Path) -> None:
        simulate(draft / "made", SimulationSpec(people=6, repetitions=1, gestures=MADE))
        import_simulation(draft / "made", draft / "virtual", lambda *at: None)
        shutil.rmtree(draft / "made")

    return built_once(tmp_path_factory, "lighter", build) / "virtual"


@pytest.fixture
def light(lighter: Path, furniture: Path, tmp_path: Path) -> Path:
    """A home of one's own with the lighter data set and the trained bundle."""
    shutil.copytree(lighter, tmp_path / "home" / "datasets" / "virtual")
    shutil.copytree(furniture / "bundles", tmp_path / "home" / "bundles")
    return tmp_path / "home"


@pytest.fixture
def leaky(light: Path) -> Path:
    """A light home that also holds an evaluation over windows."""
    folder = light / "datasets" / "virtual"
    out = folder / "evaluations" / "leaky"
    evaluate_apart(folder, out, "--split", "windows:2", "--preset", "search", "--epochs", "1")
    return light


@pytest.mark.exhaustive
def test_a_proof_its_table_and_the_recordings_of_a_cell(studio: Fixture, look: Fixture, leaky: Path) -> None:
    home = leaky
    here = studio(home=home)
    browser = look()
    page = browser.open(f"{here.url}/train")
    kind(page, "Evaluate on people left out")
    choose(page, "split", "windows in 5 groups")
    marked(page, "split-about").get_by_text("so the score is too good").wait_for()
    choose(page, "split", "people in 5 groups")
    fill(page, "epochs", "2")
    marked(page, "split-about").get_by_text("too good").wait_for(state="detached")
    marked(page, "start").click()
    done = state(page, "done")
    result = done.locator('[data-test="result"]').inner_text()
    (figure,) = re.findall(r"^Accuracy ([\d.]+) ± .*; mean over 6 people, counted in windows\.", result)
    # The plot beneath shows each person; their mean is the figure of the sentence.
    bars = dict(row.split("\t")[:2] for row in done.locator("[data-test=people-bars] tbody tr").all_inner_texts())
    assert len(bars) == 8 and bars["Mean"] == figure
    assert done.locator('[data-test="score"]').inner_text().startswith("It reads about ")
    assert done.get_by_text("This figure is uncertain: it was measured on only 6 people.").is_visible()
    done.locator('[data-test="open-result"]').click()
    page.locator("[data-cell]").first.wait_for()

    # The table: the leaky one says so, numbers sort as numbers.
    marks = page.locator(".ps-mark-leaky")
    assert page.locator('tr[data-row$="/leaky"] .ps-mark-leaky').count() == 1 == marks.count()
    assert page.locator("[data-test=results] .ps-mark-simulation").count() == 3
    for column, order in (("accuracy", -1), ("accuracy", 1), ("parameters", 1)):
        page.locator(f'[data-do="sort:{column}"]').click()
        page.locator(
            f'th[aria-sort="{"descending" if order < 0 else "ascending"}"] [data-do="sort:{column}"]'
        ).wait_for()
        values = [
            float(t.split()[0].replace(",", "")) for t in page.locator(f"[data-column={column}]").all_inner_texts()
        ]
        assert len(values) == 3
        assert values == sorted(values, reverse=order < 0)

    # A cell: just those recordings, from the predictions as they lie on disk.
    polars = pytest.importorskip("polars")
    (folder,) = (home / "datasets" / "virtual" / "evaluations").glob("by-subject-5_*")
    table = polars.read_parquet(folder / "predictions.parquet")
    was, told, of = (table[name].to_list() for name in ("truth", "predicted", "recording"))
    counts = Counter(zip(was, told, strict=True))
    (truth, said), windows = next((k, n) for k, n in counts.most_common() if k[0] != k[1])
    wanted = {r for t, p, r in zip(was, told, of, strict=True) if (t, p) == (truth, said)}
    assert page.locator(".ps-confusion tbody tr").count() == len(MADE) + 1
    button = page.locator("[data-test=confusion] [data-cell]").filter(has_text=f"{truth} read as {said}.")
    assert button.inner_text().split()[0] == str(windows)
    button.click()
    marked(page, "cell-list").wait_for()
    listed = page.locator("[data-test=cell-list] [data-recording]").evaluate_all(
        "rows => rows.map((r) => r.dataset.recording)"
    )
    assert sorted(listed) == sorted(wanted)
    if sys.platform == "linux":
        # What reads the predictions takes 45 MB, and is loaded in a process of its own.
        assert "polars" not in Path(f"/proc/{here.process.pid}/maps").read_text()
    asked = urlsplit(marked(page, "cell-all").get_attribute("href"))
    query = parse_qs(asked.query)
    assert asked.path == "/review"
    assert query["dataset"] == [str(home / "datasets" / "virtual")]
    assert sorted(query["recordings"]) == sorted(wanted)
    assert query["title"] == [marked(page, "cell-title").inner_text()]
    review = browser.open(f"{here.url}{marked(page, 'cell-all').get_attribute('href')}")
    marked(review, "selection").wait_for()
    review.wait_for_function(
        "(n) => document.querySelectorAll('[data-test=table] tbody tr').length === n", arg=len(wanted)
    )
    for recording in wanted:
        assert review.locator("[data-test=table]").get_by_text(recording, exact=True).count() == 1, recording
    review.close()
    assert axe(page) == []

    # By affect: the sums, and the recordings behind them.
    marked(page, "by").get_by_role("radio", name="By affect").click()
    page.wait_for_function("() => document.querySelectorAll('.ps-confusion tbody tr').length === 3")
    affect = {g: a for a, gs in AFFECTS.items() for g in gs}
    read = Counter((affect[t], affect[p]) for (t, p), n in counts.items() for _ in range(n))
    pair = next(pair for pair, _ in read.most_common() if pair[0] != pair[1])
    cell = page.locator("[data-test=confusion] [data-cell]").filter(
        has_text=re.compile(rf"{pair[0]} read as \W*{pair[1]}")
    )
    assert cell.inner_text().split()[0] == str(read[pair])
    cell.click()
    page.get_by_text(f"{pair[0]} read as {pair[1]} (recordings").wait_for()
    mixed = {r for t, p, r in zip(was, told, of, strict=True) if (affect[t], affect[p]) == pair}
    listed = page.locator("[data-test=cell-list] [data-recording]").evaluate_all(
        "rows => rows.map((r) => r.dataset.recording)"
    )
    assert sorted(listed) == sorted(mixed)
    assert browser.complaints == []

    # In the dark, in Latvian, on a tablet: the same, and nothing to scroll sideways.
    for size, dark in ((TABLET, True), (PHONE, False)):
        later = look(size, dark, "lv")
        page = later.open(f"{here.url}/train")
        page.locator('[data-do^="open:"]').first.wait_for()
        page.locator('tr[data-row$="/leaky"] [data-do^="open:"]').click()
        page.locator("[data-cell]").first.wait_for()
        assert page.locator(".ps-mark-leaky").first.inner_text() == "noplūde"
        assert axe(page) == []
        assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
        # Nothing is in English: neither the marks nor the splits, contexts and figures.
        body = page.locator("#content").inner_text()
        assert re.findall(r"by-subject|validation|held back|windows:|\b0\.\d|\bpeople\b", body) == []
        assert later.complaints == []


@pytest.mark.exhaustive
def test_what_a_researcher_takes_away(studio: Fixture, look: Fixture, light: Path) -> None:
    pytest.importorskip("polars")
    dataset = light / "datasets" / "virtual"
    first, second = (dataset / "evaluations" / name for name in ("first", "second"))
    evaluate_apart(dataset, first, "--split", "by-subject:2", "--context", "loop", "--epochs", "12")
    shutil.copytree(first, second)
    # The other network reads each person a little worse: six of six, which is beyond chance.
    table = json.loads((second / "evaluation.json").read_text(encoding="utf-8"))
    table["config"]["training"]["seed"], table["id"] = 7, "other"
    for row in table["subjects"]:
        row["accuracy"] -= 0.0625
    (second / "evaluation.json").write_text(json.dumps(table), encoding="utf-8")
    here = studio(home=light)
    browser = look()
    page = browser.open(f"{here.url}/train")
    page.locator('tr[data-row$="/first"] [data-do^="open:"]').click()
    saved = {}
    for kind_of in ("html", "csv", "png"):
        with page.expect_download() as loaded:
            marked(page, f"save-{kind_of}").click()
        assert loaded.value.suggested_filename.endswith(f".{kind_of}")
        saved[kind_of] = Path(loaded.value.path()).read_bytes()
    assert saved["html"] == (first / "report.html").read_bytes()
    assert saved["png"].startswith(b"\x89PNG")
    head, *rows = csv.reader(saved["csv"].decode().splitlines())
    assert {"labels": [r[0] for r in rows], "counts": [[int(n) for n in r[1:]] for r in rows]} == table["confusion"]
    assert head == ["true", *table["confusion"]["labels"]]

    choose(page, "compare-with", "people, 12")
    said = marked(page, "comparison")
    said.get_by_text("Compared on 6 people").wait_for()
    assert "reads 6 of them better than the other one, and 0 worse. Its accuracy minus" in said.inner_text()
    assert "is 0.063 on average" in said.inner_text() or "is 0.062 on average" in said.inner_text()
    assert said.inner_text().endswith("p = 0.031). So this network is better, beyond chance.")
    assert axe(page) == []

    # One click: a network with these settings, trained on everybody, and its C; it has the score of the evaluation.
    score = marked(page, "details").locator('[data-test="score"]').inner_text()
    marked(page, "make-export").click()
    done = state(page, "done")
    assert done.locator('[data-test="score"]').inner_text() == score
    done.locator('[data-test="to-exported"]').click()
    marked(page, "export-facts").wait_for()
    (made,) = (light / "exports").iterdir()
    assert (made / "plush_model.c").is_file()
    page.goto(f"{here.url}/train")
    page.locator('tr[data-row$="/first"] [data-do^="open:"]').click()
    with page.expect_download() as loaded:
        marked(page, "save-plush").click()
    bundle = light / "bundles" / "virtual toy.plush"
    assert Path(loaded.value.path()).read_bytes() == bundle.read_bytes()
    assert marked(page, "make-export").count() == 0, "there is one"
    assert browser.complaints == []


AFFECTS = {
    "neutral": ["At rest", "Hold in hands"],
    "negative": ["Tail hit 1", "Tail hit 2", "Tail pull"],
    "positive": [
        "Back stroke 1", "Back stroke 2", "Ear scratch 1", "Ear scratch 2", "Head stroke 1", "Head stroke 2",
        "Hold strong", "Neck scratch 1", "Neck scratch 2", "Tail scratch 1", "Tail scratch 2", "Tail tap 1",
        "Tail tap 2",
    ],
}  # fmt: skip

_GRID = """[grid]
architectures = ["14d1_5d1", "9d1_5d1"]
filters = [[4, 4], [8, 8]]
epochs = [1]
batches = [64]
split = "windows:holdout"
"""


@pytest.mark.exhaustive
def test_a_sweep_shows_its_cost_first_and_its_front_in_the_end(studio: Fixture, look: Fixture, light: Path) -> None:
    home = light
    # As many threads as there are cores: their networks are trained in the process of the job, not in processes of
    # their own, which would each load PyTorch again for each rung. The tests' own os.cpu_count() is 1.
    grid = _GRID.replace("[grid]", f"[grid]\nthreads = {len(os.sched_getaffinity(0))}")
    (home / "tiny.toml").write_text(grid, encoding="utf-8")
    (home / "little.toml").write_text(grid.replace("epochs = [1]", "epochs = [1, 2]"), encoding="utf-8")
    (home / "wrong.toml").write_text('[grid]\nepochs = [0]\narchitectures = ["14x"]\n', encoding="utf-8")
    browser = look()
    page = browser.open(f"{studio(home=home).url}/train")
    kind(page, "Compare many networks")
    marked(page, "split-about").get_by_text("leaky", exact=True).first.wait_for()
    choose(page, "grid", "wrong.toml")
    marked(page, "estimate").click()
    marked(page, "plan").get_by_role("alert").wait_for(timeout=LONG_MS)
    said = marked(page, "plan").inner_text()
    assert "Epochs 0 cannot be trained" in said
    assert "14x" in said
    assert axe(page) == []
    choose(page, "grid", "tiny.toml")
    marked(page, "start").click()
    marked(page, "message").get_by_text("Look at the cost first").wait_for()
    marked(page, "estimate").click()
    marked(page, "plan-text").wait_for(timeout=LONG_MS)
    assert "4 trials in 4 trainings (folds: 1, seeds: 1), 0 done before" in marked(page, "plan-text").inner_text()
    marked(page, "plan").get_by_text("leaky", exact=True).first.wait_for()
    assert axe(page) == []
    marked(page, "start").click()
    done = state(page, "done")
    assert "but this test is too easy" in done.locator('[data-test="score"]').inner_text()
    done.get_by_text("leaky", exact=True).first.wait_for()
    drawn = marked(page, "pareto")
    drawn.wait_for()
    # At least the labels of the front do not overlap; the table holds all points.
    drawn.locator("text", has_text="(leaky)").first.wait_for()
    marked(page, "pareto-data").click()
    assert marked(page, "pareto-table").locator("tbody tr", has_text="(leaky)").count() == 4
    assert marked(page, "pareto-marks").inner_text().split() == ["simulation", "leaky"]
    done.locator('[data-test="open-result"]').click()
    marked(page, "confusion").wait_for()
    # The predictions of the best network are stored.
    page.locator("[data-test=worst] [data-cell]").first.click()
    marked(page, "cell-list").wait_for()
    assert axe(page) == []

    # The best of them by halving, within a limit.
    kind(page, "Find a small network")
    choose(page, "grid", "little.toml")
    choose(page, "split", "15 % of the windows")
    fill(page, "max_parameters", "1400")
    marked(page, "estimate").click()
    marked(page, "plan-text").get_by_text("networks compared after 1, 2 epochs, 1 beyond").wait_for(timeout=LONG_MS)
    marked(page, "start").click()
    found_job = page.locator('[data-test="job"][data-state="done"]', has_text="Find a small network")
    found_job.wait_for(timeout=LONG_MS)
    (found,) = (home / "datasets" / "virtual" / "evaluations").glob("sweep-little-*")
    best = json.loads((found / "sweep.json").read_text(encoding="utf-8"))["halving"]["winner"]
    assert best["parameters"] <= 1400
    assert f"macro-F1 {best['macro_f1']:.3f}" in found_job.locator('[data-test="result"]').inner_text()
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_what_is_wrong_is_named_beside_its_field(studio: Fixture, look: Fixture, home: Path) -> None:
    little = (home / "bundles" / "little.plush").read_bytes()
    folder = home / "datasets" / "virtual"
    (folder / "evaluations").write_text("in the way", encoding="utf-8")
    browser = look(language="lv")
    page = browser.open(f"{studio(home=home).url}/train")

    def beside(field: str) -> Any:
        box = page.locator(f'[data-test="{field}"]').locator("xpath=ancestor-or-self::label")
        return box.locator(".q-field__messages")

    fill(page, "minutes", "daudz")
    marked(page, "make").click()
    beside("minutes").get_by_text("Ievadiet veselu skaitli no 1 līdz 600.").wait_for()
    assert axe(page) == []
    fill(page, "minutes", "10")
    beside("minutes").get_by_text("Ievadiet").wait_for(state="detached")
    kind(page, "Apmācīt vienu tīklu")
    fill(page, "name", "little")
    marked(page, "start").click()
    beside("name").get_by_text("jau ir. Dodiet citu nosaukumu").wait_for()
    fill(page, "name", "other")
    fill(page, "epochs", "lots")
    marked(page, "start").click()
    beside("epochs").get_by_text("Ievadiet veselu skaitli no 1").wait_for()
    fill(page, "epochs", "")
    marked(page, "advanced").locator(".q-item").first.click()
    fill(page, "arch", "14x")
    # By the keyboard, as the button still moves while the settings above it open.
    marked(page, "start").press("Enter")
    beside("arch").get_by_text("Tas nav tīkls").wait_for()
    fill(page, "arch", "")
    assert axe(page) == []
    kind(page, "Pārbaudīt ar svešiem cilvēkiem")
    marked(page, "start").click()
    refused = state(page, "refused").locator('[data-test="refused"]')
    assert refused.inner_text() == (
        "Rezultātu nevar ierakstīt: „evaluations” ir fails, nevis mape. Pārvietojiet vai pārdēvējiet to."
    )
    shutil.move(folder, home / "elsewhere")
    marked(page, "make").click()
    beside("dataset").get_by_text("Datu kopas „virtual” vairs nav").wait_for()
    assert (home / "bundles" / "little.plush").read_bytes() == little
    assert [path.name for path in (home / "bundles").iterdir()] == ["little.plush"]
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_one_button_makes_a_network_that_a_stop_does_not_lose(studio: Fixture, look: Fixture, few: Path) -> None:
    browser = look(PHONE, language="lv")
    page = browser.open(f"{studio(home=few).url}/train")
    button = marked(page, "make")
    button.wait_for()
    assert page.evaluate("(b) => b.getBoundingClientRect().bottom <= innerHeight", button.element_handle())
    page.evaluate(
        "() => { const draw = CanvasRenderingContext2D.prototype.fillText; window.drawn = new Set();"
        " CanvasRenderingContext2D.prototype.fillText = function (text, ...at) { window.drawn.add(String(text));"
        " draw.call(this, text, ...at); }; }"
    )
    button.click()
    # While the network is tested, it is saved already.
    page.wait_for_function(
        "() => document.querySelector('[data-test=at]')?.textContent.includes('pārbauda ar svešiem cilvēkiem')",
        timeout=LONG_MS,
    )
    numbers = [text for text in page.evaluate("() => [...window.drawn]") if re.fullmatch(r"[0-9.,]+", text)]
    assert any("," in text for text in numbers) and not any("." in text for text in numbers)
    marked(page, "stop").click()
    stopped = state(page, "stopped")
    network = few / "bundles" / "virtual toy.plush"
    saved = network.read_bytes()
    assert "„virtual toy” ir saglabāts" in stopped.locator('[data-test="saved"]').inner_text()
    assert stopped.locator('[data-test="to-live"]').is_visible()
    assert axe(page) == []
    marked(page, "resume").click()
    done = state(page, "done")
    assert network.read_bytes() == saved
    assert "No 10 pieskārieniem, ko veic tīklam sveši cilvēki" in done.locator('[data-test="score"]').inner_text()
    assert done.get_by_text("pārbaudē piedalījās tikai 3 cilvēki").is_visible()
    assert done.get_by_text("Nav mērīts, ko dotu vairāk cilvēku.").is_visible()
    assert done.get_by_text("simulācija", exact=True).is_visible()
    page.locator('[data-column="kind"]').get_by_text("pārbaude").wait_for()
    assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
    assert axe(page) == []
    assert browser.complaints == []
