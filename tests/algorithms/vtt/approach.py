"""Approaches to targets on faces and boulders, stop by stop, over exact pictures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import TargetUpdate
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.tracker import VttDetails
from marsyard.sim.measurements import RoverTarget
from tests.algorithms.vtt.synthetic_drive import Drive, Plane, Scene, Sphere, pose, waves

#: A smaller window than the paper's keeps the pictures that must be computed small.
SMALL = VttOptions(search_px=101)

Body = Callable[[int, np.ndarray], Plane | Sphere]


def slanted(seed: int, target: np.ndarray) -> Plane:
    """A face through the target, turned and tilted at random, towards a rover at the origin."""
    rng = np.random.default_rng(seed)
    normal = np.array([-1.0, rng.uniform(-0.5, 0.5), rng.uniform(0.0, 1.0)])
    return Plane(target, normal / np.linalg.norm(normal))


def boulder(seed: int, target: np.ndarray) -> Sphere:
    """A sphere of 0.3 to 0.6 m whose front holds the target."""
    rng = np.random.default_rng(seed)
    normal = np.array([-1.0, rng.uniform(-0.4, 0.4), rng.uniform(0.2, 0.8)])
    radius = rng.uniform(0.3, 0.6)
    return Sphere(target - radius * normal / np.linalg.norm(normal), radius)


def scene_of(body: Plane | Sphere, target: np.ndarray, seed: int) -> Scene:
    return Scene((body,), waves(seed, count=100), target)


def details(update: TargetUpdate | None) -> VttDetails:
    assert update is not None
    assert isinstance(update.details, VttDetails)
    return update.details


def pixel_of(update: TargetUpdate) -> np.ndarray:
    match = details(update).match
    assert match is not None
    return match.pixel


def approach(
    drive: Drive, target: np.ndarray, share: float, goal_m: float = 2.0, slip: float = 0.0
) -> list[tuple[RigidTransform, TargetUpdate]]:
    """Stops on the way to the target, each step a share of its distance, until it is near or lost."""
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    stops, x, believed = [], 0.0, 0.0
    while True:
        update = drive.stop(pose(x, 0.0), pose(believed, 0.0))
        assert update is not None
        stops.append((pose(x, 0.0), update))
        distance = details(update).distance_m
        if not update.found or distance < goal_m + 0.02:
            return stops
        step = min(share * distance, 1.3 * (distance - goal_m))
        believed += step
        x += step * (1.0 - slip)
