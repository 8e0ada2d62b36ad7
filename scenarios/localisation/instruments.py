"""Instruments of localisation: radar, clock of the images, and inertial navigation with its initial errors."""

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import InitialState
from marsyard.sim.dynamics import State, Trajectory
from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.measurements import AltitudeMeasurement
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor import ClockParameters, RadarAltimeter, RadarParameters

#: Margin of the inertial increments before the first and after the last time tag of the other clocks, s: the time tags
#: of the inertial unit have an offset of 0.2 ms rms.
INERTIAL_MARGIN_S = 0.05


#: Radar altimeter: errors of the MER altimeter; a beam of 40 deg includes nadir at tilts up to 20 deg (assumed).
RADAR = RadarParameters(rate_hz=2.0, beam_deg=40.0, max_range_m=8000.0)

#: Largest error of a time tag of images and altitudes, s (assumed): the interval of the images of Mars 2020, taken at
#: up to 1 Hz. With a larger error an image has the time of another one.
MAX_TAG_ERROR_S = 1.0
#: Largest error in standard deviations: 6e-7 of the tags have a larger one.
_TAG_SIGMAS = 5.0

#: Clock of the image time tags, relative to the true time; that of the inertial unit is in `ImuParameters` (assumed).
IMAGE_CLOCK = ClockParameters(offset_sd_s=0.001, jitter_sd_s=0.0005)
#: The filter begins with these standard deviations.
INITIAL = ErrorSource("initial", "initial state", remaining=0.1)


def check_clock(name: str, clock: ClockParameters) -> None:
    """Check that the errors of a clock stay below `MAX_TAG_ERROR_S`. Raises ValueError with the key `name`."""
    largest_s = abs(clock.offset_s) + _TAG_SIGMAS * float(np.hypot(clock.offset_sd_s, clock.jitter_sd_s))
    if largest_s > MAX_TAG_ERROR_S:
        raise ValueError(
            f"time tags of {name} are wrong by up to {largest_s:.6g} s (|offset_s| and {_TAG_SIGMAS:.0f} standard "
            f"deviations); allowed: up to {MAX_TAG_ERROR_S:.6g} s"
        )


def measure_altitudes(
    radar: RadarAltimeter, flight: Trajectory, span_s: tuple[float, float], rng: np.random.Generator
) -> list[AltitudeMeasurement]:
    """Measure the altitude at all samples of the radar in a span of true times; missing readings are omitted.

    The altitude is the range to the nearest ground in the radar's beam.
    """
    readings = radar.measure(flight, radar.sampling.within(*span_s), rng)
    return [
        AltitudeMeasurement(float(value), float(tag))
        for value, tag in zip(readings.values, readings.times_s, strict=True)
        if np.isfinite(value)
    ]


class InitialErrors(Parameters):
    """Errors of inertial navigation at the start of localisation; all are normally distributed.

    The horizontal position error is truncated at `horizontal_max_m` (3.2 km, Mars 2020). The attitude is that of the
    star tracker, propagated through entry. Standard deviations are assumed. Errors of the initial state are independent
    of each other and of the inertial unit's errors.
    """

    horizontal_sd_m: Annotated[
        NonNegative, INITIAL, Field(description="sd per axis before truncation, m (assumed)")
    ] = 1000.0
    horizontal_max_m: Annotated[float, Field(gt=0.0, description="largest horizontal position error, m")] = 3200.0
    vertical_sd_m: Annotated[NonNegative, INITIAL, Field(description="sd of the height, m (assumed)")] = 100.0
    velocity_sd_m_s: Annotated[NonNegative, INITIAL, Field(description="sd per axis, m/s (assumed)")] = 1.0
    attitude_sd_deg: Annotated[NonNegative, INITIAL, Field(description="sd per axis, deg (assumed)")] = 0.1

    def covariance(self) -> Float64[np.ndarray, "9 9"]:
        """Compute the covariance of position (m), velocity (m/s) and attitude (rad) as drawn, with the truncation."""
        horizontal = self.horizontal_sd_m**2 * self._truncated_variance()
        attitude = np.radians(self.attitude_sd_deg) ** 2
        position = [horizontal, horizontal, self.vertical_sd_m**2]
        return np.diag([*position, *[self.velocity_sd_m_s**2] * 3, *[attitude] * 3])

    def draw(self, truth: State, time_s: float, gravity_m_s2: float, rng: np.random.Generator) -> InitialState:
        """Draw the initial state; `time_s` is the time of the true state on the clock of the inertial unit."""
        position, velocity, attitude = rng.standard_normal((3, 3))
        angle, quantile = 2.0 * np.pi * rng.random(), rng.random()
        # inverse of the distribution of the radius, 1 - exp(-r^2 / (2 sd^2)), truncated
        radius = self.horizontal_sd_m * np.sqrt(-2.0 * np.log1p(quantile * np.expm1(-self._truncation())))
        error = np.array([radius * np.cos(angle), radius * np.sin(angle), self.vertical_sd_m * position[2]])
        rotation = Rotation.from_rotvec(np.radians(self.attitude_sd_deg) * attitude)
        return InitialState(
            time_s=time_s,
            position_m=truth.position_m - error,
            velocity_m_s=truth.velocity_m_s - self.velocity_sd_m_s * velocity,
            # the error e is defined by true attitude = exp(e) estimated attitude
            world_from_body=rotation.inv() * truth.attitude,
            covariance=self.covariance(),
            gravity_m_s2=gravity_m_s2,
        )

    def _truncation(self) -> float:
        """Return k = (maximum / sd)^2 / 2; the radius^2 / (2 sd^2) is exponentially distributed up to k."""
        return 0.5 * (self.horizontal_max_m / max(self.horizontal_sd_m, 1e-6 * self.horizontal_max_m)) ** 2

    def _truncated_variance(self) -> float:
        """Compute the mean of an exponential distribution truncated at k, 1 - k / (e^k - 1): variance / sd^2."""
        k = min(self._truncation(), 700.0)
        return float(1.0 - k / np.expm1(k))
