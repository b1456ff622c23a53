"""Scores on people left out: splits side by side, comparisons, merges of gestures, explanations."""
