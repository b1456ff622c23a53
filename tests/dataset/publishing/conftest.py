"""The package that the tests look at, made once; and no network."""

from __future__ import annotations

import socket
from typing import NoReturn

import pytest

from plushsense.dataset.publishing.package import PublishResult
from plushsense.dataset.store import Dataset
from support.toys import made_of, make


@pytest.fixture(scope="session", autouse=True)
def tools(publish_tools: None) -> None:
    """Every test here needs them."""


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here may reach the network: whoever tries is told."""

    def refuse(*args: object, **kwargs: object) -> NoReturn:
        raise AssertionError(f"the network was asked for {args[1:]}")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.fixture(scope="session")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make(tmp_path_factory.mktemp("source") / "DS")


@pytest.fixture(scope="session")
def package(source: Dataset, tmp_path_factory: pytest.TempPathFactory) -> PublishResult:
    """The package; never to be changed by a test."""
    return made_of(source, tmp_path_factory.mktemp("out") / "package")
