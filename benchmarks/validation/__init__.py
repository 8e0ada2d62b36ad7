"""Measures what the simulation claims against references that share no code with it."""
