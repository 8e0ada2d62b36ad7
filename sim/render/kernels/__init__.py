"""Compiled rendering kernels."""
