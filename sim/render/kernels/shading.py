"""Kernels of illumination and reflectance: the radiance of each pixel."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.casters import Casters, find_occluded_positions
from marsyard.sim.render.kernels.microrelief import add_relief_slopes, interpolate_factors, smith_shadowing
from marsyard.sim.render.kernels.noise import NoiseBuffers, allocate_noise
from marsyard.sim.render.kernels.photometry import add_texture, sky_brightness
from marsyard.sim.render.kernels.primary import MIN_INCIDENCE_SINE
from marsyard.sim.render.kernels.strips import (
    ROW,
    STRIP,
    CellBuffers,
    Matrix,
    allocate_cells,
    fetch_levels,
    rotate,
    spline,
    unpack_matrix,
)
from marsyard.sim.render.kernels.structs import (
    CASTER_DIAMETER,
    CLOUD_CELLS_PER_METRE,
    CLOUD_HEIGHT,
    CLOUD_OPACITY,
    DRIFT_EAST,
    DRIFT_NORTH,
    SUN_RADIUS,
    Array32,
    Flags,
    Footprint,
    Ground,
    GroundLevel,
    GroundShadow,
    Hits,
    Ints,
    Light,
    Longs,
    Materials,
    MicroRelief,
    Pose,
    Rays,
    ShadedImage,
)
from marsyard.sim.render.kernels.sun import (
    COARSE_GRID_MARGIN,
    disc_above,
    disc_overlap,
    interpolate_bilinear,
    penumbra,
    shadow_clearance,
    visible_sun_fraction,
)
from marsyard.sim.terrain.kernels import Array, Level, sample

#: Maximum footprint, in samples, for which the finest level is used; the B-spline contains no finer detail.
MAX_SHARP_FOOTPRINT = 1.2
#: Body number of pixels that see the ground, and of pixels that see the sky.
GROUND, SKY = -1, -2
#: Rows of a strip's buffer: position, direction of the line of sight, footprint (infinite without ground), height,
#: slopes and albedo of the terrain, normal, logarithm of the texture's relative albedo, cosines of incidence, emission
#: and phase angles, visible fraction of the sun.
X, Y, Z, DX, DY, DZ, FOOTPRINT, HEIGHT, SLOPE_X, SLOPE_Y, ALBEDO, NX, NY, NZ = (ROW * n for n in range(14))
LOG_ALBEDO, COS_I, COS_E, COS_G, SUN_FRACTION = (ROW * n for n in range(14, 19))
#: Rows of the ground's level: samples per metre, weight of the next coarser level, and terrain of the coarser level.
SCALE, BLEND, COARSE_HEIGHT, COARSE_SLOPE_X, COARSE_SLOPE_Y, COARSE_ALBEDO = (ROW * n for n in range(19, 25))
#: Rows of the pixels with objects: position, footprint and logarithm of the relative albedo.
OBJECT_X, OBJECT_Y, OBJECT_Z, OBJECT_FOOTPRINT, OBJECT_LOG_ALBEDO = (ROW * n for n in range(25, 30))
#: Rows of the micro-relief: slopes, resolved and unresolved variance of slope, strength of texture, and roughness.
RELIEF_SLOPE_X, RELIEF_SLOPE_Y, RESOLVED, UNRESOLVED, STRENGTH, ROUGHNESS = (ROW * n for n in range(30, 36))
ROWS = 36


class Occluders(NamedTuple):
    """Occluders of the sun: the ground's shadow, the objects' triangles, and the region that objects may shade."""

    shadow: GroundShadow
    casters: Casters
    shadow_footprint: Footprint


class _Strip(NamedTuple):
    """Buffers of a strip of pixels.

    - work: rows of values (see `X` and the following constants)
    - level: terrain level of each pixel
    - ground, blended, other: indices of pixels with ground, with two blended levels, and without ground; `other` is
      reused for the pixels with objects and for the pixels that are tested for shadows of objects
    - hidden: whether objects hide the sun
    - noise: buffers of textures and micro-relief
    """

    work: Array
    level: Longs
    ground: Longs
    blended: Longs
    other: Longs
    hidden: Flags
    noise: NoiseBuffers


@njit(cache=True, inline="always")
def _may_be_shaded(region: Footprint, x: float, y: float) -> bool:
    """Return whether an object may hide the sun from the ground at a position."""
    if region.per_metre == 0.0:
        return True
    cells = region.cells
    column = math.floor((x - region.west) * region.per_metre)
    row = math.floor((y - region.south) * region.per_metre)
    return bool(0 <= row < cells.shape[0] and 0 <= column < cells.shape[1] and cells[row, column])


# "contract" allows fused multiplications: they round differently, but always the same way on one processor.


@njit(cache=True, inline="always")
def _exp(x: float) -> float:
    """Exponential function to 3e-7 for -4 < x < 4, by the series for x / 16.

    The compiler vectorises it, in contrast to `math.exp`.
    """
    y = x / 16.0
    power = 1.0 / 24.0 + y * (1.0 / 120.0 + y * (1.0 / 720.0))
    power = 1.0 + y * (1.0 + y * (1.0 / 2.0 + y * (1.0 / 6.0 + y * power)))
    power *= power
    power *= power
    power *= power
    return power * power


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _locate_pixels(
    rotation: Matrix,
    centre: tuple[float, float, float],
    origins: Array32,
    directions: Array32,
    pixel_angles: Array32,
    distance: Array,
    width: int,
    work: Array,
) -> None:
    """Compute positions and footprints (as on level ground) of a strip; sky pixels get the position of the camera."""
    for k in range(min(width, STRIP)):
        dx, dy, dz = rotate(rotation, directions[3 * k], directions[3 * k + 1], directions[3 * k + 2])
        x, y, z = rotate(rotation, origins[3 * k], origins[3 * k + 1], origins[3 * k + 2])
        t = distance[k] if distance[k] < math.inf else 0.0
        work[X + k] = centre[0] + x + t * dx
        work[Y + k] = centre[1] + y + t * dy
        work[Z + k] = centre[2] + z + t * dz
        work[DX + k], work[DY + k], work[DZ + k] = dx, dy, dz
        work[FOOTPRINT + k] = t * pixel_angles[k] / math.sqrt(max(-dz, MIN_INCIDENCE_SINE))
        work[LOG_ALBEDO + k] = 0.0
        work[SUN_FRACTION + k] = 1.0


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _evaluate_splines(buffers: CellBuffers, width: int, out: Array) -> None:
    """Evaluate height, slopes per sample and albedo of the terrain for a strip; each is a row of `out`."""
    for k in range(min(width, STRIP)):
        out[k], out[ROW + k], out[2 * ROW + k], out[3 * ROW + k] = spline(buffers[0], buffers[1], k)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _blend_levels(width: int, work: Array) -> None:
    """Blend slopes and albedo of two terrain levels; convert slopes to metres per metre."""
    for k in range(min(width, STRIP)):
        blend, scale = work[BLEND + k], work[SCALE + k]
        slope_x, slope_y, albedo = work[SLOPE_X + k] * scale, work[SLOPE_Y + k] * scale, work[ALBEDO + k]
        change_x = 0.5 * scale * work[COARSE_SLOPE_X + k] - slope_x
        change_y = 0.5 * scale * work[COARSE_SLOPE_Y + k] - slope_y
        change_albedo = work[COARSE_ALBEDO + k] - albedo
        is_blended = blend > 0.0
        work[SLOPE_X + k] = slope_x + blend * change_x if is_blended else slope_x
        work[SLOPE_Y + k] = slope_y + blend * change_y if is_blended else slope_y
        work[ALBEDO + k] = albedo + blend * change_albedo if is_blended else albedo


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _interpolate_normal(normals: Array, triangle: int, second: float, third: float, k: int, work: Array) -> None:
    """Interpolate a triangle's normal by the weights of its second and third corner."""
    first = 1.0 - second - third
    nx = first * normals[triangle, 0, 0] + second * normals[triangle, 1, 0] + third * normals[triangle, 2, 0]
    ny = first * normals[triangle, 0, 1] + second * normals[triangle, 1, 1] + third * normals[triangle, 2, 1]
    nz = first * normals[triangle, 0, 2] + second * normals[triangle, 1, 2] + third * normals[triangle, 2, 2]
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    work[NX + k], work[NY + k], work[NZ + k] = nx / length, ny / length, nz / length


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _select_levels(spacing: float, top_level: int, hits: Hits, strip: _Strip) -> tuple[int, int, int]:
    """Select the terrain level of each pixel by its footprint, with blending of the two nearest levels.

    Returns the numbers of pixels with ground, of those with blended levels, and of pixels without ground.
    """
    work, level_of_pixel, ground, blended, other = strip.work, strip.level, strip.ground, strip.blended, strip.other
    distance, triangle, level = hits.distance, hits.triangle, hits.level
    n_ground, n_blended, n_other = 0, 0, 0
    for k in range(distance.size):
        work[BLEND + k] = 0.0
        if distance[k] == math.inf or triangle[k] >= 0:
            other[n_other] = k
            n_other += 1
            continue
        lower = 0
        if level[k] > 0 or work[FOOTPRINT + k] > MAX_SHARP_FOOTPRINT * spacing:
            footprint_level = math.log2(max(work[FOOTPRINT + k] / (MAX_SHARP_FOOTPRINT * spacing), 1.0))
            fractional = max(footprint_level, float(level[k]))
            lower = min(int(fractional), top_level)
            if lower < top_level and fractional > lower:
                work[BLEND + k] = min(fractional - lower, 1.0)
                blended[n_blended] = k
                n_blended += 1
        level_of_pixel[k] = lower
        work[SCALE + k] = 1.0 / spacing / (1 << lower)
        ground[n_ground] = k
        n_ground += 1
    return n_ground, n_blended, n_other


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _sample_ground(
    levels: tuple[Level, ...],
    per_metre: float,
    n_ground: int,
    n_blended: int,
    width: int,
    strip: _Strip,
    buffers: CellBuffers,
) -> None:
    """Sample slopes, albedo and normals of the ground for a strip of pixels."""
    work = strip.work
    if n_ground > 0:
        x, y = work[X : X + ROW], work[Y : Y + ROW]
        fetch_levels(levels, per_metre, strip.level, strip.ground, n_ground, x, y, buffers)
        _evaluate_splines(buffers, width, work[HEIGHT : HEIGHT + 4 * ROW])
        if n_blended > 0:
            for m in range(n_blended):
                strip.level[strip.blended[m]] += 1
            fetch_levels(levels, per_metre, strip.level, strip.blended, n_blended, x, y, buffers)
            _evaluate_splines(buffers, width, work[COARSE_HEIGHT : COARSE_HEIGHT + 4 * ROW])
        _blend_levels(width, work)
    for k in range(min(width, STRIP)):
        slope_x, slope_y = work[SLOPE_X + k], work[SLOPE_Y + k]
        nz = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        work[NX + k], work[NY + k], work[NZ + k] = -slope_x * nz, -slope_y * nz, nz


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _sample_objects(
    materials: Materials, hits: Hits, pixel_angles: Array32, n_other: int, strip: _Strip, body: Ints
) -> int:
    """Sample normals, albedo and footprints of objects for a strip of pixels, and mark sky pixels.

    Returns the number of pixels with objects; their indices are moved to the start of `strip.other`.
    """
    work, other = strip.work, strip.other
    distance, triangles, weights = hits.distance, hits.triangle, hits.weights
    normals, body_of_triangle, albedo = materials.normals, materials.body_of_triangle, materials.albedo
    count = 0
    for m in range(n_other):
        k = other[m]
        work[FOOTPRINT + k] = math.inf
        triangle = triangles[k]
        if distance[k] == math.inf:
            body[k] = SKY
            work[NX + k], work[NY + k], work[NZ + k] = 0.0, 0.0, 0.0
            continue
        _interpolate_normal(normals, triangle, weights[k, 0], weights[k, 1], k, work)
        body[k] = body_of_triangle[triangle]
        work[ALBEDO + k] = albedo[body[k]]
        work[OBJECT_X + count], work[OBJECT_Y + count], work[OBJECT_Z + count] = (work[X + k], work[Y + k], work[Z + k])
        facing = -(work[DX + k] * work[NX + k] + work[DY + k] * work[NY + k] + work[DZ + k] * work[NZ + k])
        work[OBJECT_FOOTPRINT + count] = distance[k] * pixel_angles[k] / math.sqrt(max(facing, 0.05))
        work[OBJECT_LOG_ALBEDO + count] = 0.0
        other[count] = k
        count += 1
    return count


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _roughen_ground(relief: MicroRelief, width: int, strip: _Strip) -> None:
    """Tilt the normals of the ground by the micro-relief, and set the strength of the texture.

    Tilted normals change the mean radiance, but the reflectance law already includes the mean effect of all roughness.
    `_shade_roughness` therefore restores the mean.
    """
    work = strip.work
    for k in range(width):
        work[STRENGTH + k] = 1.0
        work[RESOLVED + k] = work[UNRESOLVED + k] = 0.0
    if relief.heights.size == 0:
        return
    x, y, footprint = work[X : X + width], work[Y : Y + width], work[FOOTPRINT : FOOTPRINT + width]
    relief_x, relief_y = work[RELIEF_SLOPE_X : RELIEF_SLOPE_X + width], work[RELIEF_SLOPE_Y : RELIEF_SLOPE_Y + width]
    resolved, unresolved = work[RESOLVED : RESOLVED + width], work[UNRESOLVED : UNRESOLVED + width]
    add_relief_slopes(x, y, footprint, relief, strip.noise, relief_x, relief_y, resolved, unresolved)
    for k in range(width):
        factor = 0.0
        if footprint[k] < math.inf:
            factor, work[STRENGTH + k] = interpolate_factors(relief, x[k], y[k])
        work[ROUGHNESS + k] = factor
    for k in range(min(width, STRIP)):
        factor, is_ground = work[ROUGHNESS + k], work[FOOTPRINT + k] < math.inf
        work[RESOLVED + k] *= factor * factor
        work[UNRESOLVED + k] *= factor * factor
        slope_x = work[SLOPE_X + k] + factor * work[RELIEF_SLOPE_X + k]
        slope_y = work[SLOPE_Y + k] + factor * work[RELIEF_SLOPE_Y + k]
        nz = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        work[NX + k] = -slope_x * nz if is_ground else work[NX + k]
        work[NY + k] = -slope_y * nz if is_ground else work[NY + k]
        work[NZ + k] = nz if is_ground else work[NZ + k]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _shade_roughness(width: int, work: Array) -> None:
    """Restore the mean radiance after the normals were tilted, and darken by shadows of unresolved relief.

    On level ground the mean of n_z, 1 / sqrt(1 + slope**2), is 1 - variance to second order in the slope.
    """
    for k in range(min(width, STRIP)):
        cosine = min(max(work[COS_I + k], 1e-6), 1.0)
        work[SUN_FRACTION + k] *= (1.0 + work[RESOLVED + k]) * smith_shadowing(cosine, work[UNRESOLVED + k])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _apply_texture(materials: Materials, width: int, n_objects: int, strip: _Strip) -> None:
    """Multiply the albedo of ground and objects by their textures."""
    work = strip.work
    position = work[X : X + width], work[Y : Y + width], work[Z : Z + width]
    strength = work[STRENGTH : STRENGTH + width]
    footprint, change = work[FOOTPRINT : FOOTPRINT + width], work[LOG_ALBEDO : LOG_ALBEDO + width]
    add_texture(position, footprint, materials.ground_texture, strength, strip.noise, change)
    if n_objects > 0:
        position = (
            work[OBJECT_X : OBJECT_X + n_objects],
            work[OBJECT_Y : OBJECT_Y + n_objects],
            work[OBJECT_Z : OBJECT_Z + n_objects],
        )
        footprint = work[OBJECT_FOOTPRINT : OBJECT_FOOTPRINT + n_objects]
        change = work[OBJECT_LOG_ALBEDO : OBJECT_LOG_ALBEDO + n_objects]
        # full strength; the row of relief slopes is free at this point
        strength = work[RELIEF_SLOPE_X : RELIEF_SLOPE_X + n_objects]
        strength[:] = 1.0
        add_texture(position, footprint, materials.object_texture, strength, strip.noise, change)
        for m in range(n_objects):
            work[LOG_ALBEDO + strip.other[m]] = work[OBJECT_LOG_ALBEDO + m]
    for k in range(min(width, STRIP)):
        work[ALBEDO + k] *= _exp(work[LOG_ALBEDO + k])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _cast_shadows(
    finest: GroundLevel,
    terrain: Level,
    hits: Hits,
    pixel_angles: Array32,
    light: Light,
    occluders: Occluders,
    body: Ints,
    strip: _Strip,
) -> None:
    """Compute the fraction of the sun's disc that ground and objects leave visible, for each pixel.

    `terrain` is the level on whose grid the ground's shadow was computed.
    """
    sun, radius = light.sun, light.law[SUN_RADIUS]
    distance, triangle, level = hits.distance, hits.triangle, hits.level
    work, other, hidden = strip.work, strip.other, strip.hidden
    shadow, casters, shadow_footprint = occluders
    has_shadow = shadow.height.shape[0] > 1
    has_objects = casters[0].shape[0] > 0
    margin = COARSE_GRID_MARGIN * shadow.spacing
    n_tested = 0
    for k in range(distance.size):
        if work[COS_I + k] <= 0.0 or body[k] == SKY:
            continue
        x, y, z = work[X + k], work[Y + k], work[Z + k]
        on_object = triangle[k] >= 0
        on_finest_level = level[k] == 0
        sun_fraction = 1.0
        if has_shadow:
            if not on_object and not on_finest_level:
                # a pixel on a smoothed level must not be shaded by bumps of the finest level
                height, _slope_x, _slope_y, _albedo = sample(terrain, 1.0 / shadow.spacing, x, y)
                z = max(z, height)
                work[Z + k] = z
            clearance, rows = shadow_clearance(shadow, x, y, z)
            half_penumbra = penumbra(shadow, radius, 0.0, rows)
            if on_object or not on_finest_level:
                sun_fraction = disc_above(clearance / half_penumbra)
            elif clearance <= -margin - half_penumbra:
                sun_fraction = 0.0
            elif clearance < margin + half_penumbra:
                # at the edge of the shadow the grid is too coarse: march towards the sun
                sun_fraction = visible_sun_fraction(finest.field, finest.per_metre, shadow, (x, y, z), sun, radius)
        work[SUN_FRACTION + k] = sun_fraction
        if sun_fraction > 0.0 and has_objects and (on_object or _may_be_shaded(shadow_footprint, x, y)):
            # an offset along the normal, m (objects: plus 5 % of a pixel); rounding could let a facet shade itself
            offset = 1e-4 + (0.05 * distance[k] * pixel_angles[k] if on_object else 0.0)
            work[OBJECT_X + n_tested] = x + offset * work[NX + k]
            work[OBJECT_Y + n_tested] = y + offset * work[NY + k]
            work[OBJECT_Z + n_tested] = z + offset * work[NZ + k]
            other[n_tested] = k
            n_tested += 1
    if n_tested > 0:
        xs, ys = work[OBJECT_X : OBJECT_X + n_tested], work[OBJECT_Y : OBJECT_Y + n_tested]
        zs = work[OBJECT_Z : OBJECT_Z + n_tested]
        find_occluded_positions(casters, xs, ys, zs, hidden)
        for m in range(n_tested):
            work[SUN_FRACTION + other[m]] *= 0.0 if hidden[m] else 1.0


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def photometric_angles(sun: tuple[float, float, float], width: int, work: Array) -> None:
    """Compute the cosines of the incidence, emission and phase angles."""
    for k in range(min(width, STRIP)):
        dx, dy, dz = work[DX + k], work[DY + k], work[DZ + k]
        nx, ny, nz = work[NX + k], work[NY + k], work[NZ + k]
        work[COS_I + k] = sun[0] * nx + sun[1] * ny + sun[2] * nz
        work[COS_E + k] = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
        work[COS_G + k] = min(max(-(dx * sun[0] + dy * sun[1] + dz * sun[2]), -1.0), 1.0)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def reflect(law: tuple[float, float, float, float, float, float], width: int, work: Array, radiance: Array32) -> None:
    """Compute the radiance factor under sun and sky: Lunar-Lambert law with an opposition surge."""
    lunar, amplitude, surge_width, normalisation, sky_fraction, ground_light = law
    for k in range(min(width, STRIP)):
        nz, cos_i, cos_g = work[NZ + k], work[COS_I + k], work[COS_G + k]
        tan_half = math.sqrt(max(1.0 - cos_g, 0.0) / max(1.0 + cos_g, 1e-9))
        surge = 1.0 + amplitude / (1.0 + tan_half / surge_width)
        brightness = normalisation * surge * (2.0 * lunar * cos_i / (cos_i + work[COS_E + k]) + (1.0 - lunar) * cos_i)
        value = sky_fraction * 0.5 * (1.0 + nz) + ground_light * 0.5 * (1.0 - nz)
        value += work[SUN_FRACTION + k] * brightness if cos_i > 0.0 else 0.0
        radiance[k] = work[ALBEDO + k] * value


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def dim_sun(light: Light, distance: Array, work: Array) -> None:
    """Reduce the visible fraction of the sun by a round body at the camera, and by clouds."""
    sun, law, drift, cover = light.sun, light.law, light.drift, light.cover
    diameter, sun_radius, opacity = law[CASTER_DIAMETER], law[SUN_RADIUS], drift[CLOUD_OPACITY]
    for k in range(distance.size):
        if work[COS_I + k] <= 0.0:
            continue
        cos_g = work[COS_G + k]
        if diameter > 0.0 and cos_g > 0.9:
            work[SUN_FRACTION + k] *= 1.0 - disc_overlap(0.5 * diameter / distance[k], sun_radius, math.acos(cos_g))
        if opacity > 0.0:
            path = max(drift[CLOUD_HEIGHT] - work[Z + k], 0.0) / sun[2]
            x, y = work[X + k] + path * sun[0] - drift[DRIFT_EAST], work[Y + k] + path * sun[1] - drift[DRIFT_NORTH]
            work[SUN_FRACTION + k] *= 1.0 - opacity * interpolate_bilinear(cover, drift[CLOUD_CELLS_PER_METRE], x, y)[0]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def shade_sky(light: Light, pixel_angles: Array32, body: Ints, work: Array, radiance: Array32) -> None:
    """Compute the radiance factor of the sky pixels."""
    sun, sky, radius = light.sun, light.sky, light.law[SUN_RADIUS]
    for k in range(body.size):
        if body[k] == SKY:
            # cosine of the angle between the line of sight and the sun
            cos_sun = work[DX + k] * sun[0] + work[DY + k] * sun[1] + work[DZ + k] * sun[2]
            radiance[k] = sky_brightness(sky, sun[2], radius, work[DZ + k], cos_sun, pixel_angles[k])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def shade(
    ground: Ground,
    pose: Pose,
    rays: Rays,
    hits: Hits,
    light: Light,
    occluders: Occluders,
    materials: Materials,
    image: ShadedImage,
) -> None:
    """Compute radiance factor, body and normal of every pixel: geometry, texture, illumination, then photometry."""
    sun = (light.sun[0], light.sun[1], light.sun[2])
    rotation = unpack_matrix(pose.rotation)
    centre = (pose.position[0], pose.position[1], pose.position[2])
    law = light.law
    reflectance = (law[0], law[1], law[2], law[3], law[4], law[5])
    origins, directions, normals = rays.origins.reshape(-1), rays.directions.reshape(-1), image.normal.reshape(-1)
    levels, spacing = ground.levels, ground.spacing
    finest = GroundLevel(levels[0], ground.ceilings[0], 1.0 / spacing)
    terrain = levels[occluders.shadow.level]
    buffers = allocate_cells()
    work = np.empty(ROWS * ROW)
    index_buffers = np.empty((4, STRIP), dtype=np.int64)
    level, on_ground, blended, other = index_buffers
    strip = _Strip(work, level, on_ground, blended, other, np.empty(STRIP, dtype=np.bool_), allocate_noise())
    count = rays.directions.shape[0]
    for first in range(0, count, STRIP):
        last = min(first + STRIP, count)
        width = last - first
        angles, body, radiance = rays.pixel_angles[first:last], image.body[first:last], image.radiance[first:last]
        strip_hits = Hits(
            hits.distance[first:last], hits.triangle[first:last], hits.weights[first:last], hits.level[first:last]
        )
        body[:] = GROUND
        start, end = 3 * first, 3 * last
        _locate_pixels(
            rotation, centre, origins[start:end], directions[start:end], angles, strip_hits.distance, width, work
        )
        n_ground, n_blended, n_other = _select_levels(spacing, ground.top_level, strip_hits, strip)
        _sample_ground(levels, 1.0 / spacing, n_ground, n_blended, width, strip, buffers)
        n_objects = _sample_objects(materials, strip_hits, angles, n_other, strip, body)
        for k in range(width):
            n = start + 3 * k
            normals[n], normals[n + 1], normals[n + 2] = work[NX + k], work[NY + k], work[NZ + k]
        _roughen_ground(materials.relief, width, strip)
        photometric_angles(sun, width, work)
        _apply_texture(materials, width, n_objects, strip)
        _cast_shadows(finest, terrain, strip_hits, angles, light, occluders, body, strip)
        if law[CASTER_DIAMETER] > 0.0 or light.drift[CLOUD_OPACITY] > 0.0:
            dim_sun(light, strip_hits.distance, work)
        if materials.relief.heights.size > 0:
            _shade_roughness(width, work)
        reflect(reflectance, width, work, radiance)
        shade_sky(light, angles, body, work, radiance)
