"""Instrument models: cameras, inertial and navigation sensors that measure the true state with errors.

The instruments of rovers are in the modules `mast` and `odometry`.
"""

from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.approach import Approach, ApproachParameters
from marsyard.sim.sensor.auto_exposure import AutoExposure, AutoExposureParameters, auto_expose
from marsyard.sim.sensor.detector import Detector, DetectorParameters
from marsyard.sim.sensor.imu import Imu, ImuParameters, WarmUp
from marsyard.sim.sensor.inertial import InertialSolution, NavigationErrors
from marsyard.sim.sensor.instrument import Clock, ClockParameters, Readings, Sampling
from marsyard.sim.sensor.optics import ImageMotion, natural_fall_off
from marsyard.sim.sensor.presets import (
    PRESETS,
    CameraDesign,
    CustomCamera,
    CustomCameraChoice,
    DetectorChoice,
    NamedOrCustomCamera,
    preset,
    read_datasheet,
)
from marsyard.sim.sensor.ranging import LaserParameters, RadarAltimeter, RadarParameters, height_above_ground
from marsyard.sim.sensor.satellite_navigation import Gps, GpsParameters

__all__ = ["PRESETS", "Approach", "ApproachParameters", "AutoExposure", "AutoExposureParameters", "CameraDesign"]
__all__ += ["Clock", "ClockParameters", "CustomCamera", "CustomCameraChoice", "Detector", "DetectorChoice"]
__all__ += ["DetectorParameters", "Gps", "GpsParameters", "ImageMotion", "Imu", "ImuIncrements", "ImuParameters"]
__all__ += ["InertialSolution", "LaserParameters", "NamedOrCustomCamera", "NavigationErrors", "RadarAltimeter"]
__all__ += ["RadarParameters", "Readings", "Sampling", "WarmUp", "auto_expose", "height_above_ground"]
__all__ += ["natural_fall_off", "preset", "read_datasheet"]
