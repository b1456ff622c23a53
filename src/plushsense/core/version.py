"""State the version of PlushSense that writes a file."""

__version__ = "0.1.0"
