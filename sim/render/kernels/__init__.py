"""Compiled kernels of the picture."""
