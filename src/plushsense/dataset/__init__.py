"""The data set: its folder, importing, checks, marks, trimming, privacy, publishing."""
