"""Errors, layouts, gesture sets, recorder files, atomic writing and strict TOML loading, used by all packages."""
