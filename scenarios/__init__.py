"""Scenarios: world, trajectory, instruments and score of cases. Each folder with a module `system` is a system."""
