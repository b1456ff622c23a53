"""Splits and metrics: pure functions on indices and predictions."""
