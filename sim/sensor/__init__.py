"""Instrument models: cameras, inertial and navigation sensors that measure the true state with errors."""

from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.detector import AutoExposure, AutoExposureParameters, Detector, DetectorParameters, auto_expose
from marsyard.sim.sensor.imu import Imu, ImuParameters, WarmUp
from marsyard.sim.sensor.inertial import Approach, ApproachParameters, InertialSolution, NavigationErrors
from marsyard.sim.sensor.instrument import Clock, ClockParameters, Readings, Sampling
from marsyard.sim.sensor.mast import (
    MASTS,
    Mast,
    MastState,
    PointingParameters,
    StereoCalibrationParameters,
    StereoHead,
    mount_on_head,
    stereo_mast,
)
from marsyard.sim.sensor.odometry import OdometryParameters
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

__all__ = ["MASTS", "PRESETS", "Approach", "ApproachParameters", "AutoExposure", "AutoExposureParameters"]
__all__ += ["CameraDesign", "Clock", "ClockParameters", "CustomCamera", "CustomCameraChoice", "Detector"]
__all__ += ["DetectorChoice", "DetectorParameters", "Gps", "GpsParameters", "ImageMotion", "Imu", "ImuIncrements"]
__all__ += ["ImuParameters", "InertialSolution", "LaserParameters", "Mast", "MastState", "NamedOrCustomCamera"]
__all__ += ["NavigationErrors", "OdometryParameters", "PointingParameters", "RadarAltimeter", "RadarParameters"]
__all__ += ["Readings", "Sampling", "StereoCalibrationParameters", "StereoHead", "WarmUp", "auto_expose"]
__all__ += ["height_above_ground", "mount_on_head", "natural_fall_off", "preset", "read_datasheet", "stereo_mast"]
