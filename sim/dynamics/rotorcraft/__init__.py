"""Small autonomous helicopter: flight at constant height while pictures are taken, and landing on a site."""

from marsyard.sim.dynamics.rotorcraft.flight import (
    Air,
    FlownPath,
    GroundPatch,
    LandingLaser,
    Phase,
    RotorcraftFlight,
    Vibration,
    landing_flight,
    transit_flight,
)
from marsyard.sim.dynamics.rotorcraft.parameters import (
    AirParameters,
    LandingGuidance,
    RotorcraftParameters,
    TransitParameters,
    VibrationParameters,
)

__all__ = [
    "Air",
    "AirParameters",
    "FlownPath",
    "GroundPatch",
    "LandingGuidance",
    "LandingLaser",
    "Phase",
    "RotorcraftFlight",
    "RotorcraftParameters",
    "TransitParameters",
    "Vibration",
    "VibrationParameters",
    "landing_flight",
    "transit_flight",
]
