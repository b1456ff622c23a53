"""Quality checks of recordings: each check is one function and one line in `registry.CHECKS`."""
