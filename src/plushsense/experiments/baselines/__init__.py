"""Classical and recurrent baselines beside our network, under several splits. Read run, score, report."""
