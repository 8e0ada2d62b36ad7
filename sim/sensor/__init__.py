"""Instruments: how truth becomes measurements."""

from sim.sensor.altimeter import Altimeter, AltimeterParameters
from sim.sensor.detector import Detector, DetectorParameters
from sim.sensor.navigation import Navigation, NavigationParameters

__all__ = [
    "Altimeter",
    "AltimeterParameters",
    "Detector",
    "DetectorParameters",
    "Navigation",
    "NavigationParameters",
]
