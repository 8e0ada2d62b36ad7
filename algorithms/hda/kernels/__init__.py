"""Compiled kernels of the hazard detection; the typed functions that call them document their inputs and outputs."""
