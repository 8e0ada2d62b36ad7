"""User-defined parts of a case: motions of a descent, instruments, and scores.

`motions`, `instruments` and `scores` define the inputs and outputs of parts. `named` imports and constructs parts.
"""

from marsyard.scenarios.parts.instruments import InstrumentReadings, InstrumentTruth
from marsyard.scenarios.parts.motions import MotionInputs, Poses
from marsyard.scenarios.parts.scores import (
    ScoredDescent,
    ScoredFlight,
    ScoredLanding,
    ScoredRun,
    ScoredSite,
    ScoredVelocity,
)

__all__ = [
    "InstrumentReadings", "InstrumentTruth", "MotionInputs", "Poses", "ScoredDescent", "ScoredFlight",
    "ScoredLanding", "ScoredRun", "ScoredSite", "ScoredVelocity",
]  # fmt: skip
