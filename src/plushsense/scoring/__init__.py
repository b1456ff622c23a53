"""Splits, metrics and event scores: pure functions of labels, people, predictions and intervals."""
