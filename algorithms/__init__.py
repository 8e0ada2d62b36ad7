"""Algorithms under test: their input is measurements only; from `sim` they import frames, camera and measurements."""
