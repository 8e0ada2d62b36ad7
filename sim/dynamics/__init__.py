"""How vehicles move: truth states over time."""

from sim.dynamics.descent import DescentParameters, ParachuteDescent
from sim.dynamics.state import State

__all__ = ["DescentParameters", "ParachuteDescent", "State"]
