"""How vehicles move: truth states over time."""

from sim.dynamics.chain import SwingParameters
from sim.dynamics.driving import FIRM, NO_SLIP, Drive, DrivenPart, SlipParameters, Soil, drive
from sim.dynamics.relief import RockyGround
from sim.dynamics.rover import MER, ROCKY_8, Ground, RoverParameters, Stance, settle
from sim.dynamics.state import State
from sim.dynamics.swing import SwingDescent
from sim.dynamics.trajectory import Motion, Resting, Trajectory
from sim.dynamics.wind import Wind, WindParameters

__all__ = [
    "FIRM",
    "MER",
    "NO_SLIP",
    "ROCKY_8",
    "Drive",
    "DrivenPart",
    "Ground",
    "Motion",
    "Resting",
    "RockyGround",
    "RoverParameters",
    "SlipParameters",
    "Soil",
    "Stance",
    "State",
    "SwingDescent",
    "SwingParameters",
    "Trajectory",
    "Wind",
    "WindParameters",
    "drive",
    "settle",
]
