"""One network from windows: how long and how fast, and the loop that moves its weights."""
