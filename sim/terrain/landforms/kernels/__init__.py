"""Compiled functions that add shapes to a grid of heights and albedos."""
