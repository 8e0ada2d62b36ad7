"""From the answer to the ground: what the velocity that was reported does to the landing.

A simple model of MER's last seconds. Near 100 m solid rockets in the backshell stop the fall; small rockets beside
them (TIRS) can tilt the backshell first, so that the burn also pushes sideways. The lander keeps the horizontal
velocity that it has when the rockets fire, to which the burn adds an error of its own. If a velocity was reported, in
time, and is worth it, the burn is steered to take out what the inertial unit has made of it by then: all of it, or as
much as the tilt allows. Without an answer the burn is not steered. Swinging and wind during the burn's three seconds
are left out.

Whether an answer is used follows from an assumed time of computation, so that rows repeat bit for bit. Whether the time
that the algorithm really took would have done is `is_in_time`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.descent.parameters import LandingParameters

Horizontal = Float64[np.ndarray, "2"]


@dataclass(frozen=True)
class Touchdown:
    """Horizontal velocities at the ground of the same descent, m/s.

    Attributes
    ----------
    with_answer, without_answer
        With the velocity used that was reported, and with none.
    punctual
        Whether the answer would be there when the rockets fire, by the assumed time of computation.
    """

    with_answer: Horizontal
    without_answer: Horizontal
    punctual: bool


def is_in_time(p: LandingParameters, measured_s: float, available_s: float) -> bool:
    """Whether an answer is there when the rockets fire, by its measured time on this host and the flight computer's."""
    return p.processor_factor * measured_s <= available_s


def touchdown(
    p: LandingParameters,
    true_m_s: Horizontal,
    believed_m_s: Horizontal | None,
    available_s: float,
    rng: np.random.Generator,
) -> Touchdown:
    """Velocities at the ground.

    Parameters
    ----------
    p
        Computer, steering and burn.
    true_m_s
        Horizontal velocity of the lander when the rockets fire.
    believed_m_s
        The velocity reported, carried on to then by the inertial unit; None where none was reported.
    available_s
        Time from the last picture until then.
    rng
        Draws the errors of burn and steering.
    """
    burn, steering = p.burn_error_m_s * rng.standard_normal(2), p.steering_error * rng.standard_normal(2)
    drifting = true_m_s + burn
    punctual = p.computation_s <= available_s
    if believed_m_s is None or not punctual:
        return Touchdown(drifting, drifting, punctual)
    speed = float(np.hypot(*believed_m_s))
    if speed <= p.least_steered_m_s:
        return Touchdown(drifting, drifting, punctual)
    taken_out = believed_m_s * min(1.0, p.most_steered_m_s / speed)
    return Touchdown(drifting - taken_out + steering * np.hypot(*taken_out), drifting, punctual)
