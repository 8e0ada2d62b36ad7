"""Scenarios combine world, trajectory, instruments and score into cases; the catalogue of campaigns as data files."""
