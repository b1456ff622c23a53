"""Every text of the studio has a translation with the same values, and every translation a text."""

from __future__ import annotations

import ast
import re
import string
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from babel.messages.pofile import read_po

from plushsense.core import errors
from plushsense.core.errors import BadInput, ConfigError, DeviceError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import layout_names, load_layout
from plushsense.core.sentences import Message
from plushsense.dataset.quality.checking import CHECKS
from plushsense.live.adaptation import PersonalSpec, _require_gestures
from plushsense.studio.app.stored_results import duration_text
from plushsense.studio.app.words import LANGUAGES, Words, in_context
from plushsense.studio.pages.live.feed import VIEW_TEXTS

pytestmark = pytest.mark.apart("hostile-results")

PACKAGE = Path(str(resources.files("plushsense")))
FILES = sorted((PACKAGE / "studio" / "locale").glob("*.po"))
TRANSLATORS = {"words", "_words", "w"}
MESSAGES = {"Message", "error", "doubt", *(name for name, kind in vars(errors).items() if isinstance(kind, type))}


class Source(NamedTuple):
    """What the source has to say: its string constants, the texts to translate, the values of each template."""

    constants: set[str]
    texts: dict[str, str]
    values: dict[str, set[str]]
    untranslatable: list[str]


def fields(text: str) -> set[str]:
    return {re.split(r"[.!:\[]", name)[0] for _, name, _, _ in string.Formatter().parse(text) if name}


def texts_of(node: ast.expr) -> list[str]:
    """Return the texts that an expression may be."""
    if isinstance(node, ast.IfExp):
        return [*texts_of(node.body), *texts_of(node.orelse)]
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "in_context":
        context, text = (str(each.value) for each in node.args if isinstance(each, ast.Constant))
        return [in_context(context, text)]
    return [node.value] if isinstance(node, ast.Constant) and isinstance(node.value, str) else []


@cache
def source() -> Source:
    found = Source(set(), {}, {}, [])
    for module in sorted(PACKAGE.rglob("*.py")):
        place = module.relative_to(PACKAGE).as_posix()
        tree = ast.parse(module.read_text(encoding="utf-8"))
        nodes = list(ast.walk(tree))
        keywords = {k.arg for node in nodes if isinstance(node, ast.Call) for k in node.keywords if k.arg}
        dicts = [node for node in nodes if isinstance(node, ast.Dict)]
        keywords |= {str(key.value) for node in dicts for key in node.keys if isinstance(key, ast.Constant)}
        for node in nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.constants.add(node.value)
                found.values.setdefault(node.value, set()).update(keywords)
            elif (
                isinstance(node, ast.AnnAssign)
                and place.startswith("studio/")
                and ast.unparse(node.annotation) == "Texts"
            ):
                assert isinstance(node.value, ast.Dict), f"{place}:{node.lineno}: a table of texts is no literal"
                found.texts.update(dict.fromkeys((t for v in node.value.values for t in texts_of(v)), place))
            elif isinstance(node, ast.Call):
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                if name in TRANSLATORS or name in ("each", "PageTexts"):
                    given = [k.value for k in node.keywords] if name == "PageTexts" else node.args
                    given = given if name in ("each", "PageTexts") else given[:1]
                    found.texts.update(dict.fromkeys((t for v in given for t in texts_of(v)), place))
                elif name in MESSAGES and node.args:
                    made = any(isinstance(part, ast.JoinedStr) for part in ast.walk(node.args[0]))
                    if made and (
                        node.keywords
                        or (name == "error" and "importing" in place)
                        or (place.startswith("studio/") and not place.endswith("/serve.py"))
                    ):
                        found.untranslatable.append(f"{place}:{node.lineno}")
                    if node.keywords or place.startswith("studio/"):
                        found.texts.update(dict.fromkeys(texts_of(node.args[0]), place))
    return found


