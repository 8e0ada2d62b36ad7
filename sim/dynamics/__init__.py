"""How vehicles move: truth states over time."""

from sim.dynamics.descent import DescentParameters, ParachuteDescent
from sim.dynamics.state import State
from sim.dynamics.trajectory import Motion, Trajectory

__all__ = ["DescentParameters", "Motion", "ParachuteDescent", "State", "Trajectory"]
