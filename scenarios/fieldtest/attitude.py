"""Attitude of the pictures: from the targets at both ends of a flight, and the gyros in between (paper, III.D.2).

The targets' directions in all pictures of a pass over them, mapped to one instant by the gyros, against their
directions by GPS give the attitude at that instant: Wahba's problem, which the paper solves by QUEST and SciPy's
`align_vectors` by a singular value decomposition, to the same answer. A constant gyro bias is fitted so that both
passes agree. The pictures in between get the attitude that the gyros, less that bias, carry to them.

Where the camera turns about with the flight, both passes say little of the bias across the vertical: what it adds on
the way out it takes off on the way back. The fit therefore also holds the bias to what the unit's class allows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.sensor.imu import ImuIncrements
from marsyard.sim.sensor.inertial import InertialSolution

_ITERATIONS = 3


@dataclass(frozen=True)
class Sightings:
    """Targets seen in the pictures of one pass over them; one row for each target in each picture.

    Attributes
    ----------
    times_s
        Time tag of the picture.
    camera
        Unit vector to the target in body axes, from its centroid in the picture.
    world
        Unit vector to the target in world axes, from the surveyed target and the helicopter's GPS position.
    """

    times_s: Float64[np.ndarray, "n"]
    camera: Float64[np.ndarray, "n 3"]
    world: Float64[np.ndarray, "n 3"]

    def joined(self, other: Sightings) -> Sightings:
        """Both."""
        return Sightings(
            np.concatenate([self.times_s, other.times_s]),
            np.concatenate([self.camera, other.camera]),
            np.concatenate([self.world, other.world]),
        )


@dataclass(frozen=True)
class AttitudeSolution:
    """What the processing of a flight gives.

    Attributes
    ----------
    inertial
        Attitudes over the flight.
    bias_rad_s
        The constant gyro bias taken off.
    residual_rad
        RMS angle between seen and predicted directions of the targets.
    """

    inertial: InertialSolution
    bias_rad_s: Float64[np.ndarray, "3"]
    residual_rad: float

    def attitudes(self, times_s: Float64[np.ndarray, "n"]) -> Rotation:
        """Attitudes at time tags."""
        return self.inertial.attitude(times_s)


def solve_attitude(
    increments: ImuIncrements, first: Sightings, second: Sightings, sighting_sd_rad: float, bias_sd_rad_s: float
) -> AttitudeSolution:
    """Attitude over a flight from its gyros and its two passes over the targets.

    Parameters
    ----------
    increments
        Of the unit, over the whole flight.
    first, second
        What was seen of the targets.
    sighting_sd_rad
        Error of a direction.
    bias_sd_rad_s
        Gyro bias that the unit's class allows, one standard deviation.
    """
    both = first.joined(second)
    bias = np.zeros(3)
    start = quest(first, _turned(increments, bias))
    for _ in range(_ITERATIONS):
        carried = _turned(increments, bias)
        predicted = (start * carried.attitude(both.times_s)).apply(both.camera)
        cross = _cross_matrices(predicted)
        # bias that is left turns the axes at the start by less and less the later it acts
        lever = -_bias_integral(carried, both.times_s)
        by_bias = np.einsum("nij,jk,nkl->nil", cross, start.as_matrix(), lever)
        rows = np.concatenate([-cross, -by_bias], axis=2).reshape(-1, 6) / sighting_sd_rad
        prior = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1) / bias_sd_rad_s
        left = np.concatenate([(both.world - predicted).ravel() / sighting_sd_rad, -bias / bias_sd_rad_s])
        change = np.linalg.lstsq(np.concatenate([rows, prior]), left, rcond=None)[0]
        start = Rotation.from_rotvec(change[:3]) * start
        bias = bias + change[3:]
    carried = _turned(increments, bias)
    inertial = replace(carried, attitudes=start * carried.attitudes)
    missed = inertial.attitude(both.times_s).apply(both.camera) - both.world
    return AttitudeSolution(inertial, bias, float(np.sqrt(np.mean(np.sum(missed**2, axis=1)))))


def quest(sightings: Sightings, carried: InertialSolution) -> Rotation:
    """Attitude at the start of `carried`, whose attitudes are relative to that start."""
    at_start = carried.attitude(sightings.times_s).apply(sightings.camera)
    attitude, _ = Rotation.align_vectors(sightings.world, at_start)
    return attitude


def _turned(increments: ImuIncrements, bias_rad_s: Float64[np.ndarray, "3"]) -> InertialSolution:
    """Attitudes relative to the first, by the gyros less a bias."""
    corrected = replace(increments, delta_angles_rad=increments.delta_angles_rad - bias_rad_s * increments.period_s)
    return InertialSolution.propagate(corrected, Rotation.identity(), np.zeros(3), 0.0)


def _bias_integral(carried: InertialSolution, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3 3"]:
    """Integral of the attitude's matrix up to each time: how a bias in body axes has turned the axes at the start."""
    increments = carried.increments
    summed = np.cumsum(carried.attitudes[:-1].as_matrix() * increments.period_s, axis=0)
    before = np.clip(np.searchsorted(increments.times_s, times_s) - 1, 0, len(summed) - 1)
    integral: Float64[np.ndarray, "n 3 3"] = summed[before]
    return integral


def _cross_matrices(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """Matrices M with M w = v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), 2, 0)
