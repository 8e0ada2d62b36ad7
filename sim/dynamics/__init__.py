"""Dynamics of landers, helicopters and rovers: their true motion over time, and the wind."""

from marsyard.sim.dynamics.driving import Drive, DriveStep, SlipParameters, Soil, drive
from marsyard.sim.dynamics.rover import MER, ROCKY_8, Ground, RockyGround, RoverParameters, Stance, settle
from marsyard.sim.dynamics.swing import SwingDescent, SwingParameters
from marsyard.sim.dynamics.trajectory import Motion, Resting, State, Trajectory, Wind, WindParameters

__all__ = [
    "MER", "ROCKY_8", "Drive", "DriveStep", "Ground", "Motion", "Resting", "RockyGround", "RoverParameters",
    "SlipParameters", "Soil", "Stance", "State", "SwingDescent", "SwingParameters", "Trajectory", "Wind",
    "WindParameters", "drive", "settle",
]  # fmt: skip
