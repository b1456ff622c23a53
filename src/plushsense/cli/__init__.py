"""The command line: a verb is a few lines over a library call."""
