"""A small autonomous helicopter: flight for pictures at constant height, and landing on a site."""

from marsyard.sim.dynamics.rotorcraft.flight import (
    Air,
    GroundPatch,
    LandingLaser,
    Phase,
    RotorcraftFlight,
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
from marsyard.sim.dynamics.rotorcraft.path import FlownPath, Vibration

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
