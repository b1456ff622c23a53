"""Deploy a trained bundle: quantization, C code with the same answers bit by bit, and its verification."""
