import json
from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, GestureError
from plushsense.devices.virtual.session import GESTURES
from plushsense.recording.plan import Protocol, load_protocol, protocol_names, save_protocol, wordings


def own(folder: Path, text: str) -> Path:
    path = folder / "own.toml"
    path.write_text('name = "own"\ngesture_set = "plush-18"\n' + text, encoding="utf-8")
    return path


def test_the_papers_session() -> None:
    paper = load_protocol("plush-17")
    assert sorted(paper.gestures) == sorted(GESTURES)
    # The authors' recorder does all gestures on the table first, then those with the toy in the hands.
    assert [g[-1] for g in paper.gestures[:7]] == ["1"] * 7
    assert [g[-1] for g in paper.gestures[8:15]] == ["2"] * 7
    assert len(paper.steps()) == 51
    assert [(s.gesture, s.repetition) for s in paper.steps()[:4]] == [
        ("Head stroke 1", 1), ("Head stroke 1", 2), ("Head stroke 1", 3), ("Back stroke 1", 1),
    ]  # fmt: skip
    assert (paper.countdown_s, paper.shortest_s) == (3.0, 0.5)
    assert paper.steps()[0].prompt == "Stroke the toy's head; the toy stands on a table"
    assert not paper.needs_nobody


@pytest.mark.parametrize("name", protocol_names())
def test_a_built_in_one_comes_back_from_plain_values(name: str) -> None:
    protocol = load_protocol(name)
    assert Protocol.from_dict(json.loads(json.dumps(protocol.to_dict()))) == protocol


def test_rest_is_nobodys() -> None:
    rest = load_protocol("rest")
    assert rest.needs_nobody
    assert {s.gesture for s in rest.steps()} == {"At rest"}


def test_words_for_children() -> None:
    assert load_protocol("plush-17", "child").prompts["Hold strong"] == "Give the toy a big hug"
    with pytest.raises(ConfigError, match=r"no wording 'chld'.*Did you mean 'child'"):
        load_protocol("plush-17", "chld")


@pytest.mark.parametrize("name", protocol_names())
def test_every_built_in_prompt_is_there_in_latvian(name: str) -> None:
    assert {"default", "lv"} <= set(wordings(name))
    own_words = load_protocol(name)
    for words in set(wordings(name)) & {"lv", "lv-child"}:
        latvian = load_protocol(name, words)
        assert latvian.words == words
        assert [g for g in latvian.gestures if latvian.prompts[g] == own_words.prompts[g]] == []


def test_the_wordings_of_a_protocol(tmp_path: Path) -> None:
    assert wordings("plush-17") == ("default", "child", "lv", "lv-child")
    # Gestures without own prompts have the built-in ones.
    text = 'gestures = ["tail_pull"]\n[prompts]\n"Tail pull" = { de = "Zieh" }\n'
    assert wordings(own(tmp_path, text)) == ("default", "child", "de", "lv", "lv-child")
    assert load_protocol(own(tmp_path, text), "lv").prompts["Tail pull"].startswith("Vienreiz spēcīgi parauj")
    assert load_protocol(own(tmp_path, text)).prompts["Tail pull"].startswith("One energetic pull of the tail")
    assert wordings(own(tmp_path, 'gestures = ["Tail pull"]\n[prompts]\n"Tail pull" = "Zieh"\n')) == ("default",)


def test_a_random_order_depends_on_the_seed_alone(tmp_path: Path) -> None:
    path = tmp_path / "mixed.toml"
    saved = save_protocol(path, ("Tail pull", "Hold strong"), 2, "random")
    assert saved == load_protocol(path)
    first, second, again = ([(s.gesture, s.repetition) for s in replace(saved, seed=n).steps()] for n in (1, 2, 1))
    assert first == again == [("Tail pull", 1), ("Hold strong", 2), ("Hold strong", 1), ("Tail pull", 2)]
    assert first != second and sorted(first) == sorted(second)
    assert Protocol.from_dict(replace(saved, seed=7).to_dict()).seed == 7
    kissed = save_protocol(tmp_path / "kiss.toml", ("kiss", "Tail pull"), 1, "gesture", {"kiss": "positive"})
    assert (kissed.affects, kissed.prompts["kiss"]) == ({"kiss": "positive"}, "kiss")
    assert Protocol.from_dict(kissed.to_dict()) == kissed and "affects" not in saved.to_dict()
    for gestures, repetitions in (((), 1), (("Tail pull",), 0)):
        with pytest.raises(ConfigError, match=r"at least one|accepted are 1"):
            save_protocol(tmp_path / "none.toml", gestures, repetitions, "random")
    assert not (tmp_path / "none.toml").exists()


def test_a_users_own(tmp_path: Path) -> None:
    text = 'gestures = ["tail_hit 1", "At rest"]\norder = "round"\nrepetitions = 2\n[prompts]\n"At rest" = "Leave it"\n'
    protocol = load_protocol(own(tmp_path, text))
    assert [(s.gesture, s.repetition) for s in protocol.steps()] == [
        ("Tail hit 1", 1), ("At rest", 1), ("Tail hit 1", 2), ("At rest", 2),
    ]  # fmt: skip
    assert protocol.prompts["At rest"] == "Leave it"
    assert protocol.nobody == ("At rest",)
    assert not protocol.needs_nobody


def test_a_gesture_set_beside_it_is_found(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\ngestures = [{ label = "Poke" }]\n', encoding="utf-8")
    path = tmp_path / "own.toml"
    path.write_text('name = "own"\ngesture_set = "mine.toml"\n', encoding="utf-8")
    protocol = load_protocol(path)
    assert protocol.prompts == {"Poke": "Poke"}
    (tmp_path / "mine.toml").unlink()
    assert Protocol.from_dict(protocol.to_dict()) == protocol


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("repetition = 3", "Unknown key 'repetition'.*Did you mean 'repetitions'"),
        ("repetitions = 0", "accepted are 1 to 1000"),
        ("repetitions = true", "accepted is a whole number"),
        ('order = "rounds"', "Did you mean 'round'"),
        ("countdown_s = -1", "0 to 60 seconds"),
        ("longest_s = nan", "accepted is a number"),
        ("shortest_s = 5\nlongest_s = 4", "must be below"),
        ('gestures = ["Tail kick"]', "Tail kick"),
        ('gestures = ["Tail pull", "tail_pull"]', "every gesture once"),
        ("gestures = 3", "accepted is a list of texts"),
        ('[prompts]\n"Tail pull" = 3', 'prompts."Tail pull" is 3: accepted is text or a table'),
        ('[prompts]\n"Tail kick" = "x"', "Tail kick"),
    ],
)
def test_a_slip_is_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises((ConfigError, GestureError), match=said):
        load_protocol(own(tmp_path, text + "\n"))


def test_a_label_that_no_file_can_be_called_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\ngestures = [{ label = "a/b" }]\n', encoding="utf-8")
    path = tmp_path / "own.toml"
    path.write_text('name = "own"\ngesture_set = "mine.toml"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="cannot be part of a file name"):
        load_protocol(path)


def test_an_unknown_name_is_one_sentence() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'plush-17'"):
        load_protocol("plush17")
