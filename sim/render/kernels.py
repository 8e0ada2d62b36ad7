"""Compiled kernel of the picture: where each pixel's ray meets the ground, and how bright the ground is there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.terrain.kernels import Array, Level, sample

Array32 = NDArray[np.float32]


@njit(cache=True, inline="always")
def _depth_at(depth: Array32, u: float, v: float) -> float:
    """Depth between the samples of a depth picture, by linear interpolation of its inverse; 0 where there is none.

    The inverse of depth is linear over a plane's picture. Across the edge of one surface before another the nearest
    sample is taken instead.
    """
    rows, columns = depth.shape
    i = min(max(math.floor(v), 0), rows - 2)
    j = min(max(math.floor(u), 0), columns - 2)
    fu = u - j
    fv = v - i
    a = depth[i, j]
    b = depth[i, j + 1]
    c = depth[i + 1, j]
    d = depth[i + 1, j + 1]
    smallest = min(min(a, b), min(c, d))
    largest = max(max(a, b), max(c, d))
    if smallest <= 0.0 or largest > 1.1 * smallest:
        return float(depth[min(i + (1 if fv > 0.5 else 0), rows - 1), min(j + (1 if fu > 0.5 else 0), columns - 1)])
    above = (1.0 - fu) / a + fu / b
    below = (1.0 - fu) / c + fu / d
    return float(1.0 / ((1.0 - fv) * above + fv * below))


@njit(cache=True, inline="always")
def _meet_ground(
    field: Level,
    inverse_spacing: float,
    origin_x: float,
    origin_y: float,
    origin_z: float,
    dx: float,
    dy: float,
    dz: float,
    start: float,
) -> float:
    """Distance along a ray to the surface near a first guess, by Newton's method; the guess itself where it fails."""
    t = start
    bound = 0.05 * start
    for _ in range(8):
        height, slope_x, slope_y, _albedo = sample(field, inverse_spacing, origin_x + t * dx, origin_y + t * dy)
        miss = origin_z + t * dz - height
        closing = dz - slope_x * dx - slope_y * dy
        if closing > -1e-3:
            return start
        step = miss / closing
        t -= step
        if abs(t - start) > bound:
            return start
        if abs(step) < 1e-6 * start:
            break
    return t


@njit(cache=True)
def shade(
    levels: tuple[Level, ...],
    spacing: float,
    depth: Array32,
    focal: float,
    view_from_body: Array,
    world_from_body: Array,
    position: Array,
    origins: Array32,
    directions: Array32,
    pixel_angle: float,
    sun: Array,
    photometry: tuple[float, float, float, float, float, float],
    radiance: Array32,
    distance: Array,
) -> None:
    """Radiance factor and distance along the ray of every pixel.

    Parameters
    ----------
    levels, spacing
        The surface's pyramid and the spacing of its level 0.
    depth, focal, view_from_body
        Depth picture of a pinhole view from `position`, its focal length in samples, and the rotation from body axes
        to the view's (x right, y down, z forward).
    world_from_body, position
        Pose of the body: rotation matrix and the world position of the body frame's origin.
    origins, directions
        Each pixel's ray in body axes, relative to the body's origin, shape (n, 3), float32; directions are unit.
    pixel_angle
        Angle between neighbouring pixels' rays, radians.
    sun
        Unit vector to the sun, world axes.
    photometry
        lunar share, surge amplitude, surge width, surge at 45 deg phase, sky share, sky radiance.
    radiance, distance
        Outputs, shape (n,), float32 and float64; distance is infinite where the ray meets no ground.
    """
    lunar, surge, width, surge_norm, sky_share, sky_radiance = photometry
    middle = depth.shape[0] / 2.0 - 0.5
    base_inverse_spacing = 1.0 / spacing
    top_level = len(levels) - 1
    w = world_from_body
    p = view_from_body
    for n in range(directions.shape[0]):
        bx = directions[n, 0]
        by = directions[n, 1]
        bz = directions[n, 2]
        ox = origins[n, 0]
        oy = origins[n, 1]
        oz = origins[n, 2]
        # the pixel in the depth picture, which was drawn from the body's origin
        px = p[0, 0] * bx + p[0, 1] * by + p[0, 2] * bz
        py = p[1, 0] * bx + p[1, 1] * by + p[1, 2] * bz
        pz = p[2, 0] * bx + p[2, 1] * by + p[2, 2] * bz
        z = _depth_at(depth, focal * px / pz + middle, focal * py / pz + middle)
        if z <= 0.0:
            radiance[n] = sky_radiance
            distance[n] = math.inf
            continue
        dx = w[0, 0] * bx + w[0, 1] * by + w[0, 2] * bz
        dy = w[1, 0] * bx + w[1, 1] * by + w[1, 2] * bz
        dz = w[2, 0] * bx + w[2, 1] * by + w[2, 2] * bz
        x0 = position[0] + w[0, 0] * ox + w[0, 1] * oy + w[0, 2] * oz
        y0 = position[1] + w[1, 0] * ox + w[1, 1] * oy + w[1, 2] * oz
        z0 = position[2] + w[2, 0] * ox + w[2, 1] * oy + w[2, 2] * oz
        t = _meet_ground(levels[0], base_inverse_spacing, x0, y0, z0, dx, dy, dz, z / pz)
        distance[n] = t
        x = x0 + t * dx
        y = y0 + t * dy
        # the level whose samples are as far apart as the pixel's footprint, blended between the two nearest
        footprint = t * pixel_angle / math.sqrt(max(-dz, 0.05))
        fractional = math.log2(max(footprint / spacing, 1.0))
        lower = min(int(fractional), top_level)
        blend = min(fractional - lower, 1.0)
        scale = base_inverse_spacing / (1 << lower)
        _height, slope_x, slope_y, albedo = sample(levels[lower], scale, x, y)
        if blend > 0.0 and lower < top_level:
            _height, slope_x2, slope_y2, albedo2 = sample(levels[lower + 1], 0.5 * scale, x, y)
            slope_x += blend * (slope_x2 - slope_x)
            slope_y += blend * (slope_y2 - slope_y)
            albedo += blend * (albedo2 - albedo)
        up = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        cos_i = (sun[2] - slope_x * sun[0] - slope_y * sun[1]) * up
        cos_e = max(-(dz - slope_x * dx - slope_y * dy) * up, 1e-3)
        value = sky_share * 0.5 * (1.0 + up)
        if cos_i > 0.0:
            cos_g = min(max(-(dx * sun[0] + dy * sun[1] + dz * sun[2]), -1.0), 1.0)
            tan_half = math.sqrt(max(1.0 - cos_g, 0.0) / max(1.0 + cos_g, 1e-9))
            brightening = (1.0 + surge / (1.0 + tan_half / width)) / surge_norm
            value += brightening * (2.0 * lunar * cos_i / (cos_i + cos_e) + (1.0 - lunar) * cos_i)
        radiance[n] = albedo * value
