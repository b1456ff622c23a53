"""A search of the smallest good network by successive halving. Read halving, run; its report is the command line."""
