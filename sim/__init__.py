"""The simulated world and its instruments. Truth lives here and nowhere else."""

from marsyard.sim.kernel_cache import use_own_folder

use_own_folder()
