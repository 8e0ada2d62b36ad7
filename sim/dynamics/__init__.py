"""How vehicles move: truth states over time."""

from sim.dynamics.chain import SwingParameters
from sim.dynamics.state import State
from sim.dynamics.swing import SwingDescent
from sim.dynamics.trajectory import Motion, Trajectory
from sim.dynamics.wind import Wind, WindParameters

__all__ = [
    "Motion",
    "State",
    "SwingDescent",
    "SwingParameters",
    "Trajectory",
    "Wind",
    "WindParameters",
]
