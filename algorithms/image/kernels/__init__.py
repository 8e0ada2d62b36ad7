"""Compiled kernels of pictures; the typed functions around them say what they compute."""
