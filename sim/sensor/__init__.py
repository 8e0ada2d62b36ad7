"""Instruments: how truth becomes measurements."""

from sim.sensor.altimeter import Altimeter, AltimeterParameters
from sim.sensor.detector import Detector, DetectorParameters
from sim.sensor.exposure import AutoExposure, AutoExposureParameters, auto_expose
from sim.sensor.motion import ImageMotion
from sim.sensor.navigation import Navigation, NavigationParameters
from sim.sensor.optics import natural_fall_off
from sim.sensor.presets import PRESETS, CameraDesign, DetectorChoice, Preset, preset

__all__ = [
    "PRESETS",
    "Altimeter",
    "AltimeterParameters",
    "AutoExposure",
    "AutoExposureParameters",
    "CameraDesign",
    "Detector",
    "DetectorChoice",
    "DetectorParameters",
    "ImageMotion",
    "Navigation",
    "NavigationParameters",
    "Preset",
    "auto_expose",
    "natural_fall_off",
    "preset",
]
