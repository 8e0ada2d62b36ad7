"""The simulated world and its instruments. Truth lives here and nowhere else."""

from marsyard.sim.kernel_cache import set_cache_folder

set_cache_folder()
