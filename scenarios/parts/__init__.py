"""User-defined parts of a case: motions of a descent, instruments, and scores.

`motions`, `instruments` and `scores` define the inputs and outputs of parts. `named` imports and constructs parts.
"""

from __future__ import annotations

from typing import Any

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
from marsyard.sim.parameters import warn_deprecated

__all__ = [
    "InstrumentReadings", "InstrumentTruth", "MotionInputs", "Poses", "ScoredDescent", "ScoredFlight",
    "ScoredLanding", "ScoredRun", "ScoredSite", "ScoredVelocity",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Return the class with a deprecated name."""
    if name != "DescentPlace":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    warn_deprecated(name, "MotionInputs")
    return MotionInputs
