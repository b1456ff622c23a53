"""Search for small, good networks by successive halving. Read halving, run; the command line prints the results."""
