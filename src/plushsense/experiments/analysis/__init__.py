"""Analyses of saved evaluations: comparisons person by person, splits side by side, merges of gestures."""
