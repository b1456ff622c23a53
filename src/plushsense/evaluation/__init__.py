"""Evaluate one model on people left out: folds, predictions and scores."""