def messages(file: Path) -> list[Any]:
    with file.open("rb") as opened:
        return [message for message in read_po(opened, abort_invalid=True) if message.id]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_translation_has_a_text_with_the_same_values(file: Path) -> None:
    named = {"gesture": load_gestures("plush-18").labels}
    named["channel"] = tuple(name for layout in layout_names() for name in load_layout(layout).names)
    named["check"] = tuple(name.replace("-", " ") for name in CHECKS)
    stale, malformed = [], []
    for message in messages(file):
        ids = message.id if isinstance(message.id, tuple) else (message.id,)
        forms = message.string if isinstance(message.string, tuple) else (message.string,)
        if message.context in named:
            stale += [each for each in ids if each not in named[message.context]]
            continue
        stale += [each for each in ids if each not in source().constants]
        # `load_table` adds "where" to the template that it is given.
        known = {"where"}.union(*(fields(each) | source().values.get(each, set()) for each in ids))
        malformed += [form for form in forms if not form.strip() or not fields(form) <= known]
    assert stale == [], "no text in the source"
    assert malformed == [], "empty, or with values that the text does not have"


@pytest.mark.parametrize("language", [code for code in LANGUAGES if code != "en"])
def test_every_text_has_a_translation(language: str) -> None:
    words = Words(language)
    missing = [f"{place}: {text}" for text, place in source().texts.items() if text and not words._catalog.get(text)]
    assert len(source().texts) > 1000
    assert missing == []


def test_quotes_and_decimals_are_latvian() -> None:
    texts = [message.string for message in messages(PACKAGE / "studio" / "locale" / "lv.po")]
    assert [text for text in texts if re.search(r"“|\d\.\d+ (s|kHz|Hz)\b", text)] == []


def test_every_message_with_values_has_a_template() -> None:
    """An f-string could not be translated, and braces in its values would be taken for names."""
    assert source().untranslatable == []


@pytest.mark.parametrize("language", [code for code in LANGUAGES if code != "en"])
def test_every_gesture_of_the_toy_has_a_name(language: str) -> None:
    assert set(Words(language).names("gesture")) >= set(load_gestures("plush-18").labels)


def test_a_text_without_a_translation_is_in_english() -> None:
    assert Words("lv").gesture("Custom") == "Custom" and Words("en").gesture("Tail pull") == "Tail pull"
    assert Words("lv")("Hello, {name}", name="A") == "Hello, A"
    assert Words("lv")(in_context("of a door", "Open")) == "Open"
    assert Words("xx")("Home") == "Home" and Words("lv")("Home") == "Sākums"
    assert Words("lv")("{n:thing}", n=21) == "21 things"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_word_after_a_number_has_its_form(file: Path) -> None:
    """Also 21 and 101 are singular in Latvian, 11 and 111 are not; both forms are there wherever a word changes."""
    lv = Words("lv")
    assert [lv("{n:recording}", n=n) for n in (0, 1, 11, 21, 111)] == [
        "0 ieraksti", "1 ieraksts", "11 ieraksti", "21 ieraksts", "111 ieraksti",
    ]  # fmt: skip
    assert [lv("{n:event} in the log", n=n) for n in (21, 2)] == ["žurnālā 21 notikums", "žurnālā 2 notikumi"]
    assert lv("{n:event} in the log", n="2–3") == "žurnālā 2–3 notikumi"
    assert lv("{n:,} bytes for each toy", n=12001) == "12\u00a0001 baits vienai rotaļlietai"
    assert lv.form(0.5, ("one", "many")) == lv.form(1.5, ("one", "many")) == "many"
    counts = [
        spec for m in messages(file) for _, _, spec, _ in string.Formatter().parse(m.string) if "|" in (spec or "")
    ]
    assert (len(counts) > 30) == (file.stem == "lv") and all(spec.count("|") == 1 for spec in counts)


def test_an_error_is_in_the_language_of_the_page() -> None:
    known = ConfigError("“{name}” exists already. Give another name; nothing is replaced.", name="a")
    assert Words("en").error(known) == str(known)
    assert Words("lv").error(known).startswith("„a” jau ir")
    other = ConfigError("Use --subject.")
    assert Words("en").error(other) == "Use --subject."
    assert Words("lv").error(other) == "Tas neizdevās. Programmas ziņa angliski: Use --subject."


def test_a_note_is_in_the_language_of_the_page_also_after_json() -> None:
    note = Message("{file}: {note}", file="a.txt", note=Message("not a CSV file"))
    for form in (note, note.to_json(), Message.from_json(note.to_json())):
        assert Words("en").sentence(form) == "a.txt: no recording"
        assert Words("lv").sentence(form) == "a.txt: nav ieraksts"
    assert Words("lv").sentence("something") == "(Angliski:) something"
    older = {"message": "a.txt is left out", "template": "{file}: {note}", "values": {}}
    assert Words("lv").sentence(older) == "(Angliski:) a.txt is left out"


