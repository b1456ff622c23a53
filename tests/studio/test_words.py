"""The languages say the same things."""

from __future__ import annotations

import ast
import re
import string
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from plushsense.core import errors
from plushsense.core.errors import ConfigError
from plushsense.core.gestures import load_gestures
from plushsense.core.sentences import Sentence
from plushsense.dataset.quality.checking import CHECKS
from plushsense.studio.app.words import LANGUAGES, Words


def texts(language: str) -> dict[str, Any]:
    """Return the tables of a language, those of the pages' own files too."""
    studio, tables = Path(str(resources.files("plushsense.studio"))), dict[str, Any]()
    for path in (studio / f"app/words/{language}.toml", *studio.glob(f"pages/*/{language}.toml")):
        for table, entries in tomllib.loads(path.read_text(encoding="utf-8")).items():
            assert not set(tables.get(table, {})) & set(entries), f"{path} repeats texts of another page"
            tables[table] = tables.get(table, {}) | entries
    return tables


def fields(text: str) -> set[str]:
    return {name for _, name, _, _ in string.Formatter().parse(text) if name}


@pytest.mark.parametrize("language", [code for code in LANGUAGES if code != "en"])
def test_every_key_is_there_with_the_same_fields(language: str) -> None:
    english, other = texts("en"), texts(language)
    assert set(english) == set(other)
    for table in set(english) - {"gestures", "channels"}:
        assert set(english[table]) == set(other[table]), table
        for key, text in english[table].items():
            assert other[table][key].strip(), f"{table}.{key} is empty"
            assert fields(other[table][key]) == fields(text), f"{table}.{key}"


@pytest.mark.parametrize("language", [code for code in LANGUAGES if code != "en"])
def test_every_gesture_of_the_toy_has_a_name(language: str) -> None:
    assert set(texts(language)["gestures"]) >= set(load_gestures("plush-18").labels)


def test_a_gesture_without_a_name_reads_as_its_label() -> None:
    assert Words("lv").gesture("Custom") == "Custom"
    assert Words("en").gesture("Tail pull") == "Tail pull"


def test_values_are_filled_in() -> None:
    said = Words("en")("sentences.system", where=" ('x')", why="no room")
    assert said == "The computer refused: no room ('x')."


def test_an_error_is_worded_in_the_language_of_the_page() -> None:
    known = ConfigError("'a' exists already.", reason="name_exists", name="a")
    assert Words("en").error(known).startswith("“a” exists already")
    assert Words("lv").error(known).startswith("“a” jau ir")
    other = ConfigError("Use --subject.")
    assert Words("en").error(other) == "Use --subject."
    assert Words("lv").error(other) == "Tas neizdevās. Programmas ziņa angliski: Use --subject."


def test_a_note_is_worded_in_the_language_of_the_page_also_after_json() -> None:
    inner = Sentence("not a recording", reason="file_no_recording")
    note = Sentence("a.txt: not a recording", reason="about_file", file="a.txt", note=inner)
    stored = {"message": "", "reason": note.reason, "values": {"file": "a.txt", "note": vars(inner) | {"message": ""}}}
    for form in (note, stored):
        assert Words("en").sentence(form) == "a.txt: no recording"
        assert Words("lv").sentence(form) == "a.txt: nav ieraksts"
    assert Words("lv").sentence("something") == "(Angliski:) something"
    older = {"message": "a.txt is left out", "reason": "about_file", "values": {}}
    assert Words("lv").sentence(older) == "(Angliski:) a.txt is left out"
    assert (Words("en").count(12345), Words("lv").count(12345)) == ("12,345", "12\u00a0345")
    assert (Words("en").significant(0.1234, 2), Words("lv").significant(0.1234, 2)) == ("0.12", "0,12")


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(
    "value",
    [
        None, [], [""][1:], ["a"], ["a", "b"], 0, 1, 2, 0.5, "a", "a.", Sentence("It is a."),
        Sentence("x", reason="layout_guessed", layout="phone-6"), [Sentence("It is a."), Sentence("It is b.")],
    ],
)  # fmt: skip
def test_every_sentence_reads_well_with_no_one_and_many_values(language: str, value: Any) -> None:
    words = Words(language)
    for key, text in words.table("sentences").items():
        said = words.sentence(Sentence("", key, **dict.fromkeys(fields(text), value)))
        assert not re.search(r"None|\bnan\b|\[\]|\{|\.\.(?!\.)|  | [.,:;]|: ?[.;]|\(\)|“”|''", said), f"{key}: {said}"


