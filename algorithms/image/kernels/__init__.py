"""Compiled image kernels; the typed functions that call them document their inputs and outputs."""
