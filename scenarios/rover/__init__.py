"""Rover scenario: visual target tracking in a closed loop of driving and imaging.

Reading order: `parameters`, `points`, `world`, `stops`, the loop in `run`, `score`, `scenario`. The scenario runs a
case, or tracks many targets over the images of one drive.
"""
