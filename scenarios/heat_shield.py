"""Heat shield that falls below a lander, and covers a part of its images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics import State
from marsyard.sim.render import Frame, Sun

#: Downward speed of the released heat shield relative to the lander, m/s (assumed).
SHIELD_FALL_M_S = 20.0
#: Diameter of MER's aeroshell (Desai & Knocke 2004), m.
SHIELD_DIAMETER_M = 2.65
#: Heat shield relative to the lander: horizontal speed, m/s, and tumble rate, rad/s (assumed).
SHIELD_DRIFT_M_S, SHIELD_TUMBLE_RAD_S = 2.0, 1.0
#: Largest angle of the heat shield from nadir in the first image, radians (assumed).
SHIELD_MAX_OFF_NADIR_RAD = 0.2
#: Smallest cosine between a ray and the shield's normal, which keeps the distance of the intersection finite.
_MIN_COSINE = 1e-9
#: Body number of the shield, which is no row of the scene's objects.
SHIELD_BODY = np.int32(2**31 - 1)
#: Assumed albedos of the shield: charred outside, insulated inside.
SHIELD_OUTSIDE_ALBEDO, SHIELD_INSIDE_ALBEDO = 0.1, 0.5


@dataclass(frozen=True)
class HeatShield:
    """Freely falling, tumbling disc that approximates the shield's cone of 70 deg half angle.

    Centre, velocity, outward normal and angular velocity are those at the first image, in world axes.
    """

    centre_m: Float64[np.ndarray, "3"]
    velocity_m_s: Float64[np.ndarray, "3"]
    normal: Float64[np.ndarray, "3"]
    spin_rad_s: Float64[np.ndarray, "3"]
    start_s: float

    @classmethod
    def draw(cls, first: State, angle_rad: float, rng: np.random.Generator) -> HeatShield:
        """Draw a shield below the lander at its first image; `angle_rad` is its angular diameter seen face on."""
        limits = [2 * np.pi, SHIELD_MAX_OFF_NADIR_RAD, 2 * np.pi, 2 * np.pi]
        azimuth, off_nadir, drift_azimuth, axis_azimuth = rng.uniform(size=4) * limits
        ray = np.array([np.sin(azimuth) * np.sin(off_nadir), np.cos(azimuth) * np.sin(off_nadir), -np.cos(off_nadir)])
        drift_direction = np.array([np.sin(drift_azimuth), np.cos(drift_azimuth)])
        drift = np.array([*(SHIELD_DRIFT_M_S * drift_direction), -SHIELD_FALL_M_S])
        axis = np.array([np.cos(axis_azimuth), np.sin(axis_azimuth), 0.0])
        return cls(
            centre_m=first.position_m + SHIELD_DIAMETER_M / (2.0 * np.tan(0.5 * angle_rad)) * ray,
            velocity_m_s=first.velocity_m_s + drift,
            normal=Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * axis).apply([0.0, 0.0, -1.0]),
            spin_rad_s=SHIELD_TUMBLE_RAD_S * axis,
            start_s=first.time_s,
        )

    def paint_over(self, frame: Frame, sun: Sun, time_s: float) -> Frame:
        """Return an image, and its ground truth, with the shield in front of the ground.

        The shield is a Lambert surface, lit by the sun only. Its number among the bodies is `SHIELD_BODY`.
        """
        elapsed_s = time_s - self.start_s
        centre = self.centre_m + elapsed_s * self.velocity_m_s
        normal = Rotation.from_rotvec(elapsed_s * self.spin_rad_s).apply(self.normal)
        origin = frame.world_from_body.apply(frame.rays.centre)
        directions = frame.world_from_body.rotation.apply(frame.rays.directions.astype(np.float64))
        cosines = directions @ normal
        distance = ((centre - origin) @ normal) / np.where(np.abs(cosines) > _MIN_COSINE, cosines, _MIN_COSINE)
        centre_distance = np.linalg.norm(origin + distance[:, None] * directions - centre, axis=1)
        is_hit = (distance > 0.0) & (centre_distance < 0.5 * SHIELD_DIAMETER_M) & (distance < frame.range_m.ravel())
        is_hit, distance, cosines = (values.reshape(frame.range_m.shape) for values in (is_hit, distance, cosines))
        # the camera sees the outside if the normal points towards it, otherwise the inside
        side = -np.sign(cosines)
        sun_cosine = np.maximum(side * float(normal @ sun.direction), 0.0)
        reflected = np.where(side > 0.0, SHIELD_OUTSIDE_ALBEDO, SHIELD_INSIDE_ALBEDO) * sun_cosine
        return replace(
            frame,
            radiance=np.where(is_hit, reflected, frame.radiance).astype(np.float32),
            range_m=np.where(is_hit, distance, frame.range_m),
            body=np.where(is_hit, SHIELD_BODY, frame.body),
            normal=np.where(is_hit[..., None], side[..., None] * normal, frame.normal).astype(np.float32),
        )
