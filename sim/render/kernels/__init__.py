"""Compiled kernels of rendering."""
