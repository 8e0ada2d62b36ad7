"""Where things may shade what pictures show: what need not be looked for, or drawn."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import binary_dilation

from marsyard.sim.render.kernels.casters import Casters, list_casters
from marsyard.sim.render.kernels.structs import Footprint
from marsyard.sim.render.objects import Objects, spheres_in_cone
from marsyard.sim.render.photometry import Sun

#: A cone: where its tip is, the unit vector along its middle, and its half angle in radians.
Cone = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float]
#: Most cells along a side.
SIDE = 512
#: No place is spared the search.
EVERYWHERE = Footprint(np.ones((1, 1), dtype=np.bool_), 0.0, 0.0, 0.0)


def shadow_footprint(
    spheres: Float64[np.ndarray, "bodies 4"], sun: Float64[np.ndarray, "3"], lowest_m: float
) -> Footprint:
    """A grid of places, true where a body may hide the sun from ground that is nowhere lower than `lowest_m`.

    The shadow of a sphere falls along the sun's azimuth between the point below its middle and the place where the ray
    past its top has fallen to the lowest ground.

    Parameters
    ----------
    spheres
        Centre and radius of a sphere about each body, metres.
    sun
        Unit vector towards the sun, above the horizon.
    lowest_m
        Bound of the ground's height.
    """
    if len(spheres) == 0 or sun[2] <= 0.0:
        return EVERYWHERE
    starts = spheres[:, :2]
    falls = np.maximum(spheres[:, 2] + spheres[:, 3] - lowest_m, 0.0) / sun[2]
    ends = starts - falls[:, None] * sun[:2]
    low, high = np.minimum(starts, ends).min(axis=0), np.maximum(starts, ends).max(axis=0)
    # a body and half a step lie within a cell to each side
    cell = float(max((high - low).max() / SIDE, 2.0 * spheres[:, 3].max(), 1e-3))
    steps = int(np.ceil(2.0 * float(np.linalg.norm(ends - starts, axis=1).max()) / cell)) + 2
    along = np.linspace(0.0, 1.0, steps)[:, None, None]
    places = (starts + along * (ends - starts)).reshape(-1, 2)
    corner = low - 2.0 * cell
    columns, rows = (np.floor((high - corner) / cell).astype(int) + 3).tolist()
    touched = np.zeros((rows, columns), dtype=np.bool_)
    column, row = np.floor((places - corner) / cell).astype(int).T
    touched[row, column] = True
    wider = binary_dilation(touched, np.ones((3, 3), dtype=np.bool_))
    return Footprint(wider, float(corner[0]), float(corner[1]), 1.0 / cell)


def casters_towards(objects: Objects, sun: Sun) -> Casters:
    """The triangles of objects, listed by where they lie across the rays to a sun."""
    towards = np.asarray(sun.direction, dtype=np.float64)
    across = np.cross(towards, np.eye(3)[int(np.argmin(np.abs(towards)))])
    across /= np.linalg.norm(across)
    # the kernel's rays run exactly along the sun's direction, as the third axis
    axes = np.stack([across, np.cross(towards, across), towards])
    casters: Casters = list_casters(objects.triangles, objects.first_triangle, axes)
    return casters


def potentially_visible(
    spheres: Float64[np.ndarray, "bodies 4"],
    sun: Float64[np.ndarray, "3"],
    lowest_m: float,
    cone: Cone,
) -> Bool[np.ndarray, "bodies"]:
    """Which bodies a picture within a cone may show, or show the shadows of: all others may as well not be there.

    What a body hides from the sun lies within its radius of a line from its middle away from the sun, which ends where
    all of it is below the lowest ground. A sphere about that line and the body is held against the cone.

    Parameters
    ----------
    spheres
        Centre and radius of a sphere about each body, metres.
    sun
        Unit vector towards the sun; where it is not above the horizon there are no shadows.
    lowest_m
        Bound of the ground's height.
    cone
        What the picture shows lies in it.
    """
    tops = np.maximum(spheres[:, 2] + spheres[:, 3] - lowest_m, 0.0)
    half = 0.5 * tops / sun[2] if sun[2] > 0.0 else np.zeros(len(spheres))
    about = np.column_stack([spheres[:, :3] - half[:, None] * sun, spheres[:, 3] + half])
    return spheres_in_cone(about, *cone)
