"""Quality checks of recordings: each check is a function and a line in `checking.CHECKS`."""
