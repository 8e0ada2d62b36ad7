"""A magnetic compass with inclinometers in one unit: heading, and which way is up.

The inclinometers are small pendulums: they settle, with a lag, along the specific force, and so show gravity only when
the vehicle does not accelerate. The compass levels the magnetic field by what they show, so that in an inclined field
every false tilt turns the heading too. Iron on board turns it with the heading: once round for magnetised (hard), twice
for magnetisable (soft) iron.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy  # its signal is slow to import, and so left until it is called
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor.clock import Clock, ClockParameters
from marsyard.sim.sensor.instrument import Sampling

Degrees = Annotated[NonNegative, Field(le=90.0)]
#: Steps of the lag per second: twenty within the time constant that is the default.
LAG_STEPS_PER_S = 100.0
#: Time constants after which nothing is left of what was before: 6e-6.
SETTLED = 12.0


class TiltCompassParameters(Parameters):
    """A unit of the class of Precision Navigation's TCM2; spreads are one standard deviation.

    Accuracy of 0.2 deg in tilt and 1 deg in heading, 16 readings per second, counts of 0.1 deg: the class's
    specification. How they divide into parts, the lag and what the vehicle adds are assumed.
    """

    rate_hz: Annotated[float, Field(gt=0.0, le=100.0, description="readings per second")] = 16.0
    tilt_bias_deg: Annotated[Degrees, Field(description="constant error of each inclinometer, mounting included")] = 0.2
    tilt_noise_deg: Annotated[Degrees, Field(description="of each inclinometer, new in every reading")] = 0.15
    lag_s: Annotated[float, Field(gt=0.0, le=5.0, description="time constant of the inclinometers, s")] = 0.2
    heading_bias_deg: Annotated[Degrees, Field(description="constant error, mounting and declination included")] = 0.8
    hard_iron_deg: Annotated[Degrees, Field(description="amplitude of the error once round, per component")] = 0.5
    soft_iron_deg: Annotated[Degrees, Field(description="amplitude of the error twice round, per component")] = 0.25
    heading_noise_deg: Annotated[Degrees, Field(description="new in every reading")] = 0.3
    dip_deg: Annotated[float, Field(ge=-85.0, le=85.0, description="of the magnetic field below the horizon")] = 59.0
    count_deg: Annotated[Degrees, Field(description="of the heading, deg; 0: no rounding")] = 0.1
    heading_stuck_s: Annotated[float | None, Field(description="true time after which the heading is stuck")] = None
    tilt_stuck_s: Annotated[float | None, Field(description="true time after which the inclinometers are stuck")] = None
    clock: ClockParameters = ClockParameters(offset_sd_s=0.005, jitter_sd_s=0.002)


@dataclass(frozen=True)
class TiltCompassReadings:
    """What the unit delivers.

    Attributes
    ----------
    times_s
        Time tags, seconds.
    up_body
        Upwards as the inclinometers have it, unit vectors in body axes.
    headings_rad
        Azimuth of the body's x axis, clockwise from north, in [0, 2 pi).
    """

    times_s: Float64[np.ndarray, "n"]
    up_body: Float64[np.ndarray, "n 3"]
    headings_rad: Float64[np.ndarray, "n"]


@dataclass(frozen=True)
class TiltCompass:
    """One unit, its constant errors drawn.

    Attributes
    ----------
    parameters, sampling, clock
        Its class, when it reads, and what its clock makes of that.
    tilt_bias_rad
        Error of the x and y components of up.
    heading_bias_rad
        Constant error.
    iron_rad
        Amplitudes of the sine and cosine of the heading, then of those of twice the heading.
    """

    parameters: TiltCompassParameters
    sampling: Sampling
    clock: Clock
    tilt_bias_rad: Float64[np.ndarray, "2"]
    heading_bias_rad: float
    iron_rad: Float64[np.ndarray, "4"]

    @classmethod
    def drawn(cls, parameters: TiltCompassParameters, rng: np.random.Generator) -> TiltCompass:
        """A unit with its errors drawn."""
        p = parameters
        iron = np.array([p.hard_iron_deg, p.hard_iron_deg, p.soft_iron_deg, p.soft_iron_deg])
        return cls(
            p,
            Sampling.drawn(p.rate_hz, rng),
            Clock.drawn(p.clock, rng),
            tilt_bias_rad=np.radians(p.tilt_bias_deg) * rng.standard_normal(2),
            heading_bias_rad=np.radians(p.heading_bias_deg) * float(rng.standard_normal()),
            iron_rad=np.radians(iron) * rng.standard_normal(4),
        )

    def measure(
        self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"], rng: np.random.Generator
    ) -> TiltCompassReadings:
        """One reading at each true time; times must not decrease. Before the trajectory's start it had settled."""
        p = self.parameters
        shown = self._shown(trajectory, times_s)
        tags = self.clock.tags(times_s, rng)
        shocks = rng.standard_normal((times_s.size, 3))
        levelled = self._with_bias(shown)
        headings = self._headings(trajectory, times_s, levelled)
        up = levelled.copy()
        up[:, :2] += np.radians(p.tilt_noise_deg) * shocks[:, :2]
        headings = headings + np.radians(p.heading_noise_deg) * shocks[:, 2]
        if p.count_deg > 0.0:
            headings = np.radians(p.count_deg) * np.rint(headings / np.radians(p.count_deg))
        return TiltCompassReadings(
            tags,
            _held(_unit(up), times_s, p.tilt_stuck_s),
            _held(np.mod(headings, 2.0 * np.pi), times_s, p.heading_stuck_s),
        )

    def deviation_rad(self, azimuths_rad: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """Error of the heading of a level unit at rest, noise apart, at true azimuths."""
        a = azimuths_rad
        round_about = np.stack([np.sin(a), np.cos(a), np.sin(2.0 * a), np.cos(2.0 * a)])
        return np.asarray(self.heading_bias_rad + self.iron_rad @ round_about)

    def _shown(self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Directions along which the pendulums lie: those of the specific force, lagging."""
        if times_s.size == 0:
            return np.zeros((0, 3))
        lag = self.parameters.lag_s
        start = max(trajectory.span_s[0], float(times_s[0]) - SETTLED * lag)
        steps = max(int(np.ceil((times_s[-1] - start) * LAG_STEPS_PER_S)), 1)
        grid = np.linspace(start, float(times_s[-1]), steps + 1) if times_s[-1] > start else np.array([start])
        felt = _unit(trajectory.motion(grid).specific_forces_m_s2)
        if grid.size == 1:
            return np.repeat(felt, times_s.size, axis=0)
        # exact for a force that is constant about the middle of each step
        kept = np.exp(-(grid[1] - grid[0]) / lag)
        middle = 0.5 * (felt[1:] + felt[:-1])
        lagged, _ = scipy.signal.lfilter([1.0 - kept], [1.0, -kept], middle, axis=0, zi=kept * felt[:1])
        followed = np.concatenate([felt[:1], lagged])
        columns = [np.interp(times_s, grid, followed[:, axis]) for axis in range(3)]
        return _unit(np.stack(columns, axis=1))

    def _with_bias(self, up: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        biased = up.copy()
        biased[:, :2] += self.tilt_bias_rad
        return _unit(biased)

    def _headings(
        self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"], up: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n"]:
        """Azimuths from the magnetic field levelled by these directions, with bias and iron."""
        dip = np.radians(self.parameters.dip_deg)
        attitudes = trajectory.motion(times_s).attitudes
        magnetic = attitudes.inv().apply(np.array([0.0, np.cos(dip), -np.sin(dip)]))
        north = _unit(magnetic - np.sum(magnetic * up, axis=1)[:, None] * up)
        east = np.cross(north, up)
        azimuths = np.arctan2(east[:, 0], north[:, 0])
        return np.asarray(azimuths + self.deviation_rad(azimuths))


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _held(
    values: Float64[np.ndarray, "n *one"], times_s: Float64[np.ndarray, "n"], stuck_s: float | None
) -> Float64[np.ndarray, "n *one"]:
    """Values, of which those after a time repeat the last before it (or the first)."""
    if stuck_s is None or values.size == 0:
        return values
    held = values.copy()
    last = max(int(np.searchsorted(times_s, stuck_s, side="right")) - 1, 0)
    held[last:] = values[last]
    return held
