"""Small models and streams with every trouble that a real one has."""

from support.streams import bundle, frames  # noqa: F401
