"""The simulated world with its ground truth, and its instruments."""

from marsyard.sim.kernel_cache import set_cache_folder

set_cache_folder()
