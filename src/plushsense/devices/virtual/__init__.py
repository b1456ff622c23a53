"""The virtual toy: simulated people who touch a simulated plush companion, and its sensor signals.

It is for demos and tests: scores on it do not predict scores on a real toy.
"""
