"""Score rules, network and both together in the paper's real-time protocol. Read run, score, report."""
