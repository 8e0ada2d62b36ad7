"""Algorithms under test: estimators that see measurements only (of `sim`: frames, camera, measurements)."""