def made() -> Iterator[tuple[str, str, dict[str | None, ast.expr]]]:
    """Yield place, name and arguments of every `Sentence` and every error that the source makes."""
    package = Path(str(resources.files("plushsense")))
    for module in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            name = getattr(node.func, "id", getattr(node.func, "attr", "")) if isinstance(node, ast.Call) else ""
            if isinstance(node, ast.Call) and (name == "Sentence" or isinstance(getattr(errors, name, None), type)):
                given = {keyword.arg: keyword.value for keyword in node.keywords}
                if name == "Sentence" and len(node.args) > 1:
                    given["reason"] = node.args[1]
                yield f"{module.relative_to(package).as_posix()}:{node.lineno}", name, given


def reasons(node: ast.expr | None) -> list[str]:
    """Return the possible values of an expression, as patterns; none for a variable."""
    if isinstance(node, ast.Constant):
        return [str(node.value)]
    if isinstance(node, ast.IfExp):
        return [*reasons(node.body), *reasons(node.orelse)]
    if isinstance(node, ast.JoinedStr):
        parts = [[v.value] if isinstance(v, ast.Constant) else ["[a-z_]*"] for v in node.values]
        return ["".join(str(part) for each in parts for part in each)]
    return []


def test_every_reason_has_a_text_with_its_values() -> None:
    known = Words("en").table("sentences")
    seen = 0
    for place, _, given in made():
        for pattern in reasons(given.pop("reason", None)):
            fitting = [key for key in known if re.fullmatch(pattern, key)]
            assert fitting or not pattern, f"{place}: sentences.{pattern} has no text"
            seen += len(fitting)
            assert None in given or all(fields(known[key]) <= set(given) for key in fitting), place
    assert seen > 100


def test_no_sentence_is_unused() -> None:
    package = Path(str(resources.files("plushsense")))
    source = "\n".join(
        module.read_text(encoding="utf-8").replace("from __future__ import annotations", "")
        for module in package.rglob("*.py")
    )
    built = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.JoinedStr)]
    patterns = {p for node in built for p in reasons(node) if re.fullmatch("[a-z_]{4,}", p.replace("[a-z_]*", ""))}
    unused = {
        key
        for key in Words("en").table("sentences")
        if f'"{key}"' not in source
        and f"sentences.{key}" not in source
        and not any(re.fullmatch(pattern, key) for pattern in patterns)
    }
    assert unused == set()


def test_every_error_of_the_studio_has_a_reason() -> None:
    """Otherwise a page in another language would quote an English sentence."""
    # Errors of `serve` are printed in the terminal.
    places = {
        place: "reason" in given for place, name, given in made() if name != "Sentence" and place.startswith("studio/")
    }
    lacking = {place for place, has in places.items() if not has and "/serve.py" not in place}
    assert lacking == set()


def test_every_check_has_a_name_and_advice_in_each_language() -> None:
    for language in LANGUAGES:
        words = Words(language)
        assert all(words.get(f"checks.{name}") and words.get(f"advice.{name}") for name in CHECKS)


def constant_keys(module: Path) -> set[str]:
    """Return the keys of all texts that a module names literally, as in ``words("home.next")``."""
    calls = [node for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    named = {"words", "_words", "w"}
    return {
        str(call.args[0].value)
        for call in calls
        if (call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")) in named
        and call.args
        and isinstance(call.args[0], ast.Constant)
    }


def test_every_key_that_the_source_names_has_a_text() -> None:
    folder = Path(str(resources.files("plushsense.studio")))
    words = Words("en")
    keys = {key: module.name for module in folder.rglob("*.py") for key in constant_keys(module)}
    assert len(keys) > 300
    assert {key: module for key, module in keys.items() if not words.get(key)} == {}


def test_every_text_that_the_live_view_names_is_there() -> None:
    script = resources.files("plushsense.studio.pages.live").joinpath("live_view.js").read_text(encoding="utf-8")
    names = set(re.findall(r"\b(?:w|this\.words)\.([a-z_]+)\b", script))
    assert len(names) > 20
    assert names <= set(Words("en").table("live"))
