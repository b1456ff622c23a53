"""The paper's real-time protocol with rules, network and both. Read run, score, report."""
