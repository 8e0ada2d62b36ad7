"""Examples of custom parts of a descent: a motion, an altimeter, an attitude source and a score.

    marsyard conformance custom_parts:Glider
    marsyard conformance custom_parts:PulsedLidar
    marsyard conformance custom_parts:StarTracker
    marsyard conformance custom_parts:lateral_impact

docs/custom-parts.md describes the inputs and results of each kind of part.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.scenarios.parts import InstrumentReadings, InstrumentTruth, MotionInputs, Poses, ScoredDescent


@dataclass(frozen=True)
class Glider:
    """Motion of a vehicle that glides in a straight line and rolls periodically; the heading is random."""

    random: ClassVar[bool] = True

    height_m: float = 1800.0  # at the first image, above the ground at the landing location
    speed_m_s: float = 60.0
    glide_ratio: float = 0.5  # horizontal divided by vertical distance
    roll_deg: float = 8.0  # amplitude of the roll angle, which has a period of 3 s

    def __post_init__(self) -> None:
        if not 0.0 <= self.glide_ratio <= 5.0:
            raise ValueError(f"glide_ratio is {self.glide_ratio}; allowed: 0 to 5")

    def fly(self, inputs: MotionInputs, rng: np.random.Generator) -> Poses:
        """Return the poses of one glide over the landing location."""
        heading, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        descent_rate = self.speed_m_s / np.hypot(1.0, self.glide_ratio)
        # the glide ends at half of the firing height, or later if the images require it
        end_s = (self.height_m - 0.5 * inputs.firing_height_m) / descent_rate
        times = np.arange(inputs.from_s - 0.1, max(inputs.until_s, end_s) + 0.1, 0.05)
        course = np.array([np.sin(heading), np.cos(heading), 0.0])
        positions = descent_rate * times[:, None] * (self.glide_ratio * course + np.array([0.0, 0.0, -1.0]))
        positions[:, 2] += self.height_m
        roll = np.radians(self.roll_deg) * np.sin(2.0 * np.pi * times / 3.0 + phase)
        attitudes = Rotation.from_rotvec(roll[:, None] * course) * Rotation.from_euler("z", -heading)
        return Poses(times, positions, attitudes.as_quat(), {"heading_deg": float(np.degrees(heading))})


@dataclass(frozen=True)
class PulsedLidar:
    """An altimeter with a narrow beam: the range of the first return, multiplied by the cosine of the true tilt."""

    quantity: ClassVar[str] = "altitude"
    random: ClassVar[bool] = True

    beam_deg: float = 1.0
    scale_error: float = 0.005  # 1 sigma of the relative error, constant in a descent
    noise_m: float = 0.5  # 1 sigma of a reading
    delay_s: float = 0.02  # age of a reading when it arrives

    def __post_init__(self) -> None:
        if not 0.01 <= self.beam_deg <= 20.0:
            raise ValueError(f"beam_deg is {self.beam_deg}; allowed: 0.01 to 20")

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        """Return the altitudes of one descent."""
        scale = 1.0 + self.scale_error * rng.standard_normal()
        times = truth.times_s - self.delay_s
        # the maximum range is 10 km
        ranges = np.array([truth.first_return_m(time, 0.5 * self.beam_deg, 10000.0) for time in times])
        cos_tilt = np.array([truth.motion.state(time).attitude.as_matrix()[2, 2] for time in times])
        altitudes = scale * ranges * cos_tilt + self.noise_m * rng.standard_normal(times.size)
        return InstrumentReadings(times, np.where(np.isfinite(ranges), altitudes, np.nan), {"scale": float(scale)})


@dataclass(frozen=True)
class StarTracker:
    """An attitude source with independent normal errors."""

    quantity: ClassVar[str] = "attitude"
    random: ClassVar[bool] = True

    noise_deg: float = 0.05  # 1 sigma per axis

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        """Return the attitudes of one descent."""
        errors = Rotation.from_rotvec(np.radians(self.noise_deg) * rng.standard_normal((truth.times_s.size, 3)))
        attitudes = errors * truth.motion.motion(truth.times_s).attitudes
        return InstrumentReadings(truth.times_s, attitudes.as_quat())


MASS_KG = 533.0  # lander with rover


def lateral_impact(case: ScoredDescent) -> dict[str, float | bool]:
    """Score the kinetic energy of the horizontal velocity at touchdown, and whether the answer reduced the velocity."""
    touchdown_m_s = float(np.hypot(*case.touchdown_m_s))
    firing_m_s = float(np.hypot(*case.at_firing.velocity_m_s[:2]))
    # kinetic energy m v^2 / 2, in kJ
    return {"energy_kj": 5e-4 * MASS_KG * touchdown_m_s**2, "slower": touchdown_m_s < firing_m_s}
