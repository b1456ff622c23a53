"""Put the WebAssembly modules into the wheel, where a compiler for them is found."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Modules(BuildHookInterface):
    """Compile both modules; an editable installation compiles them when it exports."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the modules to the files of the wheel."""
        if version == "editable":
            return
        source = Path(self.root) / "src"
        sys.path.insert(0, str(source))
        from plushsense.core.errors import ToolError
        from plushsense.deploy.wasm import module, module_file

        self._made = tempfile.TemporaryDirectory(prefix="plushsense-wheel-")
        for calibrate in (False, True):
            path = module_file(calibrate=calibrate)
            made = Path(self._made.name) / path.name
            try:
                made.write_bytes(module(calibrate=calibrate))
            except ToolError:
                self.app.display_warning("No compiler for WebAssembly is here: this wheel holds no modules.")
                return
            build_data["force_include"][str(made)] = path.relative_to(source).as_posix()
