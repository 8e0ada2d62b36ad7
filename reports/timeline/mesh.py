"""Triangles and outlines for three-dimensional views of a timeline."""

import numpy as np
from jaxtyping import Float64, Int32, UInt8
from scipy.spatial.transform import Rotation

from marsyard.scenarios.timeline import SurfacePatch, TimedImage, Timeline

#: Colours of the truth and of other paths, points and marks, RGB.
TRUE_COLOUR, OTHER_COLOUR = (28, 154, 118), (207, 106, 20)
_TRUE_NAMES = ("true", "target", "touchdown", "valid templates")
#: Length of a camera's outline divided by the width of the ground.
_OUTLINE_RATIO = 0.08


def colour(name: str) -> tuple[int, int, int]:
    """Return the colour of a path, points or marks: one for the truth, one for all others."""
    return TRUE_COLOUR if name in _TRUE_NAMES else OTHER_COLOUR


def triangulate(patch: SurfacePatch) -> Int32[np.ndarray, "triangles 3"]:
    """Split the cells of a patch into triangles; triangles with a missing corner are omitted."""
    rows, columns = patch.points_m.shape[:2]
    numbers = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    corners = [numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, 1:], numbers[1:, :-1]]
    upper_left, upper_right, lower_right, lower_left = (corner.ravel() for corner in corners)
    triangles = np.concatenate(
        [
            np.column_stack([upper_left, lower_left, lower_right]),
            np.column_stack([upper_left, lower_right, upper_right]),
        ]
    )
    is_finite = np.isfinite(patch.points_m.reshape(-1, 3)).all(axis=1)
    return np.ascontiguousarray(triangles[is_finite[triangles].all(axis=1)])


def vertex_colours(patch: SurfacePatch) -> UInt8[np.ndarray, "vertices 3"]:
    """Return the colours of a patch's points as RGB."""
    colours = patch.colours if patch.colours.ndim == 3 else np.repeat(patch.colours[..., None], 3, axis=2)
    return np.ascontiguousarray(colours.reshape(-1, 3))


def ground_width_m(timeline: Timeline) -> float:
    """Return the larger horizontal side of the ground."""
    points = timeline.surfaces["ground"].points_m.reshape(-1, 3)[:, :2]
    return float((np.nanmax(points, axis=0) - np.nanmin(points, axis=0)).max())


def camera_outlines(image: TimedImage, width_m: float) -> Float64[np.ndarray, "8 2 3"]:
    """Return the edges of a camera's field of view: from the camera to the corners, and between the corners."""
    pose = image.pose
    rays = _OUTLINE_RATIO * width_m * pose.corner_rays
    ends = pose.position_m + Rotation.from_quat(pose.quaternion_xyzw).apply(rays)
    starts = np.broadcast_to(pose.position_m, ends.shape)
    return np.concatenate([np.stack([starts, ends], axis=1), np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)])
