"""Recorded motion: positions and attitudes at instants, interpolated by splines.

Positions have a cubic spline (not-a-knot), attitudes one of continuous angular acceleration
(`scipy.spatial.transform.RotationSpline`). Velocity, body rate and specific force are the splines' derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from marsyard.sim.dynamics.trajectory import Motion, Trajectory, check_times

#: Fewest poses that determine an acceleration.
MIN_POSES = 4
#: Largest rotation from one pose to the next: the interpolation between larger ones is ambiguous.
MAX_ROTATION_DEG = 90.0
#: Tolerated excess over the span: sums of times that end at its limit have rounding errors.
ROUNDING_S = 1e-9


@dataclass(frozen=True, eq=False)
class RecordedMotion(Trajectory):
    """A `Trajectory` through recorded poses of a body, world axes; times increase.

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
            raise ValueError("holds a value that is not finite")
        late = np.flatnonzero(np.diff(self.times_s) <= 0.0)
        if late.size:
            raise ValueError(f"time does not increase after {self.times_s[late[0]]:.6f} s (pose {late[0] + 1})")
        angles = np.degrees((self.attitudes[:-1].inv() * self.attitudes[1:]).magnitude())
        wide = np.flatnonzero(angles > MAX_ROTATION_DEG)
        if wide.size:
            raise ValueError(
                f"turns by {angles[wide[0]]:.0f} deg after {self.times_s[wide[0]]:.6f} s (pose {wide[0] + 1}); "
                f"allowed: up to {MAX_ROTATION_DEG:g} deg from one pose to the next"
            )

    @cached_property
    def _position(self) -> CubicSpline:
        return CubicSpline(self.times_s, self.positions_m)

    @cached_property
    def _attitude(self) -> RotationSpline:
        return RotationSpline(self.times_s, self.attitudes)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last recorded time."""
        return float(self.times_s[0]), float(self.times_s[-1])

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """True states at many times. Raises ValueError outside of the span."""
        check_times(times_s, self.span_s, ROUNDING_S)
        derivatives = [self._position(times_s, order) for order in range(3)]
        return Motion.from_accelerations(
            times_s, derivatives, self._attitude(times_s), self._attitude(times_s, 1), self.gravity_m_s2
        )
