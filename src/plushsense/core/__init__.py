"""Errors, layouts, gesture sets, recorder files, atomic files and strict loading of TOML, used by all packages."""
