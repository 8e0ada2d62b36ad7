"""Validation of the simulation against independent references."""
