"""From recordings to the input of a network: even resampling, derived channels, scaling and cutting of windows."""
