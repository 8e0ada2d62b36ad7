"""Visibility of a point of the rock along a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt import VttOptions
from marsyard.scenarios.rover import points
from marsyard.scenarios.rover.designation import is_on_edge
from marsyard.scenarios.rover.points import Vector
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.world import RunWorld


@dataclass(frozen=True)
class Visibility:
    """Visibility of a point of the rock along a run.

    Obliquity is the angle between the left camera's line of sight and the surface normal in the first template; it is 0
    face-on. The apparent width of a patch is proportional to the cosine of its obliquity: an increase by 10 deg reduces
    the width by a sixth near 45 deg and by a third near 65 deg. Scale and roll of a template do not compensate this.
    """

    in_view: bool  #: whether at every stop both cameras see the point, and it is not on an occluding edge
    obliquity_start_deg: float
    obliquity_max_deg: float


def evaluate_visibility(
    world: RunWorld, rig: Rig, point: Vector, heads: Sequence[RigidTransform], options: VttOptions
) -> Visibility:
    """Evaluate the visibility of a point on the rock from true poses of the mast's head, world axes."""
    half_rad, triangles = 0.5 * options.template_px * rig.pixel_rad, world.target_triangles
    cameras_m = [rig.camera_positions(head) for head in heads]
    normal = points.patch_normal(triangles, cameras_m[0][0], point, half_rad)
    to_cameras = np.array([left - point for left, _ in cameras_m])
    to_cameras /= np.linalg.norm(to_cameras, axis=1, keepdims=True)
    obliquity_deg = np.degrees(np.arccos(np.clip(to_cameras @ normal, -1.0, 1.0)))
    foot_m, spheres = float(world.rocks.position_m[world.target_number, 2]), points.enclosing_spheres(triangles)

    def is_clear(viewpoint: Vector) -> bool:
        nearby = triangles[points.spheres_near_line(spheres, viewpoint, point, half_rad)]
        is_occluded = points.find_self_occlusion(nearby, point[None], viewpoint)[0]
        return not is_occluded and not is_on_edge(nearby, foot_m, viewpoint, point, half_rad)

    in_view = all(is_clear(viewpoint) for pair in cameras_m for viewpoint in pair)
    return Visibility(in_view, float(obliquity_deg[0]), float(obliquity_deg.max()))
