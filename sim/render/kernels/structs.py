"""Named tuples of arrays: inputs and outputs of the rendering kernels.

A loop over pixels unpacks the tuples before it begins, and passes only arrays to inlined functions. Copying a tuple
increments the reference count of each of its arrays, which takes longer than shading a pixel.
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
#: Minimum and maximum x, then y, metres.
Bounds = tuple[float, float, float, float]
#: Minimum and maximum x, then y, of the visible ground, and its maximum z, metres.
Extent = tuple[float, float, float, float, float]


class Ground(NamedTuple):
    """The pyramid of a terrain surface (`marsyard.sim.render.renderer.pyramid`).

    - levels, ceilings: samples of each level, and upper bounds of its height by block
    - top_level: number of the coarsest level
    - spacing: distance between samples of level 0, metres
    """

    levels: tuple[Level, ...]
    ceilings: tuple[Array32, ...]
    top_level: int
    spacing: float
    extent: Extent


class GroundLevel(NamedTuple):
    """One level of the ground: control values, upper bounds of the height by block, samples per metre."""

    field: Level
    ceiling: Array32
    per_metre: float


class Pose(NamedTuple):
    """Rotation matrix from body to world axes, and world position of the camera's centre of projection."""

    rotation: Array
    position: Array


class Rays(NamedTuple):
    """Rays in body axes: origins relative to the camera's centre, unit directions, and pixel angles in radians."""

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
    """Intersections of rays with ground and objects.

    - distance: along the ray, metres; infinite for the sky
    - triangle, weights: index of the object's triangle (-1: none), and weights of its second and third corner
    - level: terrain level of the intersection with the ground; -1 if the search failed and the distance
      is that of the mesh that OpenGL draws
    """

    distance: Array
    triangle: Ints
    weights: Array32
    level: NDArray[np.int8]


class Views(NamedTuple):
    """Pinhole images rendered by OpenGL from a camera's position.

    - depth: along the optical axis, metres
    - numbers: triangle index plus one, 0 for ground; empty if no triangles were rendered
    - focal: focal length of each view, pixels
    - view_from_body: rotation from body axes to view axes (x right, y down, z forward)
    - view_of_pixel: number of the view that contains each pixel
    """

    depth: Array32
    numbers: Ints
    focal: Array
    view_from_body: Array
    view_of_pixel: Bytes


class GroundShadow(NamedTuple):
    """Shadow of the ground on the grid of one terrain level; a grid of one sample means no shadow.

    - height: height below which the ground hides the centre of the sun, metres
    - caster_distance: distance of the ground that casts the shadow, in steps of `CASTER_UNIT_ROWS` rows of the grid
      (`marsyard.sim.render.kernels.sun`)
    - along_x: whether rows are parallel to x
    - spacing, level: distance between samples, metres, and number of the terrain level
    - row_m: horizontal distance towards the sun from one row to the next, metres
    - cos_elevation: horizontal component of the unit vector to the sun
    - max_height: upper bound of the ground's height, metres
    """

    height: Array32
    caster_distance: Bytes
    along_x: bool
    spacing: float
    level: int
    row_m: float
    cos_elevation: float
    max_height: float


class Footprint(NamedTuple):
    """Region of ground that objects may shade: a grid, its west and south border, cells per metre (0: all ground)."""

    cells: Flags
    west: float
    south: float
    per_metre: float


#: Elements of `Light.law` that describe shadows: diameter of the body at the camera, and angular radius of the sun.
CASTER_DIAMETER, SUN_RADIUS = 6, 7
#: Elements of `Light.drift`.
CLOUD_CELLS_PER_METRE, CLOUD_HEIGHT, DRIFT_EAST, DRIFT_NORTH, CLOUD_OPACITY = range(5)


class Light(NamedTuple):
    """Illumination at one time.

    - sun: unit vector to the sun
    - law: coefficients of the reflectance law: lunar fraction, surge amplitude, surge width, normalisation, irradiance
      of the sky, light from the surrounding ground; then the diameter of a round body at the camera that casts a
      shadow, metres, and the angular radius of the sun, radians
    - sky: coefficients of `sky_brightness`
    - cover, drift: cloud cover on a periodic grid; its cells per metre, height, displacement to east and north, metres,
      and opacity (0: no clouds)
    """

    sun: Array
    law: Array
    sky: Array
    cover: Array32
    drift: Array


class MicroRelief(NamedTuple):
    """Octaves of height noise on the ground, and maps of their strength. Without octaves `heights` is empty.

    - coarsest: cell size of the coarsest octave, metres; the cell size is halved with each octave
    - heights: height amplitude of each octave, metres, coarsest first
    - factors: factors of these heights, and of the ground's albedo texture, on a periodic grid: the first two channels
      of `marsyard.sim.terrain.surface.Surface.factors`
    - per_metre: samples of that grid per metre
    """

    coarsest: float
    heights: Array
    factors: Array32
    per_metre: float


class Materials(NamedTuple):
    """Micro-relief, textures (coarsest cell size, octave amplitudes), normals at triangle corners, albedo of bodies."""

    relief: MicroRelief
    ground_texture: tuple[float, Array]
    object_texture: tuple[float, Array]
    normals: Array
    body_of_triangle: Ints
    albedo: Array


class ShadedImage(NamedTuple):
    """Output of shading for each pixel: radiance factor, body number (or ground, sky), unit normal in world axes."""

    radiance: Array32
    body: Ints
    normal: Array32


@njit(cache=True, inline="always")
def world_ray(pose: Pose, rays: Rays, n: int) -> Ray:
    """Transform ray n to world axes."""
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
