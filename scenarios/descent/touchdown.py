"""Touchdown of a descent, whose burn is steered with the estimated velocity."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes import propagate_velocity
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.descent.measurements import DescentInstruments
from marsyard.scenarios.descent.parameters import TouchdownParameters
from marsyard.scenarios.velocity_score import Horizontal


@dataclass(frozen=True)
class TouchdownVelocities:
    """Horizontal touchdown velocities of a descent, steered with the estimate and without it, m/s.

    - is_in_time: with the assumed computation time, the estimate is available before the rockets fire
    """

    with_answer: Horizontal
    without_answer: Horizontal
    is_in_time: bool


def compute_touchdown(
    p: TouchdownParameters,
    true_m_s: Horizontal,
    estimated_m_s: Horizontal | None,
    available_s: float,
    rng: np.random.Generator,
) -> TouchdownVelocities:
    """Compute touchdown velocities with a simple model of MER's last seconds; `rng` draws errors of burn and steering.

    Solid rockets in the backshell stop the fall near 100 m; small rockets next to them (TIRS) can tilt the backshell
    first to give the burn a horizontal component. The touchdown velocity is the horizontal velocity at the rockets'
    firing plus an error of the burn. If an estimate is available in time and exceeds the deadband, the burn is steered
    against the estimate, up to the tilt limit. Otherwise the burn is not steered. Swinging and wind during the burn of
    three seconds are not modelled. The computation time is an assumed constant, so that rows are reproducible bit for
    bit.

    - true_m_s: horizontal velocity of the lander at the rockets' firing
    - estimated_m_s: the estimate, propagated to that time by the inertial unit; None without an estimate
    - available_s: time from the last image to the firing
    """
    burn, steering = p.burn_error_m_s * rng.standard_normal(2), p.steering_error * rng.standard_normal(2)
    unsteered = true_m_s + burn
    is_in_time = p.computation_s <= available_s
    speed = 0.0 if estimated_m_s is None else float(np.hypot(*estimated_m_s))
    if estimated_m_s is None or not is_in_time or speed <= p.steering_deadband_m_s:
        return TouchdownVelocities(unsteered, unsteered, is_in_time)
    correction = estimated_m_s * min(1.0, p.max_steering_m_s / speed)
    return TouchdownVelocities(unsteered - correction + steering * np.hypot(*correction), unsteered, is_in_time)


def propagate_to_firing(
    estimate: VelocityEstimate | None, instruments: DescentInstruments, firing_s: float, gravity_m_s2: float
) -> Horizontal | None:
    """Propagate the estimate to the thrusters' firing with the inertial unit; None without an estimate.

    The attitude error that the estimate reports corrects the inertial velocity change: navigation rotates the specific
    force with its attitude, and adds gravity along the true vertical.
    """
    if estimate is None or estimate.velocity_m_s is None or estimate.span_s is None:
        return None
    navigation, span = instruments.navigation, np.array(estimate.span_s)
    is_instant = estimate.span_s[0] == estimate.span_s[1]
    start = (navigation.velocity(span) if is_instant else navigation.mean_velocities(span))[0]
    end = navigation.velocity(np.array([firing_s]))[0]
    if estimate.attitude_error_rad is not None:
        by_gravity = np.array([0.0, 0.0, -gravity_m_s2 * (firing_s - span.mean())])
        by_force = end - start - by_gravity
        end = start + by_gravity + Rotation.from_rotvec(-estimate.attitude_error_rad).apply(by_force)
    return propagate_velocity(estimate.velocity_m_s, start[:2], end[:2])
