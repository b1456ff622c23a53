"""Fast training: convolutions with far fewer multiplications than taps × positions, and a step without waste.

``transform``: the matrices; ``plan``: the method of each layer, from its shape alone; ``conv``: the methods,
and a thread pool for the chunks of a batch; ``net``: forward and backward pass, with normalisation folded into
the next layer. `fit` uses it through ``training/engine``.
"""
