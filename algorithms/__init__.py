"""Algorithms under test: their input is measurements only; from `sim` they import frames, camera and measurements."""

import marsyard.sim  # noqa: F401  (sets the cache folders of compiled kernels, before a kernel imports numba)
