"""Scenarios, which combine world, trajectory, instruments and score into cases, and the catalogue of campaign files."""
