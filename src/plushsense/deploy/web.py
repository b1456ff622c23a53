"""Write the folder ``web`` of an export: a page of one file, and the library for other pages and Node; run it there."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

from plushsense.core.errors import ToolError
from plushsense.core.layouts import Layout, layout_names, load_layout
from plushsense.core.sentences import Message
from plushsense.core.templates import fill_text
from plushsense.deploy.code import ModelFacts
from plushsense.deploy.targets import run_program
from plushsense.deploy.wasm import WEB
from plushsense.live.reactions import load_reactions, reaction_names
from plushsense.models.bundle import Bundle

SCRIPT = "web/plushsense.js"
MODULE = "web/plushsense.wasm"
PAGE = "web/index.html"
WASM = "wasm"  # the target that runs the module of an export as it is, by way of its plushsense.js, as a page does
PAGE_BYTES = 120_000
"""What a page should have at most, to open at once on a slow tablet or Chromebook."""
_ENGINE = "node"
# Comments on lines of their own, and indentation: a sixth of the page.
_SPARE = re.compile(r"^[ \t]*(?://.*\n|/\*(?:.|\n)*?\*/[ \t]*\n)?[ \t]*", re.MULTILINE)


@dataclass(frozen=True)
class WebCost:
    """Cost of the web files: bytes of each and of the module's memory, and the best time of a step in Node."""

    module_bytes: int
    script_bytes: int
    page_bytes: int
    memory_bytes: int
    step_us: float


def web_files(bundle: Bundle, facts: ModelFacts, image: bytes, module: bytes | None) -> dict[str, bytes]:
    """Return the files of the folder by their paths in the export; without a ``module`` only the script."""
    files = {SCRIPT: (WEB / Path(SCRIPT).name).read_bytes()}
    if module is not None:
        files |= {MODULE: module, PAGE: _page(bundle, facts, image, module).encode()}
    return files


def large_page(size: int) -> Message:
    """Return what to say of a page with so many bytes: a sentence if it is larger than meant, else an empty one."""
    if size <= PAGE_BYTES:
        return Message()
    return Message(
        "The page web/index.html has {kb} kB: it works, but it is meant to have at most {limit} kB, so that it opens "
        "at once on a slow tablet or Chromebook; for such a one, train a network with fewer filters.",
        kb=-(-size // 1000),
        limit=PAGE_BYTES // 1000,
    )


def page_policy() -> str:
    """Return the Content-Security-Policy of the page of this version: its own script and style, and no request."""
    scripts, styles = (f"'sha256-{_base64(sha256(text.encode()).digest())}'" for text in _code_and_style())
    # No address at all: what a page must not load, it cannot send either.
    return (
        f"default-src 'none'; script-src {scripts} 'wasm-unsafe-eval'; style-src {styles}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


@cache
def _code_and_style() -> tuple[str, str]:
    parts = ((WEB / name).read_text("utf-8") for name in ("plushsense.js", "page.js", "page.css"))
    library, page, style = (_SPARE.sub("", text) for text in parts)
    return "\n" + re.sub(r"^export (?=\w)", "", library, flags=re.M) + page, "\n" + style


def _page(bundle: Bundle, facts: ModelFacts, image: bytes, module: bytes) -> str:
    code, style = _code_and_style()
    return fill_text(
        "plushsense.deploy",
        "web/page.html.j2",
        title=f"PlushSense {facts.name}".rstrip(),
        policy=page_policy(),
        style=style,
        # In a script element, < could begin its end.
        settings=json.dumps(_settings(bundle, facts), ensure_ascii=False).replace("<", "\\u003c"),
        code=code,
        module=_base64(module),
        image=_base64(image),
    )


def _settings(bundle: Bundle, facts: ModelFacts) -> dict[str, object]:
    layout = bundle.layout
    limits = zip(layout.channels, layout.valid_min_int.tolist(), layout.valid_max_int.tolist(), strict=True)
    channels = [vars(channel) | {"low": low, "high": high} for channel, low, high in limits]
    return {
        "title": facts.title,
        "simulated": facts.simulated,
        "layout": {**layout.to_dict(), "channels": channels},
        "wires": _other_wires(layout),
        "gestures": [{"label": g.label, "affect": g.affect} for g in facts.gestures],
        "reactions": {name: load_reactions(name).to_dict()["reactions"] for name in reaction_names()},
    }


def _other_wires(layout: Layout) -> list[tuple[str, ...]]:
    """Return the line formats of the built-in layouts that have the same channels, as of other firmware of a toy."""
    others = (load_layout(name) for name in layout_names())
    return [other.wire for other in others if other.channels == layout.channels and other.wire != layout.wire]


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def run_module(folder: Path, image: Path, cases: Path, *words: str, timeout_s: float = 120.0) -> bytes:
    """Run the module of the export ``folder`` in Node on a file of cases, by way of its plushsense.js.

    Returns:
        The rows of c/harness.c; what else ``words`` ask for, see web/run.mjs.

    Raises:
        ToolError: without Node. ProgramError: if it ends with an error.
    """
    if (engine := shutil.which(_ENGINE)) is None:
        raise ToolError("Node, which runs WebAssembly, is not installed here: install Debian's nodejs.")
    command = [engine, str(WEB / "run.mjs"), str((folder / MODULE).parent.resolve()), str(image), *words]
    return run_program("The module in Node", command, given=cases, timeout_s=timeout_s)


def web_cost(folder: Path, image: Path, cases: Path) -> WebCost:
    """Measure the module of the export ``folder`` on the first frames of a file of cases; raises like `run_module`."""
    timed = json.loads(run_module(folder, image, cases, "time"))
    module, script, page = ((folder / name).stat().st_size for name in (MODULE, SCRIPT, PAGE))
    return WebCost(module, script, page, timed["memory_bytes"], round(timed["step_us"], 2))
