"""A motion, an altimeter, a source of attitudes and a score of one's own: copy, rename, replace.

    marsyard conformance custom_parts:Glider
    marsyard conformance custom_parts:PulsedLidar
    marsyard conformance custom_parts:StarTracker
    marsyard conformance custom_parts:sideways

What a class is handed, and what it gives: docs/custom-parts.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.scenarios.parts import DescentPlace, InstrumentReadings, InstrumentTruth, Poses, ScoredDescent


@dataclass(frozen=True)
class Glider:
    """A vehicle that glides in a straight line and rocks about its course; its heading is drawn."""

    random: ClassVar[bool] = True

    height_m: float = 1800.0  # of the first picture, above the ground at the place
    speed_m_s: float = 60.0
    glide_ratio: float = 0.5  # metres ahead for each metre down
    rocking_deg: float = 8.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.glide_ratio <= 5.0:
            raise ValueError(f"glide_ratio is {self.glide_ratio}; allowed: 0 to 5")

    def fly(self, place: DescentPlace, rng: np.random.Generator) -> Poses:
        """One glide over the place."""
        heading, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        down = self.speed_m_s / np.hypot(1.0, self.glide_ratio)
        lowest_s = (self.height_m - 0.5 * place.firing_height_m) / down
        times = np.arange(place.from_s - 0.1, max(place.until_s, lowest_s) + 0.1, 0.05)
        course = np.array([np.sin(heading), np.cos(heading), 0.0])
        positions = down * times[:, None] * (self.glide_ratio * course + np.array([0.0, 0.0, -1.0]))
        positions[:, 2] += self.height_m
        rocking = np.radians(self.rocking_deg) * np.sin(2.0 * np.pi * times / 3.0 + phase)
        attitudes = Rotation.from_rotvec(rocking[:, None] * course) * Rotation.from_euler("z", -heading)
        return Poses(times, positions, attitudes.as_quat(), {"heading_deg": float(np.degrees(heading))})


@dataclass(frozen=True)
class PulsedLidar:
    """An altimeter with a narrow beam: the first return along the axis, made vertical with the true tilt."""

    quantity: ClassVar[str] = "altitude"
    random: ClassVar[bool] = True

    beam_deg: float = 1.0
    scale_error: float = 0.005  # 1 sigma of a unit, common to its readings
    noise_m: float = 0.5  # 1 sigma of a reading
    late_s: float = 0.02  # a reading's age when it arrives

    def __post_init__(self) -> None:
        if not 0.01 <= self.beam_deg <= 20.0:
            raise ValueError(f"beam_deg is {self.beam_deg}; allowed: 0.01 to 20")

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        """The altitudes of one descent."""
        scale = 1.0 + self.scale_error * rng.standard_normal()
        times = truth.times_s - self.late_s
        ranges = np.array([truth.first_return_m(time, 0.5 * self.beam_deg, 10000.0) for time in times])
        upright = np.array([truth.motion.state(time).attitude.as_matrix()[2, 2] for time in times])
        altitudes = scale * ranges * upright + self.noise_m * rng.standard_normal(times.size)
        return InstrumentReadings(times, np.where(np.isfinite(ranges), altitudes, np.nan), {"scale": float(scale)})


@dataclass(frozen=True)
class StarTracker:
    """Attitudes with an error of its own in each."""

    quantity: ClassVar[str] = "attitude"
    random: ClassVar[bool] = True

    noise_deg: float = 0.05  # 1 sigma per axis

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        """The attitudes of one descent."""
        errors = Rotation.from_rotvec(np.radians(self.noise_deg) * rng.standard_normal((truth.times_s.size, 3)))
        read = errors * truth.motion.motion(truth.times_s).attitudes
        return InstrumentReadings(truth.times_s, read.as_quat())


MASS_KG = 533.0


def sideways(case: ScoredDescent) -> dict[str, float | bool]:
    """What of the landing goes sideways, and whether the answer helped."""
    with_answer = float(np.hypot(*case.touchdown_m_s))
    before = float(np.hypot(*case.at_firing.velocity_m_s[:2]))
    return {"energy_kj": 5e-4 * MASS_KG * with_answer**2, "slower": with_answer < before}
