"""Networks: architecture, reference implementation in NumPy, trainable network in PyTorch, and the bundle file."""
