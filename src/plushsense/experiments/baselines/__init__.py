"""Compare classical and recurrent baselines with our network under several splits. Read run, score, report."""
