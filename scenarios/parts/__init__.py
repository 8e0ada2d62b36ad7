"""Parts of a case that a user brings: the motion of a descent, an instrument, a score.

Read `named` first: how a part is named, found and made from its options. `motions`, `instruments` and `scores` hold
what each kind is handed and what it gives.
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
    "DescentPlace",
    "InstrumentReadings",
    "InstrumentTruth",
    "Poses",
    "ScoredDescent",
    "ScoredFlight",
    "ScoredLanding",
    "ScoredRun",
    "ScoredSite",
    "ScoredVelocity",
]
