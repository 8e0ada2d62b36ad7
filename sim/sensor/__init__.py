"""Instrument models: cameras, inertial and navigation sensors that measure the true state with errors.

The instruments of rovers are in the modules `mast` and `odometry`.
"""

from marsyard.sim.sensor.altimeters import LaserParameters, RadarAltimeter, RadarParameters, height_above_ground
from marsyard.sim.sensor.approach import Approach, ApproachParameters, NavigationErrors
from marsyard.sim.sensor.auto_exposure import AutoExposure, AutoExposureParameters, auto_expose
from marsyard.sim.sensor.custom_camera import CustomCamera, CustomCameraChoice, NamedOrCustomCamera
from marsyard.sim.sensor.detector import Detector, DetectorParameters
from marsyard.sim.sensor.detector_choice import DetectorChoice, read_datasheet
from marsyard.sim.sensor.gps import Gps, GpsParameters
from marsyard.sim.sensor.image_motion import ImageMotion
from marsyard.sim.sensor.imu import Imu, ImuParameters, WarmUp
from marsyard.sim.sensor.inertial import InertialSolution
from marsyard.sim.sensor.instrument import Clock, ClockParameters, Readings, Sampling
from marsyard.sim.sensor.optics import natural_fall_off
from marsyard.sim.sensor.presets import PRESETS, CameraDesign, preset

__all__ = [
    "PRESETS", "Approach", "ApproachParameters", "AutoExposure", "AutoExposureParameters", "CameraDesign", "Clock",
    "ClockParameters", "CustomCamera", "CustomCameraChoice", "Detector", "DetectorChoice", "DetectorParameters", "Gps",
    "GpsParameters", "ImageMotion", "Imu", "ImuParameters", "InertialSolution", "LaserParameters",
    "NamedOrCustomCamera", "NavigationErrors", "RadarAltimeter", "RadarParameters", "Readings", "Sampling", "WarmUp",
    "auto_expose", "height_above_ground", "natural_fall_off", "preset", "read_datasheet",
]  # fmt: skip
