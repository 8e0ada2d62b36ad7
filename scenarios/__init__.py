"""Scenarios: world, trajectory, instruments and score of cases. Each folder with a module `system` is a system."""

import marsyard.sim  # noqa: F401  (sets the cache folders of compiled kernels, before a kernel imports numba)
