"""Frames, rotations and rigid transforms: the conventions every other module relies on.

Frames
------
world
    Local level, right-handed: x east, y north, z up, metres. Terrain heights are z.
body
    Fixed to the vehicle. With the identity attitude its axes coincide with the world's: x to the east ("forward"),
    y to the north ("left"), z up. A descent camera looks along -z.
site
    The rover operations' frame (x north, y east, z down). Used only when files are read or written.

Transforms are SciPy's `RigidTransform` and `Rotation`, named so that equations read from right to left:
``world_from_body.apply(points_body)`` gives ``points_world``. Arrays of quaternions carry their order in the name
(``quaternion_xyzw``, SciPy's order, or ``quaternion_wxyz``, the order of PDS labels).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

#: Site axes (north, east, down) from world axes (east, north, up); its own inverse.
SITE_FROM_WORLD = Rotation.from_matrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))


def rigid(rotation: Rotation, translation: Float[np.ndarray, "3"]) -> RigidTransform:
    """The transform ``x -> rotation x + translation``."""
    return rigid_from_axes(rotation.as_matrix(), translation)


def rigid_from_axes(axes: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> RigidTransform:
    """The transform ``x -> axes x + translation``; the axes must be a rotation to rounding, which is not checked."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, translation
    return RigidTransform(matrix, normalize=False, copy=False)  # a tenth of the time that checking would take


def composed(outer: RigidTransform, inner: RigidTransform) -> RigidTransform:
    """``outer * inner``, both single, in a fifth of its time: the product is not made a rotation beyond rounding."""
    return RigidTransform(outer.as_matrix() @ inner.as_matrix(), normalize=False, copy=False)


def turn_matrix(transform: RigidTransform) -> Float[np.ndarray, "3 3"]:
    """Matrix of a single transform's rotation, in a thirtieth of the time of ``transform.rotation.as_matrix()``.

    SciPy makes sure once more that the rotation is one.
    """
    return np.ascontiguousarray(transform.as_matrix()[:3, :3])


def direction(azimuth_rad: float, elevation_rad: float) -> Float[np.ndarray, "3"]:
    """Unit vector in the world frame; azimuth clockwise from north, elevation above the horizon, both in radians."""
    horizontal = np.cos(elevation_rad)
    return np.array(
        [horizontal * np.sin(azimuth_rad), horizontal * np.cos(azimuth_rad), np.sin(elevation_rad)],
        dtype=np.float64,
    )
