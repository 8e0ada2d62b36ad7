"""A rover drives to what it sees: the scenario of visual target tracking.

Read it in the order of a run: `parameters`, `world`, `rig`, `vehicle`, `target`, then the loop in `run` with `route`,
`mapping` and `pictures`, and `score`; `scenario` runs a case. `shared` tracks many targets over
the pictures of one drive.
"""