def test_personalising_names_the_gestures_that_had_too_few_recordings() -> None:
    labels = ("Tail tap 1", "Tail hit 1", "Back stroke 1", "At rest")
    with pytest.raises(BadInput, match=r"there are 1\. Record more of: Tail hit 1, Back stroke 1, At rest\.$") as error:
        _require_gestures(labels[:1], labels, "S01", PersonalSpec())
    assert (
        Words("lv")
        .error(error.value)
        .endswith("Ierakstiet vēl: Uzsitiens pie astes 1, Muguras glāstīšana 1, Miera stāvoklī.")
    )


def test_a_duration_is_rounded_to_the_nearest_minute() -> None:
    assert [duration_text(Words("en"), s) for s in (59, 258, 330)] == ["under a minute", "about 4 min", "about 6 min"]


def test_a_toy_has_a_name_in_place_of_its_address() -> None:
    gone = DeviceError(
        "'{url}' went away ({reason}): was it unplugged or switched off?", url="serial:///dev/x", reason=""
    )
    used = ConfigError("{toy} is in use: the page Live reads it.", toy="virtual://?person=7")
    for language, cable, virtual in (
        ("en", "Toy on the cable x", "Virtual toy (simulation), person 7"),
        ("lv", "Rotaļlieta pie kabeļa x", "Virtuāla rotaļlieta (simulācija), 7. cilvēks"),
    ):
        assert cable in Words(language).error(gone) and "://" not in Words(language).error(gone)
        assert Words(language).error(used).startswith(virtual)


def test_values_have_the_form_of_the_language() -> None:
    assert (Words("en").count(12345), Words("lv").count(12345)) == ("12,345", "12\u00a0345")
    assert (Words("en").significant(0.1234, 2), Words("lv").significant(0.1234, 2)) == ("0.12", "0,12")
    flat = Message("{subject} one value throughout", subject="ears, Custom have", channels=["ears", "Custom"])
    assert Words("lv").sentence(flat).endswith("ausis, Custom.")
    gap = Message("The toy was disconnected for {s:.1f} s.", s=1.25)
    assert "1,2 s" in Words("lv").sentence(gap) and "1.2 s" in Words("en").sentence(gap)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
@pytest.mark.parametrize(
    "value",
    [
        None, [], [""][1:], ["a"], ["a", "b"], 0, 1, 2, 0.5, "a", "a.", Message("It is a."),
        Message("not a CSV file"), [Message("It is a."), Message("It is b.")],
    ],
)  # fmt: skip
def test_every_message_reads_well_with_no_one_and_many_values(file: Path, value: Any) -> None:
    words, of_library = Words(file.stem), {message.id for message in messages(FILES[0])}
    for message in messages(file):
        if message.id not in of_library or re.search(r"\{\w+[:!]", f"{message.id}{message.string}"):
            continue
        made = {"message": "", "template": message.id, "values": dict.fromkeys(fields(message.string), value)}
        text = words.sentence(made)
        assert not re.search(
            r"None|\bnan\b|\[\]|\{|\.\.(?!\.)|  | [.,:;]|: ?[.;]|\(\)|“”|„”|''", text.replace("  pip", " pip")
        ), text


@pytest.mark.parametrize("language", [code for code in LANGUAGES if code != "en"])
def test_every_check_has_a_name_and_advice(language: str) -> None:
    words = Words(language)
    advice = {text for check in CHECKS.values() for text in (check.action, check.stream_action) if text}
    names = {in_context("check", name.replace("-", " ")) for name in CHECKS}
    assert [text for text in (*advice, *names) if not words._catalog.get(text)] == []


def test_every_text_that_the_live_view_names_is_there() -> None:
    script = resources.files("plushsense.studio.pages.live").joinpath("live_view.js").read_text(encoding="utf-8")
    names = set(re.findall(r"\b(?:w|this\.words)\.([a-z_]+)\b", script))
    assert len(names) > 20 and names <= set(VIEW_TEXTS)
