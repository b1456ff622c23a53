"""A page of the studio is one folder and one line in the registry."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("nicegui")

PAGE = """
import asyncio
import sys
from nicegui import context, ui
from plushsense.studio.app.shell import query

async def show(page):
    ui.label(page.words("Greetings from a new page"))
    if "leave" in query():
        context.client.delete()
        try:
            await asyncio.sleep(0)
        finally:
            print("left", isinstance(sys.exc_info()[1], asyncio.CancelledError), flush=True)
"""
TEXTS = """
from plushsense.studio.app.words import PageTexts

TEXTS = PageTexts(name="Hello", title="A page of its own")
"""
STUDIO = """
import sys
from plushsense.cli.main import main
from plushsense.studio import pages
from plushsense.studio.app import shell

pages.__path__.append(sys.argv[1])
shell.PAGES["hello"] = "/hello"
sys.exit(main(["studio", "--home", sys.argv[2], "--port", "0", "--no-show", "--json"]))
"""


def test_a_page_is_one_folder_and_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "pages" / "hello"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text(TEXTS)
    (folder / f"{folder.name}_page.py").write_text(PAGE)
    env = {k: v for k, v in os.environ.items() if not k.startswith(("NICEGUI_", "PYTEST_"))}
    command = [sys.executable, "-c", STUDIO, str(folder.parent), str(tmp_path / "home")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as studio:
        try:
            assert studio.stdout is not None
            url = json.loads(studio.stdout.readline())["url"]
            # A page without a translation is in English.
            latvian = urllib.request.Request(f"{url}hello", headers={"Accept-Language": "lv"})
            with urllib.request.urlopen(latvian, timeout=120) as answer:
                hello = answer.read().decode()
            with urllib.request.urlopen(url, timeout=120) as answer:
                home = answer.read().decode()
            with pytest.raises(urllib.error.HTTPError, match="500"):
                urllib.request.urlopen(f"{url}hello?leave=1", timeout=120)
            left = studio.stdout.readline()
        finally:
            studio.terminate()
    assert "A page of its own" in hello and "Greetings from a new page" in hello
    assert "/hello" in home
    assert left == "left True\n", "a page that was left is still being built"
