"""Networks: the symbol that names one, its meaning in NumPy, its trainable form, the file that carries it."""
