"""What a browser may take along: an export as a zip packed on the way, a package's own zip. Nothing else."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from fastapi import APIRouter
from fastapi.responses import FileResponse, PlainTextResponse, Response, StreamingResponse

from plushsense.apps.studio.house import EXPORTS, PACKAGES, House
from plushsense.core.errors import ConfigError
from plushsense.dataset.archives import entry_of
from plushsense.dataset.publish.archive import files_of
from plushsense.deploy.emit import FACTS

_PIECE = 1 << 16
_LONGEST_NAME = 255
"""Bytes of a file's name; file systems refuse longer ones in ways of their own."""


def address(kind: str, name: str) -> str:
    """Where the export or package of this name is downloaded; ``kind`` is `EXPORTS` or `PACKAGES`."""
    return f"/download/{kind}/{quote(name, safe='')}.zip"


def router(house: House) -> APIRouter:
    """The addresses of `address`, for the web app."""
    routes = APIRouter()

    @routes.get(f"/download/{EXPORTS}/{{name}}.zip", include_in_schema=False)
    def export(name: str) -> Response:
        try:
            folder = below(house, EXPORTS, name)
        except ConfigError as refusal:
            return PlainTextResponse(f"{refusal}\n", 404)
        if not (folder / FACTS).is_file():
            return PlainTextResponse(f"There is no export '{name}' in this studio.\n", 404)
        said = f"attachment; filename*=UTF-8''{quote(folder.name, safe='')}.zip"
        return StreamingResponse(pieces(folder), media_type="application/zip", headers={"content-disposition": said})

    @routes.get(f"/download/{PACKAGES}/{{name}}.zip", include_in_schema=False)
    def package(name: str) -> Response:
        try:
            file = below(house, PACKAGES, f"{name}.zip")
        except ConfigError as refusal:
            return PlainTextResponse(f"{refusal}\n", 404)
        if not file.is_file():
            return PlainTextResponse(f"There is no package '{name}' in this studio.\n", 404)
        return FileResponse(file, media_type="application/zip", filename=file.name)

    return routes


def below(house: House, kind: str, name: str) -> Path:
    """What is called ``name`` right in the house's folder ``kind``.

    Raises:
        ConfigError: for a name that leads elsewhere, also by way of a link.
    """
    place = house.inside(house.folder / kind / name)
    if place.parent != house.folder / kind or len(place.name.encode()) > _LONGEST_NAME:
        raise ConfigError(f"'{name}' is no name in '{house.folder / kind}'.")
    return place


def pieces(folder: Path) -> Iterator[bytes]:
    """A zip of a folder, under the folder's name, while it is being packed; the same files give the same bytes.

    Links that lead out of the folder are left out.
    """
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files_of(folder):
            if folder.resolve() not in path.resolve().parents:
                continue
            entry = entry_of(f"{folder.name}/{path.relative_to(folder).as_posix()}")
            with path.open("rb") as source, archive.open(entry, "w") as target:
                while piece := source.read(_PIECE):
                    target.write(piece)
                    yield pipe.take()
    yield pipe.take()


class _Pipe(io.RawIOBase):
    """What was written and not taken yet. It cannot go back, so that zipfile puts sizes after the bytes."""

    def __init__(self) -> None:
        self._held = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, piece: object) -> int:
        taken = bytes(piece)  # type: ignore[call-overload]
        self._held += taken
        return len(taken)

    def take(self) -> bytes:
        held, self._held = bytes(self._held), bytearray()
        return held
