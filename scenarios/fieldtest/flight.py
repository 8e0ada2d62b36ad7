"""True motion of a run of the field test: its flight, clouds and sun, and the instruments that all its cases share.

The sun on Earth is computed by the method of low accuracy in Meeus, "Astronomical Algorithms" (1998), chapter 25. The
error is 0.01 deg in this century. Refraction (0.02 deg at 45 deg of elevation) and parallax (0.002 deg) are neglected.
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.cameras import camera_optics, draw_calibrated
from marsyard.scenarios.fieldtest.parameters import CAMERA, FieldTestParameters, RunParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.helicopter import HelicopterFlight
from marsyard.sim.frames import direction
from marsyard.sim.render import CloudLayer
from marsyard.sim.sensor import Detector, preset
from marsyard.sim.streams import Streams

#: Noon of 1 January 2000, and terrestrial time minus universal time in 2002, s.
_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
_TT_MINUS_UT_S = 64.3


def sun_direction(time: datetime, latitude_deg: float, longitude_deg: float) -> Float64[np.ndarray, "3"]:
    """Compute the unit vector to the sun's centre in the local level frame (east, north, up).

    Latitude is geodetic, longitude positive to the east. Raises ValueError for a time without a time zone.
    """
    if time.tzinfo is None:
        raise ValueError(f"the time {time} has no time zone; it needs one, as in 2002-10-15T12:00-07:00")
    days = (time - _J2000).total_seconds() / 86400.0
    t = (days + _TT_MINUS_UT_S / 86400.0) / 36525.0  # Julian centuries since J2000
    # Meeus 25.2 to 25.8: mean longitude and anomaly, equation of centre, apparent longitude (nutation, aberration)
    mean_longitude = 280.46646 + 36000.76983 * t + 0.0003032 * t**2
    anomaly = np.radians(357.52911 + 35999.05029 * t - 0.0001537 * t**2)
    equation_of_centre = (
        (1.914602 - 0.004817 * t) * np.sin(anomaly)
        + (0.019993 - 0.000101 * t) * np.sin(2.0 * anomaly)
        + 0.000289 * np.sin(3.0 * anomaly)
    )
    node = np.radians(125.04 - 1934.136 * t)
    longitude = np.radians(mean_longitude + equation_of_centre - 0.00569 - 0.00478 * np.sin(node))
    obliquity = np.radians(23.4392911 - 0.0130042 * t + 0.00256 * np.cos(node))
    right_ascension = np.arctan2(np.cos(obliquity) * np.sin(longitude), np.cos(longitude))
    declination = np.arcsin(np.sin(obliquity) * np.sin(longitude))
    # mean sidereal time at Greenwich (Meeus 12.4); nutation, at most 0.005 deg, is neglected
    sidereal = np.radians((280.46061837 + 360.98564736629 * days + longitude_deg) % 360.0)
    hour = sidereal - right_ascension
    latitude = np.radians(latitude_deg)
    elevation = np.arcsin(
        np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
    )
    east = -np.cos(declination) * np.sin(hour)
    north = np.sin(declination) * np.cos(latitude) - np.cos(declination) * np.sin(latitude) * np.cos(hour)
    return direction(float(np.arctan2(east, north)), float(elevation))


@dataclass(frozen=True)
class RunKey:
    """Inputs that determine a run: the field test, the run's index in it, the campaign's seed and name."""

    field_test: FieldTestParameters
    number: int
    seed: int
    campaign: str

    @property
    def parameters(self) -> RunParameters:
        """Parameters of the run."""
        return self.field_test.runs[self.number]

    def generator(self, name: str) -> np.random.Generator:
        """Create a generator that is the same for all cases of the run."""
        return self.shared_generator(f"run {self.parameters.name}: {name}")

    def shared_generator(self, name: str) -> np.random.Generator:
        """Create a generator that is the same for all runs and cases."""
        return Streams(self.seed, self.campaign, 0).generator(name)

    def detector(self) -> Detector:
        """Draw the detector, which is the same for all cases; a faulty cable disturbs its readout in some runs."""
        fall_off = camera_optics(field_camera()).fall_off
        rng = self.shared_generator("detector response")
        return Detector.draw(fall_off, self.field_test.run_detector(self.number), rng)

    def calibrated_camera(self) -> CameraModel:
        """Draw the calibrated camera of the delivered images in the body frame, which is the same for all cases."""
        p, rng = self.field_test, self.shared_generator("camera calibration")
        return p.detector.delivered_camera(draw_calibrated(field_camera(), p.calibration, rng))


@dataclass(frozen=True)
class FlownRun:
    """Flight and clouds of a run, before its data are processed.

    - clouds: clouds that drift with the flight's time; None for a clear sky
    - flight: the true motion
    """

    key: RunKey
    clouds: CloudLayer | None
    flight: HelicopterFlight

    @property
    def parameters(self) -> RunParameters:
        """Parameters of the run."""
        return self.key.parameters

    def sun(self, time_s: float) -> Float64[np.ndarray, "3"]:
        """Return the unit vector to the sun at a time of the flight, world axes."""
        p = self.parameters
        elapsed = timedelta(seconds=time_s - self.flight.passes[0].start_s)
        return sun_direction(p.begins + elapsed, p.latitude_deg, p.longitude_deg)


def field_camera() -> CameraModel:
    """Return the field test's camera in the body frame."""
    (camera,) = preset(CAMERA).cameras()
    return camera
