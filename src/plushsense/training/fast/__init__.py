"""Fast training: convolutions with far fewer multiplications than taps × positions, and a step without waste.

``transform`` the matrices; ``plan`` which way a layer is computed, from its shape alone; ``conv`` the ways;
``crew`` threads that share the chunks of a batch; ``net`` the network: forward, backward, normalisation folded into the
next layer. `fit` drives it through ``training/engine``.
"""
