"""The IMU check: does a pair of tracks change velocity as the inertial unit says (section II.B)?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

Horizontal = Float[np.ndarray, "2"]


@dataclass(frozen=True)
class Combination:
    """A track of the first pair with one of the second.

    Attributes
    ----------
    first, second
        Indices of the tracks within their pairs.
    discrepancy_m_s
        Length of (change of velocity between the tracks) - (change measured by the IMU), horizontal, m/s.
    """

    first: int
    second: int
    discrepancy_m_s: float


def combinations(
    first: Sequence[tuple[int, Horizontal]],
    second: Sequence[tuple[int, Horizontal]],
    interval_velocities_m_s: Float[np.ndarray, "2 3"],
) -> tuple[Combination, ...]:
    """All combinations of the valid tracks (index, velocity) of both pairs, best agreement first."""
    change = (interval_velocities_m_s[1] - interval_velocities_m_s[0])[:2]
    found = [
        Combination(i, j, float(np.hypot(*(v_second - v_first - change))))
        for (i, v_first), (j, v_second) in product(first, second)
    ]
    return tuple(sorted(found, key=lambda c: c.discrepancy_m_s))


def propagated(
    velocity_m_s: Horizontal, inertial_then_m_s: Horizontal, inertial_now_m_s: Horizontal
) -> Float[np.ndarray, "2"]:
    """A velocity carried on by the inertial unit, for example to thruster firing near 100 m (section I), m/s.

    `inertial_then_m_s` is the inertial velocity with the meaning of `velocity_m_s`: the mean over the second pair's
    interval. Both inertial velocities carry the same unknown error, which drops out.
    """
    return np.asarray(velocity_m_s + (inertial_now_m_s - inertial_then_m_s))
