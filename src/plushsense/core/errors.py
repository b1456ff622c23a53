"""The exceptions of PlushSense, as one tree.

    PlushSenseError
    ├── BadInput                something the user gave cannot be used
    │   ├── ArchError           an architecture symbol
    │   ├── LayoutError         a sensor layout
    │   ├── GestureError        a gesture set
    │   ├── FileFormatError     a file of recordings or predictions
    │   ├── DatasetError        a data set folder
    │   │   └── ForgottenError  a person was removed in the meantime
    │   ├── BundleError         a model bundle
    │   ├── ArrayError          arrays given from Python; also a ValueError
    │   └── ConfigError         a setting, a flag, a configuration file
    │       └── AddressError    the URL of a toy
    ├── DeviceError             a toy that cannot be opened or disconnected
    ├── TrainingError           a training that cannot start or continue
    │   └── DivergedError       its loss is not a number
    ├── ToolError               a compiler or emulator that is missing or fails
    │   ├── BuildError          a compiler or linker that rejects a program
    │   └── ProgramError        a program that was built and fails
    └── MissingExtraError       an optional package that is not installed

Every message is one sentence: what is wrong, where, what is accepted, what to do.
The command line prints it and exits with status 2. What is unusual but no error is a `PlushSenseWarning`.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import re
import warnings
from collections.abc import Iterable
from types import ModuleType

from plushsense.core.sentences import Message

# Control characters, with which a text could command a terminal, and line separators and marks that reverse the order
# of what follows.
_CONTROLS = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
_LONGEST_COMPARED = 200


def printable(text: str, *, lines: bool = False) -> str:
    """Return a text with control characters escaped, as ``\\u001b``; ``lines``: line ends and tabs are kept.

    The escapes are valid inside the strings of a JSON text, too.
    """
    plain = _CONTROLS.sub(lambda match: f"\\u{ord(match[0]):04x}", text)
    return plain if lines else plain.replace("\n", "\\u000a").replace("\t", "\\u0009")


class PlushSenseError(Exception):
    """An error of PlushSense, whose message is one sentence for the user.

    Control characters and line ends in the sentence, which may come from a file, are escaped. Lines to print below it,
    such as a caret under the place, are notes (`add_note`).

    Args:
        template: the sentence, with ``{name}`` in place of each of the values, see `Message`.
        values: what is filled in; they stay in the attribute ``message``, for the sentence in other languages.
    """

    def __init__(self, template: str = "", /, **values: object) -> None:
        filled = Message(template, **values)
        self.message = Message.restored(printable(filled), template, values)
        super().__init__(self.message)


class PlushSenseWarning(UserWarning):
    """Something unusual that a function of the Python API reports by Python's `warnings`, as one sentence."""


_PACKAGE = __name__.partition(".")[0]


def python_warning(sentence: str) -> None:
    """Issue a sentence by Python's `warnings`, as if by the line of the caller's program that called PlushSense."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == _PACKAGE:
        frame, level = frame.f_back, level + 1
    warnings.warn(printable(sentence), PlushSenseWarning, stacklevel=level)


class BadInput(PlushSenseError):
    """Invalid input of the user."""


class ArchError(BadInput):
    """An architecture that cannot be parsed or has invalid settings."""


class LayoutError(BadInput):
    """A sensor layout that is unknown or inconsistent."""


class GestureError(BadInput):
    """A gesture or gesture set that is unknown or inconsistent."""


class FileFormatError(BadInput):
    """A file of recordings or predictions that cannot be read."""


class DatasetError(BadInput):
    """A data set folder that cannot be opened, created or changed."""


class ForgottenError(DatasetError):
    """A person was removed from the data set since it was opened, so that results may contain their data."""


class BundleError(BadInput):
    """A model bundle that cannot be read or does not fit."""


class ArrayError(BadInput, ValueError):
    """Arrays that cannot be used; also a ValueError, as users of scikit-learn expect."""


class ConfigError(BadInput):
    """A setting that is unknown or out of range."""


class AddressError(ConfigError):
    """A URL of a toy that is missing or cannot be understood."""


class DeviceError(PlushSenseError):
    """A toy that cannot be opened, or that disconnected."""


class TrainingError(PlushSenseError):
    """A training that cannot start or continue."""


class DivergedError(TrainingError):
    """A training whose loss is not a number; the same settings would fail again."""


class ToolError(PlushSenseError):
    """A compiler or emulator that is missing or fails."""

    def __init__(self, template: str, output: str = "", /, **values: object) -> None:
        super().__init__(template, **values)
        self.output = output
        """The tool's complete output."""


class BuildError(ToolError):
    """A compiler or linker that rejects a program."""


class ProgramError(ToolError):
    """A program that was built and crashes, exits with a status other than 0, does not end, or prints nothing."""


class MissingExtraError(PlushSenseError):
    """An optional package that is not installed."""


def nearest(word: str, known: Iterable[str]) -> str:
    """Return the suggestion of a similar word to append to an error message, or "" if there is none."""
    # Comparing takes time proportional to the product of the lengths.
    lowered = {k.lower(): k for k in known if len(k) <= _LONGEST_COMPARED}
    if len(word) > _LONGEST_COMPARED:
        return ""
    matches = difflib.get_close_matches(word.lower(), list(lowered), n=1, cutoff=0.6)
    return f" Did you mean '{lowered[matches[0]]}'?" if matches else ""


def check_known(value: object, known: Iterable[str], kind: str, error: type[BadInput]) -> None:
    """Raise ``error`` for a value that is not among the known ones, and suggest a similar one.

    Args:
        kind: kind of the value, such as "preset".
    """
    known = tuple(known)
    if value not in known:
        raise error(f"Unknown {kind} '{value}': accepted are {', '.join(known)}.{nearest(str(value), known)}")


# That of NumPy's older generators, which scikit-learn uses.
_MOST_SEED = 2**32 - 1


def check_seed(seed: int) -> None:
    """Raise ConfigError for a seed that not every random generator accepts."""
    if not 0 <= seed <= _MOST_SEED:
        raise ConfigError(f"seed is {seed}: accepted are whole numbers from 0 to {_MOST_SEED}.")


def need(module: str, extra: str) -> ModuleType:
    """Import ``module``, which the optional dependency group ``extra`` provides.

    Raises:
        MissingExtraError: if the package is not installed, with the command to install it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.split(".")[0]
        if error.name is not None and error.name.split(".")[0] != top:
            raise
        raise MissingExtraError(
            "This needs the package '{package}', which is not installed: run  pip install 'plushsense[{extra}]'",
            package=top,
            extra=extra,
        ) from error
