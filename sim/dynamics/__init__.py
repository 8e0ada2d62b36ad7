"""Dynamics of landers, helicopters and rovers: their true motion over time, and the wind.

This module exports what all motions share; each vehicle has its own module.
"""

from marsyard.sim.dynamics.trajectory import Motion, Resting, State, Trajectory
from marsyard.sim.dynamics.wind import Wind, WindParameters

__all__ = ["Motion", "Resting", "State", "Trajectory", "Wind", "WindParameters"]
