"""Data sets on disk: index, importing, quality checks, marks, trimming, privacy, backup and publishing."""
