"""Instruments: how truth becomes measurements."""

from marsyard.sim.sensor.approach import Approach, ApproachParameters
from marsyard.sim.sensor.clock import Clock, ClockParameters
from marsyard.sim.sensor.datasheet import Datasheet, read_datasheet
from marsyard.sim.sensor.detector import Detector, DetectorParameters
from marsyard.sim.sensor.exposure import AutoExposure, AutoExposureParameters, auto_expose
from marsyard.sim.sensor.gps import POST_PROCESSED, Gps, GpsParameters
from marsyard.sim.sensor.imu import SMALL_UNIT, Imu, ImuIncrements, ImuParameters, WarmUp
from marsyard.sim.sensor.inertial import InertialSolution, NavigationErrors
from marsyard.sim.sensor.instrument import Instrument, Readings, Sampling
from marsyard.sim.sensor.laser import LaserAltimeter, LaserParameters
from marsyard.sim.sensor.mast import (
    MASTS,
    Mast,
    MastState,
    PointingParameters,
    StereoCalibrationParameters,
    StereoHead,
    on_head,
    stereo_mast,
)
from marsyard.sim.sensor.motion import ImageMotion
from marsyard.sim.sensor.odometry import Odometer, OdometryParameters, PoseEstimate, VisualOdometryParameters
from marsyard.sim.sensor.optics import natural_fall_off
from marsyard.sim.sensor.own_camera import NamedOrOwnCamera, OwnCamera, OwnCameraChoice
from marsyard.sim.sensor.presets import PRESETS, CameraDesign, DetectorChoice, Preset, preset
from marsyard.sim.sensor.radar import RadarAltimeter, RadarParameters
from marsyard.sim.sensor.ranging import height_above_ground
from marsyard.sim.sensor.rtk import RtkParameters, RtkReceiver, RtkSolutions
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings

__all__ = [
    "MASTS",
    "POST_PROCESSED",
    "PRESETS",
    "SMALL_UNIT",
    "Approach",
    "ApproachParameters",
    "AutoExposure",
    "AutoExposureParameters",
    "CameraDesign",
    "Clock",
    "ClockParameters",
    "Datasheet",
    "Detector",
    "DetectorChoice",
    "DetectorParameters",
    "Gps",
    "GpsParameters",
    "ImageMotion",
    "Imu",
    "ImuIncrements",
    "ImuParameters",
    "InertialSolution",
    "Instrument",
    "LaserAltimeter",
    "LaserParameters",
    "Mast",
    "MastState",
    "NamedOrOwnCamera",
    "NavigationErrors",
    "Odometer",
    "OdometryParameters",
    "OwnCamera",
    "OwnCameraChoice",
    "PointingParameters",
    "PoseEstimate",
    "Preset",
    "RadarAltimeter",
    "RadarParameters",
    "Readings",
    "RtkParameters",
    "RtkReceiver",
    "RtkSolutions",
    "Sampling",
    "StereoCalibrationParameters",
    "StereoHead",
    "TiltCompass",
    "TiltCompassParameters",
    "TiltCompassReadings",
    "VisualOdometryParameters",
    "WarmUp",
    "auto_expose",
    "height_above_ground",
    "natural_fall_off",
    "on_head",
    "preset",
    "read_datasheet",
    "stereo_mast",
]
