"""The continuous benchmark: score events in whole streams of people left out. Read run, score, report."""
