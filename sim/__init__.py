"""The simulated world and its instruments: terrain, light, cameras, detectors, dynamics. Truth lives here and nowhere else."""
