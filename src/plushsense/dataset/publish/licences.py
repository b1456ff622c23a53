"""Licences a data set may be published under, by their SPDX names."""

from __future__ import annotations

from dataclasses import dataclass

from plushsense.core.errors import DatasetError, nearest


@dataclass(frozen=True)
class Licence:
    """A licence: SPDX name, title, and where its text stands."""

    spdx: str
    title: str
    url: str
    travels: bool = False
    """Whether its text must lie beside every copy."""


_CC = "https://creativecommons.org/licenses"
LICENCES: dict[str, Licence] = {
    each.spdx: each
    for each in (
        Licence("CC0-1.0", "Creative Commons Zero 1.0", "https://creativecommons.org/publicdomain/zero/1.0/"),
        Licence("CC-BY-4.0", "Creative Commons Attribution 4.0", f"{_CC}/by/4.0/"),
        Licence("CC-BY-SA-4.0", "Creative Commons Attribution-ShareAlike 4.0", f"{_CC}/by-sa/4.0/"),
        Licence("CC-BY-NC-4.0", "Creative Commons Attribution-NonCommercial 4.0", f"{_CC}/by-nc/4.0/"),
        Licence("CC-BY-NC-SA-4.0", "Creative Commons Attribution-NonCommercial-ShareAlike 4.0", f"{_CC}/by-nc-sa/4.0/"),
        Licence("CC-BY-ND-4.0", "Creative Commons Attribution-NoDerivatives 4.0", f"{_CC}/by-nd/4.0/"),
        Licence(
            "CC-BY-NC-ND-4.0", "Creative Commons Attribution-NonCommercial-NoDerivatives 4.0", f"{_CC}/by-nc-nd/4.0/"
        ),
        Licence("CC-BY-3.0", "Creative Commons Attribution 3.0", f"{_CC}/by/3.0/"),
        Licence("ODC-By-1.0", "Open Data Commons Attribution 1.0", "https://opendatacommons.org/licenses/by/1-0/"),
        Licence("ODbL-1.0", "Open Data Commons Open Database 1.0", "https://opendatacommons.org/licenses/odbl/1-0/"),
        Licence("PDDL-1.0", "Open Data Commons Public Domain 1.0", "https://opendatacommons.org/licenses/pddl/1-0/"),
        Licence("MIT", "MIT", "https://spdx.org/licenses/MIT.html", travels=True),
        Licence("Apache-2.0", "Apache 2.0", "https://www.apache.org/licenses/LICENSE-2.0", travels=True),
        Licence("BSD-3-Clause", "BSD 3-Clause", "https://spdx.org/licenses/BSD-3-Clause.html", travels=True),
    )
}


def find_licence(spdx: str) -> Licence:
    """The licence of an SPDX name, in any case.

    Raises:
        DatasetError: for a name that is not in `LICENCES`, with the nearest one.
    """
    for name, licence in LICENCES.items():
        if name.casefold() == spdx.strip().casefold():
            return licence
    raise DatasetError(
        f"'{spdx}' is no licence that can be published under: accepted are the SPDX names {', '.join(LICENCES)}."
        f"{nearest(spdx.replace(' ', '-'), LICENCES)}"
    )
