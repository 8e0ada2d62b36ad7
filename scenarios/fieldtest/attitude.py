"""Attitude of the pictures from surveyed targets at both ends of a flight and the gyros in between (paper, III.D.2).

The directions of the targets in all pictures of a pass over them, mapped to one instant by the gyros, and their
directions by GPS determine the attitude at that instant: Wahba's problem, which the paper solves by QUEST and SciPy's
`align_vectors` by a singular value decomposition, with the same result. A constant gyro bias is fitted so that both
passes agree; gyros without that bias propagate the attitude to the pictures in between.

Where the camera turns with the flight, the passes hardly observe the horizontal bias: its effects on the way out and
back cancel. A prior of the unit's class therefore bounds the fitted bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.parameters import DriftParameters, TargetParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.dynamics.helicopter import HelicopterFlight
from marsyard.sim.sensor.imu import DEG_H, ImuIncrements
from marsyard.sim.sensor.inertial import InertialSolution
from marsyard.sim.terrain import Surface

_ITERATIONS = 3
#: Minimum distance of a measured target from the edge of the picture, pixels.
_BORDER_PX = 4.0


@dataclass(frozen=True)
class Targets:
    """True and surveyed positions of the targets, world axes, metres."""

    true_m: Float64[np.ndarray, "targets 3"]
    surveyed_m: Float64[np.ndarray, "targets 3"]

    @classmethod
    def draw(
        cls, p: TargetParameters, surface: Surface, middle_m: Float64[np.ndarray, "2"], rng: np.random.Generator
    ) -> Targets:
        """Draw targets on the ground around a position; the first ones of those placed are used."""
        points = middle_m + rng.uniform(-p.within_m, p.within_m, (p.placed, 2))[: p.used]
        true = np.column_stack([points, surface.height(points[:, 0], points[:, 1])])
        return cls(true, true + p.survey_m * rng.standard_normal(true.shape))


@dataclass(frozen=True)
class Sightings:
    """Targets seen in the pictures of a pass: one row per target and picture.

    - times_s: time tag of the picture
    - camera: unit vector to the target in body axes, from its centroid in the picture
    - world: unit vector to the target in world axes, from the survey and the helicopter's GPS position
    """

    times_s: Float64[np.ndarray, "n"]
    camera: Float64[np.ndarray, "n 3"]
    world: Float64[np.ndarray, "n 3"]


def sight_targets(
    targets: Targets,
    camera: CameraModel,
    motion: Motion,
    tags_s: Float64[np.ndarray, "pictures"],
    gps_m: Float64[np.ndarray, "pictures 3"],
    centroid_px: float,
    rng: np.random.Generator,
) -> Sightings:
    """Project the targets into the pictures of a pass, which are not rendered, and add the error of the centroids.

    - camera: the camera in the body frame, at its origin
    - motion: truth at the exposures
    - tags_s, gps_m: time tags of the pictures and measured positions of the camera
    - centroid_px: standard deviation of a centroid per axis
    """
    columns, rows = camera.size
    times, directions, expected = [], [], []
    for number, (attitude, position) in enumerate(zip(motion.attitudes, motion.positions_m, strict=True)):
        pixels, visible = camera.project(attitude.inv().apply(targets.true_m - position))
        centroids = pixels + centroid_px * rng.standard_normal(pixels.shape)
        inside = (centroids >= _BORDER_PX) & (centroids <= np.array([columns, rows]) - 1.0 - _BORDER_PX)
        measured = visible & inside.all(axis=1)
        directions.append(camera.rays(centroids[measured])[1])
        expected.append(_unit(targets.surveyed_m[measured] - gps_m[number]))
        times.append(np.full(int(measured.sum()), tags_s[number]))
    return Sightings(np.concatenate(times), _unit(np.concatenate(directions)), np.concatenate(expected))


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def add_thermal_drift(
    increments: ImuIncrements, p: DriftParameters, flight: HelicopterFlight, start_s: float
) -> ImuIncrements:
    """Add the gyro bias that follows the unit's temperature; `start_s` is the true time of the first boundary.

    The temperature follows the air with a lag of first order: cooler from the end of the first pass over the targets to
    the end of the last pass along the line.
    """
    times = start_s + increments.period_s * (np.arange(len(increments.delta_angles_rad)) + 0.5)
    begin, end = (
        -np.expm1(-np.maximum(times - change_s, 0.0) / p.time_constant_s)
        for change_s in (flight.fly_overs_s[0][1], flight.passes[-1].end_s)
    )
    rates = DEG_H * p.across_deg_h_k * (p.change_k * (begin - end))
    drifted = increments.delta_angles_rad + np.outer(rates * increments.period_s, np.array([1.0, 0.0, 0.0]))
    return replace(increments, delta_angles_rad=drifted)


def solve_attitude(
    increments: ImuIncrements, first: Sightings, second: Sightings, sighting_sd_rad: float, bias_sd_rad_s: float
) -> InertialSolution:
    """Estimate the attitude over a flight from its gyros and both passes over the targets.

    - increments: gyro increments over the whole flight
    - first, second: sightings of the two passes
    - sighting_sd_rad: standard deviation of a direction
    - bias_sd_rad_s: standard deviation of the gyro bias of the unit's class
    """
    times = np.concatenate([first.times_s, second.times_s])
    camera, world = np.concatenate([first.camera, second.camera]), np.concatenate([first.world, second.world])
    bias = np.zeros(3)
    # attitude at the start of the flight
    start, _ = Rotation.align_vectors(
        first.world, _propagate(increments, bias).attitude(first.times_s).apply(first.camera)
    )
    for _ in range(_ITERATIONS):
        propagated = _propagate(increments, bias)
        predicted = (start * propagated.attitude(times)).apply(camera)
        # matrices M with M w = v x w
        (x, y, z), zero = predicted.T, np.zeros(len(predicted))
        cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), 2, 0)
        # integral of the attitude's matrix up to each time: rotation of the start's axes per unit of bias in body axes
        integral = np.cumsum(propagated.attitudes[:-1].as_matrix() * increments.period_s, axis=0)
        before = np.clip(np.searchsorted(increments.times_s, times) - 1, 0, len(integral) - 1)
        by_bias = np.einsum("nij,jk,nkl->nil", cross, start.as_matrix(), -integral[before])
        rows = np.concatenate([-cross, -by_bias], axis=2).reshape(-1, 6) / sighting_sd_rad
        prior = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1) / bias_sd_rad_s
        residuals = np.concatenate([(world - predicted).ravel() / sighting_sd_rad, -bias / bias_sd_rad_s])
        change = np.linalg.lstsq(np.concatenate([rows, prior]), residuals, rcond=None)[0]
        start = Rotation.from_rotvec(change[:3]) * start
        bias = bias + change[3:]
    propagated = _propagate(increments, bias)
    return replace(propagated, attitudes=start * propagated.attitudes)


def _propagate(increments: ImuIncrements, bias_rad_s: Float64[np.ndarray, "3"]) -> InertialSolution:
    """Propagate the attitude relative to the first by the gyros without a bias."""
    corrected = replace(increments, delta_angles_rad=increments.delta_angles_rad - bias_rad_s * increments.period_s)
    return InertialSolution.propagate(corrected, Rotation.identity(), np.zeros(3), 0.0)
