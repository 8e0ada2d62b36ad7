"""The simulated world and its instruments. Truth lives here and nowhere else."""

from sim.kernel_cache import use_own_folder

use_own_folder()
