"""Small autonomous helicopter: level flight for image acquisition, and landing on a site (landing paper, V).

Thrust acts along the body's z axis, and drag is proportional to the airspeed: the helicopter pitches forward to fly and
tilts into the wind. Pitch, roll and yaw follow the autopilot's commands as second-order systems, disturbed by gusts;
thrust follows with a lag. The autopilot uses a delayed state. It computes the speed from the distance to the goal, the
acceleration from the speed error, and the tilt from the acceleration, with a trim against steady wind.

The imaging flight is controlled with true states, because its deviation from the path has no influence on results. The
landing is controlled with the estimated navigation states, so that navigation errors become touchdown errors. Below the
flare height the autopilot controls the velocity to zero, but not the position, so that gusts displace the helicopter.

Not modelled: inflow near the ground, wind that depends on position, and sliding or tipping after the touchdown. The
skids stay at the point of first contact, and the tilt decays to zero.

The landing paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from marsyard.sim.dynamics.rotorcraft.flight import (
    TAIL_S,
    Air,
    AltimeterErrors,
    Phase,
    RotorcraftFlight,
    SimulatedPath,
    Vibration,
    simulate_landing,
    simulate_transit,
)
from marsyard.sim.dynamics.rotorcraft.kernels import GroundPatch
from marsyard.sim.dynamics.rotorcraft.parameters import (
    AirParameters,
    LandingGuidance,
    RotorcraftParameters,
    TransitParameters,
    VibrationParameters,
)

__all__ = [
    "TAIL_S", "Air", "AirParameters", "AltimeterErrors", "GroundPatch", "LandingGuidance", "Phase", "RotorcraftFlight",
    "RotorcraftParameters", "SimulatedPath", "TransitParameters", "Vibration", "VibrationParameters",
    "simulate_landing", "simulate_transit",
]  # fmt: skip
