"""Magnetic compass with inclinometers: heading and up direction.

The inclinometers are damped pendulums that follow the specific force with a lag: they measure the direction of gravity
only if the vehicle does not accelerate. The compass projects the magnetic field on the horizontal plane measured by the
inclinometers. Because the field is inclined, each tilt error causes a heading error. Iron in the vehicle causes errors
that vary with the heading: as its sine for magnetised (hard) iron, as the sine of twice the heading for soft iron.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.error_sources import COMPASS
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor.instrument import Clock, ClockParameters, Sampling, Times, Vectors

Degrees = Annotated[NonNegative, Field(le=90.0)]
LAG_STEPS_PER_S = 100.0  #: Steps of the lag filter per second: twenty per default time constant.
SETTLING_TIME_CONSTANTS = 12.0  #: Duration of the initial settling in time constants: the residual is 6e-6.
ReadingArray = Float64[np.ndarray, "n *components"]


class TiltCompassParameters(Parameters):
    """Parameters of a unit like Precision Navigation's TCM2; errors are standard deviations.

    Specification of such units: 0.2 deg in tilt, 1 deg in heading, 16 readings per second, resolution 0.1 deg. Assumed:
    the split into error terms, the lag and the effects of the vehicle.
    """

    rate_hz: Annotated[float, Field(gt=0.0, le=100.0, description="readings per second")] = 16.0
    tilt_bias_deg: Annotated[Degrees, COMPASS, Field(description="inclinometer bias, mounting included")] = 0.2
    tilt_noise_deg: Annotated[Degrees, COMPASS, Field(description="inclinometer noise per reading")] = 0.15
    lag_s: Annotated[float, Field(gt=0.0, le=5.0, description="time constant of the inclinometers, s")] = 0.2
    heading_bias_deg: Annotated[
        Degrees, COMPASS, Field(description="heading bias, mounting and declination included")
    ] = 0.8
    hard_iron_deg: Annotated[Degrees, COMPASS, Field(description="amplitudes of sine and cosine of the heading")] = 0.5
    soft_iron_deg: Annotated[Degrees, COMPASS, Field(description="amplitudes for twice the heading")] = 0.25
    heading_noise_deg: Annotated[Degrees, COMPASS, Field(description="heading noise per reading")] = 0.3
    dip_deg: Annotated[float, Field(ge=-85.0, le=85.0, description="magnetic field below the horizon, deg")] = 59.0
    count_deg: Annotated[Degrees, Field(description="heading resolution, deg; 0: no rounding")] = 0.1
    heading_stuck_s: Annotated[float | None, Field(description="true time after which the heading is stuck")] = None
    tilt_stuck_s: Annotated[float | None, Field(description="true time after which the inclinometers are stuck")] = None
    clock: ClockParameters = ClockParameters(offset_sd_s=0.005, jitter_sd_s=0.002)


@dataclass(frozen=True)
class TiltCompassReadings:
    """Readings of a tilt compass.

    - up_body: up direction from the inclinometers, unit vectors in body axes
    - headings_rad: azimuth of the body's x axis, clockwise from north, in [0, 2 pi)
    """

    times_s: Times
    up_body: Vectors
    headings_rad: Float64[np.ndarray, "n"]


@dataclass(frozen=True)
class TiltCompass:
    """A tilt compass with its constant errors.

    - tilt_bias_rad: error of the x and y components of the up direction
    - iron_rad: amplitudes of sine and cosine of the heading, and of sine and cosine of twice the heading
    """

    parameters: TiltCompassParameters
    sampling: Sampling
    clock: Clock
    tilt_bias_rad: Float64[np.ndarray, "2"]
    heading_bias_rad: float
    iron_rad: Float64[np.ndarray, "4"]

    @classmethod
    def draw(cls, parameters: TiltCompassParameters, rng: np.random.Generator) -> TiltCompass:
        """Draw the constant errors."""
        p = parameters
        iron = np.array([p.hard_iron_deg, p.hard_iron_deg, p.soft_iron_deg, p.soft_iron_deg])
        return cls(
            p,
            Sampling.draw(p.rate_hz, rng),
            Clock.draw(p.clock, rng),
            tilt_bias_rad=np.radians(p.tilt_bias_deg) * rng.standard_normal(2),
            heading_bias_rad=np.radians(p.heading_bias_deg) * float(rng.standard_normal()),
            iron_rad=np.radians(iron) * rng.standard_normal(4),
        )

    def measure(self, trajectory: Trajectory, times_s: Times, rng: np.random.Generator) -> TiltCompassReadings:
        """Measure one reading per true time (non-decreasing); pendulums are settled at the start of the trajectory."""
        p = self.parameters
        lagged_up = self._compute_lagged_up(trajectory, times_s)
        tags = self.clock.tags(times_s, rng)
        tilt_noise, heading_noise = np.split(rng.standard_normal((times_s.size, 3)), [2], axis=1)
        biased_up = _add_offset(lagged_up, self.tilt_bias_rad)
        # azimuths from the magnetic field, projected on the plane perpendicular to the measured up directions
        dip = np.radians(p.dip_deg)
        attitudes = trajectory.motion(times_s).attitudes
        magnetic = attitudes.inv().apply(np.array([0.0, np.cos(dip), -np.sin(dip)]))
        north = _normalize(magnetic - np.sum(magnetic * biased_up, axis=1)[:, None] * biased_up)
        azimuths = np.arctan2(np.cross(north, biased_up)[:, 0], north[:, 0])
        headings = azimuths + self.deviation_rad(azimuths) + np.radians(p.heading_noise_deg) * heading_noise[:, 0]
        if p.count_deg > 0.0:
            headings = np.radians(p.count_deg) * np.rint(headings / np.radians(p.count_deg))
        up = _add_offset(biased_up, np.radians(p.tilt_noise_deg) * tilt_noise)
        headings = _hold_stuck_readings(np.mod(headings, 2.0 * np.pi), times_s, p.heading_stuck_s)
        return TiltCompassReadings(tags, _hold_stuck_readings(up, times_s, p.tilt_stuck_s), headings)

    def deviation_rad(self, azimuths_rad: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """Compute the noise-free heading error of a level unit at rest, at true azimuths."""
        harmonics = np.stack([f(k * azimuths_rad) for k in (1.0, 2.0) for f in (np.sin, np.cos)])
        return np.asarray(self.heading_bias_rad + self.iron_rad @ harmonics)

    def _compute_lagged_up(self, trajectory: Trajectory, times_s: Times) -> Vectors:
        """Compute the up directions of the pendulums, body axes: unit specific force with a lag."""
        if times_s.size == 0:
            return np.zeros((0, 3))
        lag = self.parameters.lag_s
        start = max(trajectory.span_s[0], float(times_s[0]) - SETTLING_TIME_CONSTANTS * lag)
        steps = max(int(np.ceil((times_s[-1] - start) * LAG_STEPS_PER_S)), 1)
        grid = np.linspace(start, float(times_s[-1]), steps + 1) if times_s[-1] > start else np.array([start])
        force = _normalize(trajectory.motion(grid).specific_forces_m_s2)
        if grid.size == 1:
            return np.repeat(force, times_s.size, axis=0)
        # the filter is exact for a specific force that is constant in each step
        decay = np.exp(-(grid[1] - grid[0]) / lag)
        mean_force = 0.5 * (force[1:] + force[:-1])
        filtered, _ = scipy.signal.lfilter([1.0 - decay], [1.0, -decay], mean_force, axis=0, zi=decay * force[:1])
        filtered = np.concatenate([force[:1], filtered])
        return _normalize(np.stack([np.interp(times_s, grid, column) for column in filtered.T], axis=1))


def _normalize(vectors: Vectors) -> Vectors:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _add_offset(up: Vectors, offset: Float64[np.ndarray, "*any 2"]) -> Vectors:
    tilted = up.copy()
    tilted[:, :2] += offset
    return _normalize(tilted)


def _hold_stuck_readings(values: ReadingArray, times_s: Times, stuck_s: float | None) -> ReadingArray:
    """Replace the readings after `stuck_s` by the last reading before it (or by the first reading)."""
    if stuck_s is None or values.size == 0:
        return values
    stuck_values = values.copy()
    last = max(int(np.searchsorted(times_s, stuck_s, side="right")) - 1, 0)
    stuck_values[last:] = values[last]
    return stuck_values
