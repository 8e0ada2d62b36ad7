"""Effect of a velocity estimate on the landing: steering of the rockets' burn, and touchdown velocity.

A simple model of MER's last seconds. Near 100 m solid rockets in the backshell stop the fall; small rockets next to
them (TIRS) can tilt the backshell first, so that the burn has a horizontal component. The lander keeps its horizontal
velocity at the rockets' firing, and the burn adds an error. If an estimate is available in time and large enough, the
burn is steered against the velocity that the inertial unit has propagated from it, up to the limit of the tilt. Without
an estimate the burn is not steered. Swinging and wind during the burn's three seconds are not modelled.

Steering depends on an assumed computation time, so that rows are reproducible bit for bit. `is_in_time` uses the
algorithm's measured time instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.descent.parameters import LandingParameters

Horizontal = Float64[np.ndarray, "2"]


@dataclass(frozen=True)
class Touchdown:
    """Horizontal touchdown velocities of the same descent with and without the estimate, m/s.

    - punctual: the estimate is available at the rockets' firing by the assumed computation time
    """

    with_answer: Horizontal
    without_answer: Horizontal
    punctual: bool


def is_in_time(p: LandingParameters, measured_s: float, available_s: float) -> bool:
    """Whether an estimate is available at the rockets' firing, by its measured time scaled to the flight computer."""
    return p.processor_factor * measured_s <= available_s


def touchdown(
    p: LandingParameters,
    true_m_s: Horizontal,
    believed_m_s: Horizontal | None,
    available_s: float,
    rng: np.random.Generator,
) -> Touchdown:
    """Compute touchdown velocities; `rng` draws the errors of burn and steering.

    - true_m_s: horizontal velocity of the lander at the rockets' firing
    - believed_m_s: the estimate, propagated to that time by the inertial unit; None without an estimate
    - available_s: time from the last picture to the firing
    """
    burn, steering = p.burn_error_m_s * rng.standard_normal(2), p.steering_error * rng.standard_normal(2)
    unsteered = true_m_s + burn
    punctual = p.computation_s <= available_s
    speed = 0.0 if believed_m_s is None else float(np.hypot(*believed_m_s))
    if believed_m_s is None or not punctual or speed <= p.least_steered_m_s:
        return Touchdown(unsteered, unsteered, punctual)
    removed = believed_m_s * min(1.0, p.most_steered_m_s / speed)
    return Touchdown(unsteered - removed + steering * np.hypot(*removed), unsteered, punctual)
