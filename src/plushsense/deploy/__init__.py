"""Deployment of a trained bundle: quantization, C code with identical answers, and its verification."""
