"""Fast training: convolutions with far fewer multiplications than taps × positions, and a step without waste.

``transform`` the matrices; ``plan`` which way a layer is computed, from its shape alone; ``conv`` the ways;
``net`` the network: forward, backward, normalisation folded into the next layer; ``engine`` what `fit` drives.
"""
