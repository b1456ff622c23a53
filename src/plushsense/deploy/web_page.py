"""Fill in the page of an export: one file that reads a toy in a browser, without any request."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from importlib.resources import files

from plushsense.core.layouts import layout_names, load_layout
from plushsense.core.templates import fill_text
from plushsense.deploy.code import ModelFacts
from plushsense.live.reactions import load_reactions, reaction_names
from plushsense.models.bundle import Bundle

# Lines of comments, and what stands before the first character of any other line.
_SPARE = re.compile(r"^[ \t]*(?://.*\n|/\*(?:.|\n)*?\*/[ \t]*\n?)?[ \t]*", re.MULTILINE)


def page_html(bundle: Bundle, facts: ModelFacts, image: bytes, module: bytes) -> bytes:
    """Return the page for a model: ``image`` and the WebAssembly ``module`` that runs it, scripts and style inlined.

    Its Content-Security-Policy allows these, and no request.
    """
    folder = files("plushsense.deploy") / "web"
    library, page, style = (
        _SPARE.sub("", (folder / name).read_text(encoding="utf-8")) for name in ("plushsense.js", "page.js", "page.css")
    )
    code = re.sub(r"^export ", "", library, flags=re.MULTILINE) + page
    policy = (
        f"default-src 'none'; script-src 'sha256-{_sha256(code)}' 'wasm-unsafe-eval'; "
        f"style-src 'sha256-{_sha256(style)}'; img-src data:; base-uri 'none'; form-action 'none'"
    )
    # `<` could end the element.
    settings = json.dumps(page_settings(bundle, facts), ensure_ascii=False).replace("<", "\\u003c")
    binary = {"module": module, "image": image}
    encoded = {name: base64.b64encode(content).decode() for name, content in binary.items()}
    title = f"PlushSense {facts.name}".rstrip()
    return fill_text(
        "plushsense.deploy",
        "web/page.html.j2",
        **encoded,
        title=title,
        policy=policy,
        style=style,
        settings=settings,
        code=code,
    ).encode()


def page_settings(bundle: Bundle, facts: ModelFacts) -> Mapping[str, object]:
    """Return what the script of the page knows of the model, ready for JSON; ``page.js`` lists it."""
    layout = bundle.layout
    known = [load_layout(name) for name in layout_names()]
    ranges = zip(layout.channels, layout.valid_min_int.tolist(), layout.valid_max_int.tolist(), strict=True)
    return {
        "title": f"{facts.title}, {facts.model_version}",
        "simulated": facts.simulated,
        "layout": {
            "name": layout.name,
            "rate_hz": layout.rate_hz,
            "channels": [{"name": c.name, "step": c.step, "low": low, "high": high} for c, low, high in ranges],
            "wire": layout.wire,
            "csv": {name: getattr(layout.csv, name) for name in ("columns", "header", "separator")},
        },
        "wires": [other.wire for other in known if other.channels == layout.channels and other.wire != layout.wire],
        "gestures": [{"label": g.label, "affect": g.affect} for g in bundle.gestures.gestures],
        "reactions": {name: load_reactions(name).to_dict()["reactions"] for name in reaction_names()},
    }


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
