"""Propagation of an estimated velocity by the IMU, for example to the firing of the thrusters near 100 m (section I).

The section is that of Johnson et al., "Field Testing of the MER DIMES".
"""

import numpy as np

from marsyard.algorithms.arrays import Vector2


def propagate_velocity(
    velocity_m_s: Vector2, inertial_at_estimate_m_s: Vector2, inertial_at_end_m_s: Vector2
) -> Vector2:
    """Propagate a horizontal velocity, m/s.

    `inertial_at_estimate_m_s` is the mean inertial velocity over the interval of the estimate (second pair),
    `inertial_at_end_m_s` the inertial velocity at the end of the propagation. An error common to both has no effect.
    """
    return np.asarray(velocity_m_s + (inertial_at_end_m_s - inertial_at_estimate_m_s))
