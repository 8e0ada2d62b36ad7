"""What compiled kernels take and return: small structs of arrays, by what they hold.

A loop over pixels takes the arrays out of their structs before it begins, and gives inlined functions arrays alone:
each copy of a struct counts a reference to every array in it, which takes longer than a pixel does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import Array, Level

Array32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]
#: Least and greatest x, least and greatest y, metres.
Bounds = tuple[float, float, float, float]
#: Where the ground that is drawn ends: these, and greatest z.
Extent = tuple[float, float, float, float, float]


class Ground(NamedTuple):
    """The surface's pyramid (`marsyard.sim.render.pyramid`): levels, their ceilings, number of the coarsest level.

    `spacing` is that of level 0, metres; `extent` is where the ground ends.
    """

    levels: tuple[Level, ...]
    ceilings: tuple[Array32, ...]
    top_level: int
    spacing: float
    extent: Extent


class GroundLevel(NamedTuple):
    """One level of the ground: control values, upper bounds of its height by block, samples to the metre."""

    field: Level
    ceiling: Array32
    per_metre: float


class Pose(NamedTuple):
    """Rotation matrix from body to world axes, and world position of the camera's centre of projection."""

    rotation: Array
    position: Array


class Rays(NamedTuple):
    """Rays in body axes, relative to a camera's centre.

    `origins` and `directions` have shape (rays, 3), float32; directions are unit vectors. `pixel_angles` is the angle
    that the pixel of each ray takes, radians.
    """

    origins: Array32
    directions: Array32
    pixel_angles: Array32


class Ray(NamedTuple):
    """A ray in world axes: origin, metres, and unit direction."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


class Hits(NamedTuple):
    """What rays meet.

    `distance` is along the ray, metres, infinite for the sky; `triangle` is the object's, -1 for none; `weights` are
    those of its second and third corner there, empty where there are no triangles; `level` is that of the terrain on
    which the ground was met, -1 where the mesh's own distance stands.
    """

    distance: Array
    triangle: Ints
    weights: Array32
    level: NDArray[np.int8]


class Views(NamedTuple):
    """Pinhole views from a camera's position.

    `depth` is along the axis, metres; `numbers` are those of triangles plus one, 0 for ground, empty where no triangles
    were drawn. `focal` is in samples; `view_from_body` turns body axes to a view's (x right, y down, z forward).
    `view_of_pixel` is the view that holds each pixel.
    """

    depth: Array32
    numbers: Ints
    focal: Array
    view_from_body: Array
    view_of_pixel: Bytes


class GroundShadow(NamedTuple):
    """The ground's shadow on the grid of a level of the surface; one side is 1 where there is none.

    Below `height` the ground hides the sun's middle; what casts the shadow is `reach` units of rows away
    (`marsyard.sim.render.kernels.sun.sweep_shadow`). `along_x`: rows run along x. `spacing` and `level` are the grid's;
    `row_m` is the distance along the sun's direction from one row to the next, and `across` that direction's horizontal
    part. No ground stands above `highest`.
    """

    height: Array32
    reach: Bytes
    along_x: bool
    spacing: float
    level: int
    row_m: float
    across: float
    highest: float


class Footprint(NamedTuple):
    """Places on the ground that objects may shade: a grid, its west and south border, cells a metre; 0: everywhere."""

    cells: Flags
    west: float
    south: float
    per_metre: float


class Light(NamedTuple):
    """The light of a moment.

    `sun` is the unit vector towards it. `law` holds lunar share, surge amplitude, surge width, normalisation, sky
    share, light from the surrounding ground, diameter of a round body at the camera's place that casts a shadow, and
    the sun's angular radius.
    `sky` is as `sky_brightness` takes it. `cover` is that of a layer of clouds; `drift` holds its cells a metre,
    height, drift to east and north, and the share of the sun that a cloud keeps, 0 where there are no clouds.
    """

    sun: Array
    law: Array
    sky: Array
    cover: Array32
    drift: Array


class Materials(NamedTuple):
    """How surfaces look: coarsest cell and amplitudes of the octaves of textures; what objects are made of.

    `normals` are those at the corners of triangles, `body_of_triangle` the body of each, `albedo` that of each body.
    """

    ground_texture: tuple[float, Array]
    object_texture: tuple[float, Array]
    normals: Array
    body_of_triangle: Ints
    albedo: Array


class Picture(NamedTuple):
    """Radiance factor, number of the body seen (or ground, sky), and unit normal in world axes of every pixel."""

    radiance: Array32
    body: Ints
    normal: Array32


@njit(cache=True, inline="always")
def world_ray(pose: Pose, rays: Rays, n: int) -> Ray:
    """The n-th of some rays in world axes."""
    x, y, z = _turned(pose.rotation, rays.origins, n)
    dx, dy, dz = _turned(pose.rotation, rays.directions, n)
    return Ray(pose.position[0] + x, pose.position[1] + y, pose.position[2] + z, dx, dy, dz)


@njit(cache=True, inline="always")
def _turned(rotation: Array, vectors: Array | Array32, n: int) -> tuple[float, float, float]:
    x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )
