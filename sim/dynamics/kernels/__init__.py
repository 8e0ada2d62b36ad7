"""Compiled kernels of how things move."""
