"""The simulated world with its ground truth, and its instruments."""

from marsyard.sim.kernel_cache import set_cache_folders

# numba and Dr.Jit read these folders at their import
set_cache_folders()
