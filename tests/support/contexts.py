"""A plugin for runs under coverage: which test a line ran in (also in processes that it started), and its time."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

_seconds: dict[str, float] = {}
_failed: set[str] = set()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Count what runs from here on for this test, also in processes that it starts."""
    current = coverage.Coverage.current()
    if current is not None:
        current.switch_context(item.nodeid)
        current.config.context = item.nodeid
        os.environ["COVERAGE_PROCESS_CONFIG"] = current.config.serialize()
    begin = sum(os.times()[:4])
    try:
        return (yield)
    finally:
        _seconds[item.nodeid] = round(sum(os.times()[:4]) - begin, 2)
        if current is not None:
            current.switch_context("")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.outcome != "passed":
        _failed.add(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write the processor seconds of the tests that passed into the file that `TEST_SECONDS` names."""
    if place := os.environ.get("TEST_SECONDS"):
        passed = {test: seconds for test, seconds in _seconds.items() if test not in _failed}
        Path(place).write_text(json.dumps(passed, indent=0), "utf-8")
