"""Skip a test for what this machine lacks, or fail where it must be here; and whether tests take their long form."""

from __future__ import annotations

import importlib.util
import os

import pytest

REQUIRED = {word.strip() for word in os.environ.get("PLUSHSENSE_REQUIRE", "").split(",") if word.strip()}
LONG = bool(os.environ.get("PLUSHSENSE_SOAK"))
"""Whether tests that have a long form take it, as `make soak` asks them to."""


def missing(what: str, reason: str) -> None:
    """Skip for something this machine lacks, or fail where PLUSHSENSE_REQUIRE says that it must be here."""
    if what in REQUIRED:
        pytest.fail(f"{what} is required here (PLUSHSENSE_REQUIRE): {reason}")
    pytest.skip(reason)


def installed(module: str, what: str) -> None:
    """Skip, or fail where PLUSHSENSE_REQUIRE names ``what``, when an optional package is not installed."""
    if importlib.util.find_spec(module) is None:
        missing(what, f"the package {module} is not installed")
