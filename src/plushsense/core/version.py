"""The version of PlushSense, which is written into files."""

__version__ = "0.1.0"
