"""Cones that contain the rays of an image, and the bodies and the ground that they contain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool as BoolArray
from jaxtyping import Float64 as FloatArray

#: Cone: apex in world axes, unit vector along the axis, and half angle in radians.
Cone = tuple[FloatArray[np.ndarray, "3"], FloatArray[np.ndarray, "3"], float]
#: Centre and radius of a bounding sphere of each body, metres.
Spheres = FloatArray[np.ndarray, "bodies 4"]
#: Number of directions along the rim of a cone whose convex hull bounds the ground in the cone, and the fraction by
#: which the hull is enlarged.
_RIM_DIRECTIONS, _MARGIN = 64, 0.01
#: Minimum downward component of all directions in a cone; above it the ground in the cone is treated as unbounded.
_MIN_DESCENT = 1e-6


class Bounds(NamedTuple):
    """Minimum and maximum x, then y, metres."""

    west: float
    east: float
    south: float
    north: float


def spheres_in_cone(
    spheres: Spheres, apex: FloatArray[np.ndarray, "3"], axis: FloatArray[np.ndarray, "3"], half_angle_rad: float
) -> BoolArray[np.ndarray, "bodies"]:
    """Select the spheres that intersect a cone."""
    offset, radius = spheres[:, :3] - apex, spheres[:, 3]
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    off_axis = np.arccos(np.clip(offset @ axis / distance, -1.0, 1.0))
    angular_radius = np.where(distance <= radius, np.pi, np.arcsin(np.clip(radius / distance, 0.0, 1.0)))
    return np.asarray(off_axis <= half_angle_rad + angular_radius)


def potentially_visible(
    spheres: Spheres, sun: FloatArray[np.ndarray, "3"], min_height_m: float, cone: Cone
) -> BoolArray[np.ndarray, "bodies"]:
    """Select the bodies that are visible in a cone, or that may cast a visible shadow.

    The shadow of a body is inside a cylinder with the body's radius, from its centre away from the sun to the lowest
    ground. A sphere that contains the body and this cylinder is tested against the cone. There are no shadows if the
    sun is not above the horizon.
    """
    tops = np.maximum(spheres[:, 2] + spheres[:, 3] - min_height_m, 0.0)
    half_lengths = 0.5 * tops / sun[2] if sun[2] > 0.0 else np.zeros(len(spheres))
    enclosing = np.column_stack([spheres[:, :3] - half_lengths[:, None] * sun, spheres[:, 3] + half_lengths])
    return spheres_in_cone(enclosing, *cone)


def ground_in_cones(cones: Sequence[Cone], min_height_m: float) -> Bounds | None:
    """Return the x and y bounds of all points in the cones at or above `min_height_m`; None if they are unbounded."""
    azimuths = np.linspace(0.0, 2.0 * np.pi, _RIM_DIRECTIONS, endpoint=False)
    points = []
    for apex, axis, half_angle_rad in cones:
        first_axis = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        first_axis /= np.linalg.norm(first_axis)
        second_axis = np.cross(axis, first_axis)
        perpendicular = np.cos(azimuths)[:, None] * first_axis + np.sin(azimuths)[:, None] * second_axis
        rim = np.cos(half_angle_rad) * axis + np.sin(half_angle_rad) * perpendicular
        if half_angle_rad >= 0.5 * np.pi or np.any(rim[:, 2] >= -_MIN_DESCENT):
            return None
        ends = apex + ((min_height_m - apex[2]) / rim[:, 2])[:, None] * rim
        points.append(np.vstack([apex, ends])[:, :2])
    hull = np.concatenate(points)
    low, high = hull.min(axis=0), hull.max(axis=0)
    margin = _MARGIN * (high - low)
    (west, south), (east, north) = low - margin, high + margin
    return Bounds(float(west), float(east), float(south), float(north))
