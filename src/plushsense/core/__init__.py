"""The words that every other room speaks: errors, signals, gestures, recording files."""
