"""The virtual toy: simulated people who touch a simulated plush companion, and its sensor signals.

Its scores say nothing about a real toy: it is for demos and tests.
"""
