"""Parachute descent over Mars with three pictures: DIMES' scenario.

Read it in the order of a case: `parameters`, `world`, `flight`, `optics`, `exposure`, `measurement`, `score`;
`scenario` runs them one after the other.
"""

from marsyard.scenarios.descent.flight import flown_descent
from marsyard.scenarios.descent.optics import camera_optics
from marsyard.scenarios.descent.parameters import CameraParameters, DescentScenarioParameters
from marsyard.scenarios.descent.scenario import DescentScenario

__all__ = [
    "CameraParameters",
    "DescentScenario",
    "DescentScenarioParameters",
    "camera_optics",
    "flown_descent",
]
