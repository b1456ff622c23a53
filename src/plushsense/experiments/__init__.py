"""Experiments: each package trains, scores and reports one kind of comparison; none imports another."""
