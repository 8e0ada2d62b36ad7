"""Structs of arrays that kernels take and return.

A loop over pixels takes the arrays out of their structs before it begins, and passes only arrays to inlined functions:
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
#: Bounds of x, then of y, metres.
Bounds = tuple[float, float, float, float]
#: Bounds of the visible ground in x, then in y, and its greatest z.
Extent = tuple[float, float, float, float, float]


class Ground(NamedTuple):
    """The surface's pyramid (`marsyard.sim.render.renderer.pyramid`): levels, ceilings, number of the coarsest level,
    spacing of level 0, metres, and extent of the ground.
    """

    levels: tuple[Level, ...]
    ceilings: tuple[Array32, ...]
    top_level: int
    spacing: float
    extent: Extent


class GroundLevel(NamedTuple):
    """One level of the ground: control values, upper bounds of its height by block, samples per metre."""

    field: Level
    ceiling: Array32
    per_metre: float


class Pose(NamedTuple):
    """Rotation matrix from body to world axes, and world position of the camera's centre of projection."""

    rotation: Array
    position: Array


class Rays(NamedTuple):
    """Rays in body axes, relative to a camera's centre: origins, unit directions, angles of pixels, radians."""

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
    """Hits of rays.

    - distance: along the ray, metres, infinite for the sky
    - triangle, weights: number of the object's triangle, -1 for none, and weights of its second and third corner
    - level: that of the terrain on which the ray meets the ground, -1 where the mesh's distance stands
    """

    distance: Array
    triangle: Ints
    weights: Array32
    level: NDArray[np.int8]


class Views(NamedTuple):
    """Pinhole views from a camera's position.

    - depth: along the axis, metres
    - numbers: those of triangles plus one, 0 for ground, empty where no triangles were drawn
    - focal: in samples
    - view_from_body: rotates body axes to a view's (x right, y down, z forward)
    """

    depth: Array32
    numbers: Ints
    focal: Array
    view_from_body: Array
    view_of_pixel: Bytes


class GroundShadow(NamedTuple):
    """The ground's shadow on the grid of a level of the surface; one side is 1 where there is none.

    - height: height below which the ground hides the centre of the sun
    - reach: distance of the shadow's caster (`marsyard.sim.render.kernels.sun.sweep_shadow`)
    - along_x: whether rows run along x
    - row_m: distance along the sun's direction from one row to the next
    - across: horizontal component of the sun's direction
    - highest: upper bound of the ground's height
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
    """Region of ground that objects may shade: a grid, its west and south border, cells per metre; 0: everywhere."""

    cells: Flags
    west: float
    south: float
    per_metre: float


class Light(NamedTuple):
    """The light at one time.

    - sun: unit vector towards it
    - law: lunar share, surge amplitude, surge width, normalisation, sky share, light from the surrounding ground,
      diameter of a round body at the camera that casts a shadow, angular radius of the sun
    - sky: see `sky_brightness`
    - drift: of the clouds: cells per metre, height, drift to east and north, opacity, 0 without clouds
    """

    sun: Array
    law: Array
    sky: Array
    cover: Array32
    drift: Array


class MicroRelief(NamedTuple):
    """Octaves of height noise on the ground, and maps of their strength; no octaves where there are no heights.

    - coarsest: size of the coarsest octave's lattice cells, metres; each further octave is half as large
    - heights: amplitude of each octave's heights, metres, coarsest first
    - roughness, texture: factors of these heights, and of the ground's albedo texture, on a periodic grid
    - per_metre: samples of that grid per metre
    """

    coarsest: float
    heights: Array
    roughness: Array32
    texture: Array32
    per_metre: float


class Materials(NamedTuple):
    """Relief and textures (coarsest cell, amplitudes of octaves), normals at triangles' corners, albedo of bodies."""

    relief: MicroRelief
    ground_texture: tuple[float, Array]
    object_texture: tuple[float, Array]
    normals: Array
    body_of_triangle: Ints
    albedo: Array


class Picture(NamedTuple):
    """Radiance factor, body number (or ground, sky), and unit normal in world axes of every pixel."""

    radiance: Array32
    body: Ints
    normal: Array32


@njit(cache=True, inline="always")
def world_ray(pose: Pose, rays: Rays, n: int) -> Ray:
    """Return the n-th of some rays in world axes."""
    x, y, z = _rotate(pose.rotation, rays.origins, n)
    dx, dy, dz = _rotate(pose.rotation, rays.directions, n)
    return Ray(pose.position[0] + x, pose.position[1] + y, pose.position[2] + z, dx, dy, dz)


@njit(cache=True, inline="always")
def _rotate(rotation: Array, vectors: Array | Array32, n: int) -> tuple[float, float, float]:
    x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )
