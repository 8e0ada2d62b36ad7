"""Rover scenario: visual target tracking in a closed loop of driving and imaging.

Reading order: `parameters`, `world`, `vehicle`, `target`, the loop in `run` with `route` and `pictures`, then `score`;
`scenario` runs a case. `shared` tracks many targets over the pictures of one drive.
"""
