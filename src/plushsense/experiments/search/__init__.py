"""A search of the smallest good network by successive halving. Read run, score; its report is the command line."""
