"""User-defined parts of a case: the motion of a descent, an instrument, a score.

`named` imports and constructs a part by its name; `motions`, `instruments` and `scores` define inputs and outputs.
"""

from marsyard.scenarios.parts.instruments import InstrumentReadings, InstrumentTruth
from marsyard.scenarios.parts.motions import DescentPlace, Poses
from marsyard.scenarios.parts.scores import (
    ScoredDescent,
    ScoredFlight,
    ScoredLanding,
    ScoredRun,
    ScoredSite,
    ScoredVelocity,
)

__all__ = [
    "DescentPlace", "InstrumentReadings", "InstrumentTruth", "Poses", "ScoredDescent", "ScoredFlight",
    "ScoredLanding", "ScoredRun", "ScoredSite", "ScoredVelocity",
]  # fmt: skip
