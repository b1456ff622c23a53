"""``plushsense live --reactions``: what the toy does, on each line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from plushsense.cli.main import main


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Random weights that are sure of something: what does not matter, reactions go by events."""
    from plushsense.core.gestures import load_gestures
    from plushsense.core.layouts import load_layout
    from plushsense.models.arch import Arch
    from plushsense.models.bundle import Bundle
    from plushsense.models.reference import random_weights
    from plushsense.windows.features import Scaler

    arch = Arch.parse("14d1_19d2_19d4", (8, 12, 16))
    decision = {"enter": 0.0, "leave": 0.0, "least_s": 0.05, "hold_s": 0.0, "rest_s": 0.0, "switch_s": 0.1}
    bundle = Bundle(
        arch, random_weights(arch, 7), load_layout("plush-15"), Scaler(np.zeros(11), np.full(11, 1e-3)),
        load_gestures("plush-18"), decision=decision,
    )  # fmt: skip
    return str(bundle.save(tmp_path_factory.mktemp("reactions") / "m.plush"))


def lines(capsys, model, *words):
    status = main(["live", "--model", model, "--device", "virtual://?person=3&seed=5&speed=0", *words])
    out, err = capsys.readouterr()
    return status, out.splitlines(), err


def test_every_line_has_its_reactions_and_without_the_option_none_has(capsys, model, tmp_path):
    own = tmp_path / "own.toml"
    own.write_text(
        "reactions = ["
        + ", ".join(
            f'{{ affect = "{affect}", eyes = "green", sound = "purr", seconds = 1 }}'
            for affect in ("positive", "neutral", "negative", "none")
        )
        + "]",
        encoding="utf-8",
    )
    status, said, err = lines(capsys, model, "--seconds", "20", "--reactions", str(own))
    assert status == 0, err
    decisions = [json.loads(line) for line in said]
    assert all("reactions" in d for d in decisions)
    begun = [(e["t_s"], e["number"], e["affect"]) for d in decisions for e in d["events"] if e["what"] == "begun"]
    reacted = [(r["t_s"], r["number"], r["affect"]) for d in decisions for r in d["reactions"]]
    assert begun
    assert reacted == begun
    _, said, _ = lines(capsys, model, "--seconds", "4")
    assert said
    assert all("reactions" not in json.loads(line) for line in said)


def test_in_words_too_the_toy_says_what_it_does(capsys, model):
    status, said, err = lines(capsys, model, "--seconds", "20", "--reactions", "standard", "--text")
    assert status == 0, err
    _, every, _ = lines(capsys, model, "--seconds", "20", "--reactions", "standard", "--events")
    wanted = [r for line in every for r in json.loads(line)["reactions"]]
    told = [line for line in said if "the toy:" in line]
    assert wanted
    assert [float(line.split()[0]) for line in told] == pytest.approx([r["t_s"] for r in wanted], abs=0.006)
    assert all(f"eyes {r['eyes']}" in line and (r["sound"] or "") in line for r, line in zip(wanted, told, strict=True))


@pytest.mark.parametrize(
    ("given", "text", "said"),
    [
        ("gentel", None, "Did you mean 'gentle'?"),
        ("own.toml", None, "There is no reactions file"),
        ("own.toml", 'reactions = [{ afect = "positive" }]', "Did you mean 'affect'?"),
        ("own.toml", 'reactions = [{ gesture = "Hold stron" }]', "Did you mean 'Hold strong'?"),
    ],
)
def test_what_does_not_fit_is_one_sentence(capsys, model, tmp_path, given, text, said):
    if given.endswith(".toml"):
        given = str(tmp_path / given)
    if text is not None:
        (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    status, out, err = lines(capsys, model, "--reactions", given)
    assert status == 2
    assert out == []
    assert said in err
    assert len(err.strip().splitlines()) == 1
