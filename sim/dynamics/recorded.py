"""Recorded motion: a trajectory that interpolates recorded poses of a body by splines."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from marsyard.sim.dynamics.trajectory import Motion, Trajectory, check_times

#: Minimum number of poses of a cubic spline.
MIN_POSES = 4
#: Maximum rotation from one pose to the next; for larger rotations the interpolation is ambiguous.
MAX_ROTATION_DEG = 90.0
#: Tolerance on times outside the span, for rounding errors in sums of times.
ROUNDING_S = 1e-9


@dataclass(frozen=True, eq=False)
class RecordedMotion(Trajectory):
    """A `Trajectory` through recorded poses of a body, world axes.

    Positions are interpolated by a cubic spline (not-a-knot), attitudes by a spline of continuous angular acceleration.
    Velocity, body rate and specific force are derivatives of these splines.

    - times_s, positions_m, attitudes: the recorded poses; attitudes rotate from body to world
    - gravity_m_s2: gravity, along the world's -z

    Raises ValueError for fewer than `MIN_POSES` poses, times that do not increase, a value that is not finite, or a
    rotation of more than `MAX_ROTATION_DEG` from one pose to the next.
    """

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    attitudes: Rotation
    gravity_m_s2: float

    def __post_init__(self) -> None:
        if self.times_s.size < MIN_POSES:
            raise ValueError(f"has {self.times_s.size} poses; allowed: at least {MIN_POSES}")
        if not (np.all(np.isfinite(self.times_s)) and np.all(np.isfinite(self.positions_m))):
            raise ValueError("contains a value that is not finite")
        not_increasing = np.flatnonzero(np.diff(self.times_s) <= 0.0)
        if not_increasing.size:
            raise ValueError(
                f"time does not increase after {self.times_s[not_increasing[0]]:.6f} s (pose {not_increasing[0] + 1})"
            )
        angles = np.degrees((self.attitudes[:-1].inv() * self.attitudes[1:]).magnitude())
        too_large = np.flatnonzero(angles > MAX_ROTATION_DEG)
        if too_large.size:
            index = too_large[0]
            raise ValueError(
                f"rotates by {angles[index]:.0f} deg after {self.times_s[index]:.6f} s (pose {index + 1}); "
                f"allowed: up to {MAX_ROTATION_DEG:g} deg from one pose to the next"
            )

    @cached_property
    def _position_spline(self) -> CubicSpline:
        return CubicSpline(self.times_s, self.positions_m)

    @cached_property
    def _attitude_spline(self) -> RotationSpline:
        return RotationSpline(self.times_s, self.attitudes)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last recorded time."""
        return float(self.times_s[0]), float(self.times_s[-1])

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""
        check_times(times_s, self.span_s, ROUNDING_S)
        derivatives = [self._position_spline(times_s, order) for order in range(3)]
        attitudes, rates = self._attitude_spline(times_s), self._attitude_spline(times_s, 1)
        return Motion.from_accelerations(times_s, derivatives, attitudes, rates, self.gravity_m_s2)
