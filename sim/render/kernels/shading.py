"""Compiled kernel of the picture: how bright what each pixel sees is."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.render.kernels.casters import Casters, hides_sun
from sim.render.kernels.ground import Array32, world_ray
from sim.render.kernels.sight import FLATTEST, Ints
from sim.render.kernels.sky import sky_brightness
from sim.render.kernels.sun import (
    UNSURE,
    Shadow,
    cloud_cover,
    disc_above,
    disc_overlap,
    shadow_clearance,
    sun_over_ground,
)
from sim.render.kernels.texture import texture
from sim.terrain.kernels import Array, Level, sample

#: Cover of a layer of clouds, and its numbers.
Clouds = tuple[Array32, Array]
#: Places on the ground that things may shade: a grid, its west and south border, and cells a metre; 0: everywhere.
Reach = tuple[NDArray[np.bool_], float, float, float]
#: Body number of pixels that see the ground, and of pixels that see the sky.
GROUND, SKY = -1, -2
#: Footprint, in samples, up to which the finest level is taken: the B-spline itself holds nothing finer than this.
SHARP_UNTIL = 1.2


@njit(cache=True, inline="always")
def _brightness(law: Array, cos_i: float, cos_e: float, cos_g: float) -> float:
    """Radiance factor of ground of unit albedo under the sun alone: Lunar-Lambert with an opposition surge."""
    tan_half = math.sqrt(max(1.0 - cos_g, 0.0) / max(1.0 + cos_g, 1e-9))
    surge = 1.0 + law[1] / (1.0 + tan_half / law[2])
    brightness: float = law[3] * surge * (2.0 * law[0] * cos_i / (cos_i + cos_e) + (1.0 - law[0]) * cos_i)
    return brightness


@njit(cache=True, inline="always")
def _in_reach(reach: Reach, x: float, y: float) -> bool:
    """Whether a thing may hide the sun from the ground at this place."""
    cells, west, south, per_metre = reach
    if per_metre == 0.0:
        return True
    column = math.floor((x - west) * per_metre)
    row = math.floor((y - south) * per_metre)
    return bool(0 <= row < cells.shape[0] and 0 <= column < cells.shape[1] and cells[row, column])


# Fused multiplications round differently, but the same way every time on the same processor.
@njit(cache=True, fastmath={"contract"})
def shade(
    levels: tuple[Level, ...],
    spacing: float,
    distance: Array,
    triangle_of_pixel: Ints,
    weights: Array32,
    level_of_pixel: NDArray[np.int8],
    world_from_body: Array,
    position: Array,
    origins: Array32,
    directions: Array32,
    pixel_angles: Array32,
    sun: Array,
    law: Array,
    sky: Array,
    clouds: Clouds,
    shadow: Shadow,
    shadow_spacing: float,
    shadow_level: int,
    highest: float,
    ground_texture: tuple[float, Array],
    object_texture: tuple[float, Array],
    normals: Array,
    body_of_triangle: Ints,
    albedos: Array,
    casters: Casters,
    reach: Reach,
    radiance: Array32,
    body: Ints,
    normal: Array32,
) -> None:
    """Radiance factor and truth of every pixel.

    Parameters
    ----------
    levels, spacing
        The surface's pyramid and the spacing of its level 0.
    distance, triangle_of_pixel, weights, level_of_pixel
        What each ray meets, as `look` finds it.
    world_from_body, position
        Rotation matrix of the body, and world position of the centre of projection.
    origins, directions
        Each pixel's ray in body axes relative to `position`, shape (n, 3), float32; directions are unit.
    pixel_angles
        Angle that each pixel takes, radians.
    sun
        Unit vector to the sun, world axes.
    law
        Lunar share, surge amplitude, surge width, normalisation, sky share, light from the surrounding ground, diameter
        of what casts a shadow from the body's place, angular radius of the sun.
    sky
        What the sky's brightness comes from, as `sky_brightness` takes it.
    clouds
        Cover of a layer of clouds, and its numbers: cells a metre, height, drift to east and north, share of the sun
        that a cloud keeps; the last is 0 where there are no clouds.
    shadow, shadow_spacing, shadow_level
        The ground's shadow on the grid of a level of the surface; one side is 1 where there is none.
    highest
        Height that no ground exceeds.
    ground_texture, object_texture
        Coarsest cell and amplitudes of octaves.
    normals, body_of_triangle, albedos, casters
        Triangles that stand on the ground: normals at their corners, the body of each, the bodies' albedos, and the
        lists in which shadows look for them.
    reach
        Where the ground may lie in those shadows: a grid, its west and south border, and cells a metre; 0: everywhere.
    radiance, body, normal
        Outputs: radiance factor; number of the thing seen (GROUND, SKY); unit normal in world axes.
    """
    sky_share, bounced, caster, sun_radius = law[4], law[5], law[6], law[7]
    cover, drift = clouds
    dimmed = drift[4] > 0.0
    across = math.sqrt(sun[0] * sun[0] + sun[1] * sun[1])
    row_m = shadow_spacing / max(abs(sun[0]), abs(sun[1]), 1e-9)
    inverse_spacing = 1.0 / spacing
    top_level = len(levels) - 1
    shadowed = shadow[0].shape[0] > 1
    finest = levels[0]
    things = casters[0].shape[0] > 0
    for n in range(directions.shape[0]):
        x0, y0, z0, dx, dy, dz = world_ray(world_from_body, position, origins, directions, n)
        t = distance[n]
        triangle = triangle_of_pixel[n]
        smooth = max(level_of_pixel[n], 0)
        met = level_of_pixel[n] == 0
        if t == math.inf:
            cos_g = dx * sun[0] + dy * sun[1] + dz * sun[2]
            radiance[n] = sky_brightness(sky, sun[2], sun_radius, dz, cos_g, pixel_angles[n])
            body[n] = SKY
            normal[n] = 0.0
            continue
        x = x0 + t * dx
        y = y0 + t * dy
        z = z0 + t * dz
        if triangle >= 0:
            second = weights[n, 0]
            third = weights[n, 1]
            rest = 1.0 - second - third
            nx = rest * normals[triangle, 0, 0] + second * normals[triangle, 1, 0] + third * normals[triangle, 2, 0]
            ny = rest * normals[triangle, 0, 1] + second * normals[triangle, 1, 1] + third * normals[triangle, 2, 1]
            nz = rest * normals[triangle, 0, 2] + second * normals[triangle, 1, 2] + third * normals[triangle, 2, 2]
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            nx /= length
            ny /= length
            nz /= length
            body[n] = body_of_triangle[triangle]
            albedo = albedos[body[n]]
            cos_e = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
            footprint = t * pixel_angles[n] / math.sqrt(max(cos_e, 0.05))
            change = texture(x, y, z, footprint, object_texture[0], object_texture[1])
        else:
            # the level whose samples are as far apart as the pixel's footprint, blended between the two nearest
            footprint = t * pixel_angles[n] / math.sqrt(max(-dz, FLATTEST))
            if smooth == 0 and footprint <= SHARP_UNTIL * spacing:
                _height, slope_x, slope_y, albedo = sample(finest, inverse_spacing, x, y)
            else:
                fractional = max(math.log2(max(footprint / (SHARP_UNTIL * spacing), 1.0)), float(smooth))
                lower = min(int(fractional), top_level)
                blend = min(fractional - lower, 1.0)
                scale = inverse_spacing / (1 << lower)
                _height, slope_x, slope_y, albedo = sample(levels[lower], scale, x, y)
                if blend > 0.0 and lower < top_level:
                    _height, slope_x2, slope_y2, albedo2 = sample(levels[lower + 1], 0.5 * scale, x, y)
                    slope_x += blend * (slope_x2 - slope_x)
                    slope_y += blend * (slope_y2 - slope_y)
                    albedo += blend * (albedo2 - albedo)
            nz = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
            nx = -slope_x * nz
            ny = -slope_y * nz
            cos_e = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
            body[n] = GROUND
            change = texture(x, y, z, footprint, ground_texture[0], ground_texture[1])
        if change != 0.0:
            albedo *= math.exp(change)
        normal[n, 0] = nx
        normal[n, 1] = ny
        normal[n, 2] = nz
        value = sky_share * 0.5 * (1.0 + nz) + bounced * 0.5 * (1.0 - nz)
        cos_i = sun[0] * nx + sun[1] * ny + sun[2] * nz
        if cos_i > 0.0:
            lit = 1.0
            if shadowed:
                if triangle < 0 and not met:
                    # the terrain itself, where the pixel saw it smoothed: its own bumps must not shade a smooth ground
                    height, _slope_x, _slope_y, _albedo = sample(levels[shadow_level], 1.0 / shadow_spacing, x, y)
                    z = max(z, height)
                clear, rows = shadow_clearance(shadow, 1.0 / shadow_spacing, x, y, z)
                # half the depth of the penumbra, which a disc casts past what is so far away
                soft = sun_radius * rows * row_m / across
                if triangle >= 0 or not met:
                    lit = disc_above(clear / soft)
                elif clear <= -UNSURE * shadow_spacing - soft:
                    lit = 0.0
                elif clear < UNSURE * shadow_spacing + soft:
                    # at the shadow's edge the swept grid is too coarse: look towards the sun from here
                    lit = sun_over_ground(
                        finest, inverse_spacing, shadow, shadow_spacing, row_m, x, y, z, sun, sun_radius, highest
                    )
            if lit > 0.0 and things and (triangle >= 0 or _in_reach(reach, x, y)):
                # lifted off its own facet, so that this and those beside do not shade it by rounding
                lift = 1e-4 + (0.05 * t * pixel_angles[n] if triangle >= 0 else 0.0)
                if hides_sun(casters, x + lift * nx, y + lift * ny, z + lift * nz):
                    lit = 0.0
            cos_g = min(max(-(dx * sun[0] + dy * sun[1] + dz * sun[2]), -1.0), 1.0)
            if caster > 0.0 and cos_g > 0.9:
                lit *= 1.0 - disc_overlap(0.5 * caster / t, sun_radius, math.acos(cos_g))
            if dimmed:
                up = max(drift[1] - z, 0.0) / sun[2]
                lit *= 1.0 - drift[4] * cloud_cover(
                    cover, drift[0], x + up * sun[0] - drift[2], y + up * sun[1] - drift[3]
                )
            if lit > 0.0:
                value += lit * _brightness(law, cos_i, cos_e, cos_g)
        radiance[n] = albedo * value
