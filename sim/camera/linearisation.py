"""The linear camera that stands in for a distorted one, as for rectified pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.cahv import Cahv

#: Border samples on each side of the frame.
_STEPS = 256
#: Samples of the frame's columns and rows whose directions are averaged.
_SAMPLES = 33


def linearised(camera: CameraModel, *, inside: bool) -> Cahv:
    """The linear camera of the same centre, size and handedness whose frame bounds, or fills, the distorted one's view.

    A is the mean direction of the frame's pixels, H' the old H' made perpendicular to it and V' perpendicular to both.
    The two focal lengths and the image centre then follow from the rays of the frame's outer edge: the new frame is the
    smallest that holds them all, or with `inside` the largest that none of them enters.

    Raises
    ------
    ValueError
        If part of the frame's edge is blind, or looks 90 degrees or more away from A and `inside` is not set, or
        nothing remains inside.
    """
    directions = camera.rays(camera.border(_STEPS))[1]
    if not np.all(np.isfinite(directions)):
        raise ValueError("part of the frame's edge sees nothing: crop the camera before it is made linear")
    axis = _mean_direction(camera)
    right = camera.right - (camera.right @ axis) * axis
    right /= np.linalg.norm(right)
    down = np.cross(axis, right) if camera.right_handed else np.cross(right, axis)

    depth = directions @ axis
    if not inside and np.any(depth <= 0):
        widest = np.degrees(np.arccos(np.min(depth)))
        raise ValueError(
            f"the frame reaches {widest:.1f} degrees from its axis, a linear camera less than 90: crop it or use inside"
        )
    columns = _span(directions @ right, depth, (3, 1), inside)
    rows = _span(directions @ down, depth, (0, 2), inside)
    hs, hc = _scale_and_centre(columns, camera.size[0])
    vs, vc = _scale_and_centre(rows, camera.size[1])
    return Cahv(camera.c, axis, hs * right + hc * axis, vs * down + vc * axis, camera.size)


def _mean_direction(camera: CameraModel) -> NDArray[np.float64]:
    columns, rows = (np.linspace(0, extent - 1, _SAMPLES) for extent in camera.size)
    directions = camera.rays(np.stack(np.meshgrid(columns, rows), axis=-1))[1]
    total = directions.reshape(-1, 3).sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def _span(
    offsets: NDArray[np.float64], depth: NDArray[np.float64], sides: tuple[int, int], inside: bool
) -> tuple[float, float]:
    """Tangents at the lower and upper edge; the border's sides are top, right, bottom, left."""
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.where(depth > 0, offsets / depth, np.copysign(np.inf, offsets))
    if not inside:
        return float(tangents.min()), float(tangents.max())
    # A side runs from one corner to the next, both included.
    around = np.append(tangents, tangents[0])
    low, high = (around[side * _STEPS : (side + 1) * _STEPS + 1] for side in sides)
    return float(low.max()), float(high.min())


def _scale_and_centre(span: tuple[float, float], pixels: int) -> tuple[float, float]:
    low, high = span
    if not low < high:
        raise ValueError("no part of the view is rectangular: the distortion is too strong to keep what is inside")
    scale = pixels / (high - low)
    return scale, -0.5 - scale * low
