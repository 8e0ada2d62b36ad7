"""Compiled kernels of the instruments."""
