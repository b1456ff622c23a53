"""train"""

from __future__ import annotations

from plushsense.apps.studio.shell import Page


def show(page: Page) -> None:
    """Build the page."""
