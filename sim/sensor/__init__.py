"""Instruments: how truth becomes measurements."""

from sim.sensor.approach import Approach, ApproachParameters
from sim.sensor.clock import Clock, ClockParameters
from sim.sensor.datasheet import Datasheet, read_datasheet
from sim.sensor.detector import Detector, DetectorParameters
from sim.sensor.exposure import AutoExposure, AutoExposureParameters, auto_expose
from sim.sensor.gps import POST_PROCESSED, RTK, STANDALONE, Gps, GpsParameters
from sim.sensor.imu import SMALL_UNIT, Imu, ImuIncrements, ImuParameters, WarmUp
from sim.sensor.inertial import InertialSolution, NavigationErrors
from sim.sensor.instrument import Instrument, Readings, Sampling
from sim.sensor.laser import LaserAltimeter, LaserParameters
from sim.sensor.mast import (
    MASTS,
    Mast,
    MastState,
    PointingParameters,
    StereoCalibrationParameters,
    StereoHead,
    on_head,
    stereo_mast,
)
from sim.sensor.motion import ImageMotion
from sim.sensor.odometry import Odometer, OdometryParameters, PoseEstimate, VisualOdometryParameters
from sim.sensor.optics import natural_fall_off
from sim.sensor.own_camera import NamedOrOwnCamera, OwnCamera, OwnCameraChoice
from sim.sensor.presets import PRESETS, CameraDesign, DetectorChoice, Preset, preset
from sim.sensor.radar import RadarAltimeter, RadarParameters
from sim.sensor.ranging import height_above_ground
from sim.sensor.rtk import RtkParameters, RtkReceiver, RtkSolutions
from sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings

__all__ = [
    "MASTS",
    "POST_PROCESSED",
    "PRESETS",
    "RTK",
    "SMALL_UNIT",
    "STANDALONE",
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
