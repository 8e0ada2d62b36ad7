"""Scenarios: world, trajectory, instruments and score of a case. A folder with a module `system` is a system under test."""
