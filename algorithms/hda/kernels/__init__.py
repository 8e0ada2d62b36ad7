"""Compiled kernels of the hazard detection; the typed functions around them say what they compute."""
