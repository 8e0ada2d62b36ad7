"""Rover scenario: visual target tracking in a closed loop of driving and imaging.

Reading order: `parameters`, `world`, `target`, `stops`, the loop in `run`, then `score`; `scenario` runs a case, or
tracks many targets over the pictures of one drive.
"""
