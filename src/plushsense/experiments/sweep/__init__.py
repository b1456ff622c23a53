"""A grid of networks and schedules, trained and scored; the scoring is in `trials`. Read run, results, report."""
