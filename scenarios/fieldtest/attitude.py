"""Estimate the attitude at the images of a flight from surveyed targets and gyros (paper, III.D.2).

Gyros measure the rotation relative to inertial space, which includes the Earth's rotation of 15 deg/h
(`marsyard.scenarios.fieldtest.gyros`). Directions are therefore compared in an inertial frame that coincides with the
surface-fixed world axes at time 0. The Earth's rotation rate maps the directions from survey and GPS into this frame,
and the estimated attitudes back.

The helicopter passes over the targets at the start and at the end of the flight. The gyros map the target directions of
all images of a pass to one instant. The directions in the images, and those from survey and GPS, determine the attitude
at this instant: Wahba's problem. The paper solves it by QUEST. Here SciPy's `align_vectors` (singular value
decomposition) has the same result. A constant gyro bias is fitted so that both passes agree. The gyros, corrected for
this bias, propagate the attitude to the images between the passes.

The effects of a horizontal gyro bias on the outbound and the return legs cancel if the camera turns with the flight
direction: the passes hardly observe this bias. A prior with the standard deviation of the IMU's class therefore limits
the fitted bias.

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.gyros import EarthRotation
from marsyard.scenarios.fieldtest.targets import Sightings
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.inertial import InertialSolution

#: Gauss-Newton iterations of attitude and bias.
_ITERATIONS = 3


def solve_attitude(
    increments: ImuIncrements,
    first: Sightings,
    second: Sightings,
    sighting_sd_rad: float,
    bias_sd_rad_s: float,
    earth: EarthRotation,
) -> InertialSolution:
    """Estimate the attitude during a flight from its gyros and both passes over the targets.

    - increments: gyro increments of the whole flight
    - first, second: sightings of the two passes
    - sighting_sd_rad: standard deviation of a measured direction
    - bias_sd_rad_s: standard deviation of the gyro bias for the IMU's class
    - earth: rotation that maps the attitudes from inertial axes to world axes
    """
    times = np.concatenate([first.times_s, second.times_s])
    body_directions = np.concatenate([first.body_directions, second.body_directions])
    world_directions = np.concatenate([first.world_directions, second.world_directions])
    inertial_directions = earth.to_inertial(times).apply(world_directions)
    bias = np.zeros(3)
    # attitude at the start of the flight
    measured_directions = _propagate(increments, bias).attitude(first.times_s).apply(first.body_directions)
    start, _ = Rotation.align_vectors(inertial_directions[: len(measured_directions)], measured_directions)
    for _ in range(_ITERATIONS):
        propagated = _propagate(increments, bias)
        predicted = (start * propagated.attitude(times)).apply(body_directions)
        # cross-product matrices of the predicted directions v: M w = v x w
        (x, y, z), zero = predicted.T, np.zeros(len(predicted))
        cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), 2, 0)
        # integral of the attitude matrix up to each time: rotation in the starting axes per unit of bias in body axes
        integral = np.cumsum(propagated.attitudes[:-1].as_matrix() * increments.period_s, axis=0)
        indices = np.clip(np.searchsorted(increments.times_s, times) - 1, 0, len(integral) - 1)
        bias_jacobian = np.einsum("nij,jk,nkl->nil", cross, start.as_matrix(), -integral[indices])
        rows = np.concatenate([-cross, -bias_jacobian], axis=2).reshape(-1, 6) / sighting_sd_rad
        prior = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1) / bias_sd_rad_s
        residuals = np.concatenate([(inertial_directions - predicted).ravel() / sighting_sd_rad, -bias / bias_sd_rad_s])
        change = np.linalg.lstsq(np.concatenate([rows, prior]), residuals, rcond=None)[0]
        start = Rotation.from_rotvec(change[:3]) * start
        bias = bias + change[3:]
    propagated = _propagate(increments, bias)
    to_world = earth.to_inertial(increments.times_s).inv()
    return replace(propagated, attitudes=to_world * start * propagated.attitudes)


def _propagate(increments: ImuIncrements, bias_rad_s: Float64[np.ndarray, "3"]) -> InertialSolution:
    """Propagate the attitude, relative to its initial value, with the gyro increments corrected for a bias."""
    corrected = replace(increments, delta_angles_rad=increments.delta_angles_rad - bias_rad_s * increments.period_s)
    return InertialSolution.propagate(corrected, Rotation.identity(), np.zeros(3), 0.0)
