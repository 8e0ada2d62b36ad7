"""Rover scenario: visual target tracking in a closed loop of driving and imaging.

The paper, its sections, figures and tables, is Kim et al., "Targeted Driving Using Visual Tracking".

Reading order: `parameters`, `points`, `world`, `rig`, `vehicle`, `designation`, `run_state`, `guides`, `closed_loop`,
`score`. `scenario` runs a case; `shared_drive` tracks many targets over the images of one drive.
"""
