"""The simulated world and its instruments. Truth lives here and nowhere else."""
