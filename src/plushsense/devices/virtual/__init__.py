"""The virtual toy: people, their hands on a simulated plush companion, and what its sensors then send.

Its scores say nothing about a real toy: it is for demos, tests and fault drills.
"""
