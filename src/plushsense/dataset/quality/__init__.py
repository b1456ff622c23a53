"""Quality checks of recordings; each check is a function and an entry of `checking.CHECKS`."""
