"""How well networks read people they never met: splits side by side, comparisons, merges of gestures, explanations."""
