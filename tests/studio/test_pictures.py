"""The pictures of the gestures: one for each, told apart, with a name."""

from __future__ import annotations

import base64
import itertools
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from plushsense.core.gestures import load_gestures
from plushsense.studio.widgets.elements import MAX_PICTURE, own_picture, picture

LABELS = load_gestures("plush-18").labels
SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("label", LABELS)
def test_every_gesture_of_the_toy_has_one(label: str) -> None:
    assert picture(label, "x") != picture("Throw", "x")
    root = ElementTree.fromstring(picture(label, f'"{label}" & <so>'))
    assert root.get("aria-label") == root.findtext(f"{SVG}title") == f'"{label}" & <so>'
    assert root.get("role") == "img"
    tags = {e.tag.removeprefix(SVG) for e in root.iter()}
    assert tags <= {"svg", "title", "g", "path", "ellipse", "circle", "rect"}, "nothing that acts or loads"


def test_another_set_gets_the_toy_alone() -> None:
    assert picture("Throw", "x") == picture("Bowl", "x") != picture("At rest", "x")
    assert picture("tail_HIT 1", "x") == picture("Tail hit 1", "x")


def test_a_child_could_tell_them_apart(chromium: Any) -> None:
    """Drawn small, any two differ in a good part of the picture."""
    page = chromium.new_page(viewport={"width": 160, "height": 125})
    drawn: dict[str, Any] = {}
    for label in LABELS:
        page.set_content(f'<body style="margin: 0">{picture(label)}</body>')
        pixels = page.evaluate(
            """async () => { const svg = document.querySelector('svg').outerHTML;
            const image = new Image(); image.src = 'data:image/svg+xml,' + encodeURIComponent(svg);
            await image.decode(); const canvas = document.createElement('canvas');
            canvas.width = 160; canvas.height = 125; const on = canvas.getContext('2d');
            on.drawImage(image, 0, 0, 160, 125);
            return btoa(String.fromCharCode(...on.getImageData(0, 0, 160, 125).data)) }"""
        )
        drawn[label] = np.frombuffer(base64.b64decode(pixels), np.uint8).reshape(125, 160, 4)[..., :3].astype(int)
    page.close()
    for one, other in itertools.combinations(LABELS, 2):
        differs = np.abs(drawn[one] - drawn[other]).max(axis=2) > 60
        assert differs.mean() > 0.02, (one, other)


def test_a_users_own(tmp_path: Path) -> None:
    assert own_picture(tmp_path, "Tail pull") == ""
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "tail_pull.svg").write_text("<svg/>", encoding="utf-8")
    (folder / "Hold strong.gif").write_bytes(b"GIF")
    (folder / "At rest.png").write_bytes(b"x" * (MAX_PICTURE + 1))
    outside = tmp_path.parent / "secret.png"
    outside.write_bytes(b"secret")
    (folder / "Hold in hands.png").symlink_to(outside)
    assert own_picture(tmp_path, "Tail pull") == "data:image/svg+xml;base64,PHN2Zy8+"
    for label in ("Hold strong", "At rest", "Hold in hands", "../secret"):
        assert own_picture(tmp_path, label) == ""
