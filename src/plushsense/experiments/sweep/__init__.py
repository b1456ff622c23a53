"""Train and score a grid of networks and schedules; the scoring is in `trials`. Read run, results, report."""
