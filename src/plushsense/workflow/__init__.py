"""The Python API: import, check, train, evaluate, report, export, and the configuration of a run."""
