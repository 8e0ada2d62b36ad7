"""Closed-form motions for the tests of instruments: a swaying body, and uniform motion of an image."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics import Motion, State
from marsyard.sim.sensor import ImageMotion

#: Gravity of Mars, m/s2.
GRAVITY = 3.71


def uniform_motion(rows_s: float, columns_s: float) -> ImageMotion:
    """Return an image motion with equal velocities of all pixels, pixels per second (row, column)."""
    return ImageMotion(np.tile(np.array([rows_s, columns_s]), (2, 2, 1)))


@dataclass(frozen=True)
class Swaying:
    """Motion of a body that spins about the vertical, nods about its x axis, falls on a parabola and sways east.

    - spin_rad_s: rate of the rotation about the vertical
    - nod_rad, nod_rad_s: amplitude and angular frequency of the rotation about the body's x axis
    - position_m, velocity_m_s, acceleration_m_s2: parabola; initial position and velocity, constant acceleration
    - sway_m, sway_rad_s: amplitude and angular frequency of the motion to the east
    - tilt: attitude at time 0
    """

    spin_rad_s: float = 0.0
    nod_rad: float = 0.0
    nod_rad_s: float = 1.0
    position_m: tuple[float, float, float] = (0.0, 0.0, 2000.0)
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    acceleration_m_s2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sway_m: float = 0.0
    sway_rad_s: float = 1.0
    tilt: Rotation = field(default_factory=Rotation.identity)

    @property
    def span_s(self) -> tuple[float, float]:
        return -np.inf, np.inf

    def state(self, time_s: float) -> State:
        motion = self.motion(np.array([time_s]))
        return State(
            time_s,
            motion.positions_m[0],
            motion.velocities_m_s[0],
            motion.attitudes[0],
            motion.body_rates_rad_s[0],
            motion.specific_forces_m_s2[0],
        )

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        t = times_s[:, None]
        east, up, x_axis = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        nod = Rotation.from_rotvec(self.nod_rad * np.sin(self.nod_rad_s * t) * x_axis)
        attitudes = self.tilt * Rotation.from_rotvec(self.spin_rad_s * t * up) * nod
        rates = nod.inv().apply(np.broadcast_to(self.spin_rad_s * up, (times_s.size, 3)).copy())
        rates = rates + self.nod_rad * self.nod_rad_s * np.cos(self.nod_rad_s * t) * x_axis
        # Initial velocity v and constant acceleration a of the parabola; angular frequency k of the sway.
        v, a, k = np.array(self.velocity_m_s), np.array(self.acceleration_m_s2), self.sway_rad_s
        accelerations = a - self.sway_m * k**2 * np.sin(k * t) * east
        return Motion(
            times_s=times_s,
            positions_m=np.array(self.position_m) + v * t + 0.5 * a * t**2 + self.sway_m * np.sin(k * t) * east,
            velocities_m_s=v + a * t + self.sway_m * k * np.cos(k * t) * east,
            attitudes=attitudes,
            body_rates_rad_s=rates,
            specific_forces_m_s2=attitudes.inv().apply(accelerations + GRAVITY * up),
        )


def assert_derivatives(
    motion_at: Callable[[np.ndarray], Motion],
    times_s: np.ndarray,
    step_s: float,
    gravity_m_s2: float,
    *,
    force_rtol: float = 1e-7,
    **atol: float,
) -> None:
    """Compare velocities, specific forces and body rates with central differences; `atol` by the first word of each.

    The body axes rotate by up to half a step during a difference.
    """
    before, motion, after = (motion_at(times_s + shift) for shift in (-step_s, 0.0, step_s))
    velocity = (after.positions_m - before.positions_m) / (2.0 * step_s)
    np.testing.assert_allclose(motion.velocities_m_s, velocity, atol=atol["velocity"])
    acceleration = (after.velocities_m_s - before.velocities_m_s) / (2.0 * step_s)
    force = motion.attitudes.inv().apply(acceleration + np.array([0.0, 0.0, gravity_m_s2]))
    np.testing.assert_allclose(motion.specific_forces_m_s2, force, rtol=force_rtol, atol=atol["force"])
    rate = (before.attitudes.inv() * after.attitudes).as_rotvec() / (2.0 * step_s)
    np.testing.assert_allclose(motion.body_rates_rad_s, rate, atol=atol["rate"])
