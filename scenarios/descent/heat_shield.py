"""The heat shield, falling ahead of the lander through its pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics import State
from marsyard.sim.render import Frame, Sun

#: MER's aeroshell (Desai & Knocke 2004), m.
DIAMETER_M = 2.65
#: Assumed: it falls faster than the lander, drifts aside, and tumbles.
FASTER_M_S, ASIDE_M_S, TUMBLE_RAD_S = 20.0, 2.0, 1.0
#: Assumed: how far from straight below it is in the first picture, at most, radians.
OFF_NADIR_RAD = 0.2
#: Assumed albedo of the charred outside and of the inside's insulation.
OUTSIDE, INSIDE = 0.1, 0.5


@dataclass(frozen=True)
class HeatShield:
    """A disc, which its cone of 70 deg half angle nearly is, that falls freely and tumbles.

    Attributes
    ----------
    place_m, velocity_m_s
        Of its centre at the first picture, world axes.
    normal, spin_rad_s
        Outward normal at the first picture, and its angular velocity, world axes.
    start_s
        Time of the first picture.
    """

    place_m: Float64[np.ndarray, "3"]
    velocity_m_s: Float64[np.ndarray, "3"]
    normal: Float64[np.ndarray, "3"]
    spin_rad_s: Float64[np.ndarray, "3"]
    start_s: float

    @classmethod
    def drawn(cls, first: State, angle_rad: float, rng: np.random.Generator) -> HeatShield:
        """Below the lander at its first picture, where it takes this angle when seen face on."""
        azimuth, off_nadir, aside, turn = rng.uniform(0.0, 1.0, 4) * [2 * np.pi, OFF_NADIR_RAD, 2 * np.pi, 2 * np.pi]
        below = np.array([np.sin(azimuth) * np.sin(off_nadir), np.cos(azimuth) * np.sin(off_nadir), -np.cos(off_nadir)])
        drift = np.array([ASIDE_M_S * np.sin(aside), ASIDE_M_S * np.cos(aside), -FASTER_M_S])
        axis = np.array([np.cos(turn), np.sin(turn), 0.0])
        return cls(
            place_m=first.position_m + DIAMETER_M / (2.0 * np.tan(0.5 * angle_rad)) * below,
            velocity_m_s=first.velocity_m_s + drift,
            normal=Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * axis).apply([0.0, 0.0, -1.0]),
            spin_rad_s=TUMBLE_RAD_S * axis,
            start_s=first.time_s,
        )

    def over(
        self, radiance: Float32[np.ndarray, "rows columns"], frame: Frame, sun: Sun, time_s: float
    ) -> Float32[np.ndarray, "rows columns"]:
        """A picture's radiance factor with the shield in it; lit by the sun alone, as a Lambert surface."""
        since = time_s - self.start_s
        centre = self.place_m + since * self.velocity_m_s
        normal = Rotation.from_rotvec(since * self.spin_rad_s).apply(self.normal)
        origin = frame.world_from_body.apply(frame.rays.centre)
        directions = frame.world_from_body.rotation.apply(frame.rays.directions.astype(np.float64))
        towards = directions @ normal
        along = ((centre - origin) @ normal) / np.where(np.abs(towards) > 1e-9, towards, 1e-9)
        away = np.linalg.norm(origin + along[:, None] * directions - centre, axis=1)
        hit = (along > 0.0) & (away < 0.5 * DIAMETER_M)
        # the side that is seen faces against the ray
        lit = np.maximum(-np.sign(towards) * float(normal @ sun.direction), 0.0)
        shine = np.where(towards < 0.0, OUTSIDE, INSIDE) * lit
        covered = np.where(hit, shine, radiance.reshape(-1))
        return covered.astype(np.float32).reshape(radiance.shape)
