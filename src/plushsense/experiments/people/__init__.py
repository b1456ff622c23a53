"""How well networks read people they never met: splits side by side, comparisons, and why a person is read badly."""
