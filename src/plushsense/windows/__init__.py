"""Clock rule, derived channels, scaling and cutting of windows."""
