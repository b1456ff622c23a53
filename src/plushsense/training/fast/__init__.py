"""Fast training on a CPU: convolutions with far fewer multiplications than taps × positions.

``transform`` has the matrices of the fast convolutions; ``plan`` chooses the method of each layer by its shape;
``conv`` implements the methods, and a thread pool for the chunks of a batch; ``net`` has the forward and backward pass,
with normalisation folded into the next layer; ``vectors`` has those of a vector layer; ``stride`` leaves out positions
of the pool. ``training/fit`` uses them through ``training/engine``.
"""
