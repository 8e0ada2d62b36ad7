"""A rover drives to what it sees: the scenario of visual target tracking.

Read it in the order of a run: `parameters`, `world`, `rig`, `vehicle`, `target`, then the loop in `run` with `route`,
`mapping` and `pictures`, and `score`; `scenario` runs a case. `shared` tracks many targets over
the pictures of one drive.
"""

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import Run, run_case
from marsyard.scenarios.rover.scenario import RoverScenario, SharedDriveScenario
from marsyard.scenarios.rover.shared import SharedDriveParameters
from marsyard.scenarios.rover.stops import RunOutcome

__all__ = [
    "RoverScenario",
    "RoverScenarioParameters",
    "Run",
    "RunOutcome",
    "SharedDriveParameters",
    "SharedDriveScenario",
    "run_case",
]
