"""Compiled kernel of the picture: how bright what each pixel sees is."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.casters import Casters, sun_hidden
from marsyard.sim.render.kernels.sight import FLATTEST, Ints
from marsyard.sim.render.kernels.sky import sky_brightness
from marsyard.sim.render.kernels.strips import (
    ROW,
    STRIP,
    Array32,
    Matrix,
    Near,
    fetch_levels,
    no_cells,
    numbers,
    spline,
    times,
)
from marsyard.sim.render.kernels.sun import (
    UNSURE,
    Shadow,
    cloud_cover,
    disc_above,
    disc_overlap,
    shadow_clearance,
    sun_over_ground,
)
from marsyard.sim.render.kernels.texture import add_texture
from marsyard.sim.terrain.kernels import Array, Level, sample

#: Cover of a layer of clouds, and its numbers.
Clouds = tuple[Array32, Array]
#: Places on the ground that things may shade: a grid, its west and south border, and cells a metre; 0: everywhere.
Reach = tuple[NDArray[np.bool_], float, float, float]
#: Body number of pixels that see the ground, and of pixels that see the sky.
GROUND, SKY = -1, -2
#: Footprint, in samples, up to which the finest level is taken: the B-spline itself holds nothing finer than this.
SHARP_UNTIL = 1.2
#: Rows of what is kept of a strip of pixels: the place seen and the direction to it, its pixel's footprint (infinite
#: where no ground is seen), the terrain there, the normal, how texture changes albedo, cosines of incidence, emission
#: and phase, and the share of the sun that is seen.
X, Y, Z, DX, DY, DZ, FOOTPRINT, HEIGHT, SLOPE_X, SLOPE_Y, ALBEDO, NX, NY, NZ, CHANGE, COS_I, COS_E, COS_G, LIT = (
    ROW * n for n in range(19)
)
#: Rows of the ground's level: its samples to the metre, the share of the next coarser level, and the terrain there.
SCALE, BLEND, COARSE_HEIGHT, COARSE_SLOPE_X, COARSE_SLOPE_Y, COARSE_ALBEDO = (ROW * n for n in range(19, 25))
#: Rows of things alone: places, footprints and changes.
THING_X, THING_Y, THING_Z, THING_FOOTPRINT, THING_CHANGE = (ROW * n for n in range(25, 30))
ROWS = 30


@njit(cache=True, inline="always")
def _in_reach(reach: Reach, x: float, y: float) -> bool:
    """Whether a thing may hide the sun from the ground at this place."""
    cells, west, south, per_metre = reach
    if per_metre == 0.0:
        return True
    column = math.floor((x - west) * per_metre)
    row = math.floor((y - south) * per_metre)
    return bool(0 <= row < cells.shape[0] and 0 <= column < cells.shape[1] and cells[row, column])


# Fused multiplications round differently, but the same way every time on the same processor: below, "contract".


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _place(
    rotation: Matrix,
    centre: tuple[float, float, float],
    origins: Array32,
    directions: Array32,
    pixel_angles: Array32,
    distance: Array,
    width: int,
    work: Array,
) -> None:
    """Places that the pixels of a strip see, and footprints as on the ground; its sky is taken to be at the camera."""
    for k in range(min(width, STRIP)):
        dx, dy, dz = times(rotation, directions[3 * k], directions[3 * k + 1], directions[3 * k + 2])
        x, y, z = times(rotation, origins[3 * k], origins[3 * k + 1], origins[3 * k + 2])
        t = distance[k] if distance[k] < math.inf else 0.0
        work[X + k] = centre[0] + x + t * dx
        work[Y + k] = centre[1] + y + t * dy
        work[Z + k] = centre[2] + z + t * dz
        work[DX + k] = dx
        work[DY + k] = dy
        work[DZ + k] = dz
        work[FOOTPRINT + k] = t * pixel_angles[k] / math.sqrt(max(-dz, FLATTEST))
        work[CHANGE + k] = 0.0
        work[LIT + k] = 1.0


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _ground(near: Near, width: int, out: Array) -> None:
    """Height, slopes and albedo of the terrain at the places of a strip, a row of `out` each; slopes by sample."""
    for k in range(min(width, STRIP)):
        out[k], out[ROW + k], out[2 * ROW + k], out[3 * ROW + k] = spline(near[0], near[1], k)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _blend(width: int, work: Array) -> None:
    """Mixes the terrain of the next coarser level into that of the finer, by shares."""
    for k in range(min(width, STRIP)):
        blend, scale = work[BLEND + k], work[SCALE + k]
        slope_x, slope_y, albedo = work[SLOPE_X + k] * scale, work[SLOPE_Y + k] * scale, work[ALBEDO + k]
        to_x = 0.5 * scale * work[COARSE_SLOPE_X + k] - slope_x
        to_y = 0.5 * scale * work[COARSE_SLOPE_Y + k] - slope_y
        to_albedo = work[COARSE_ALBEDO + k] - albedo
        mixed = blend > 0.0
        work[SLOPE_X + k] = slope_x + blend * to_x if mixed else slope_x
        work[SLOPE_Y + k] = slope_y + blend * to_y if mixed else slope_y
        work[ALBEDO + k] = albedo + blend * to_albedo if mixed else albedo


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _face(width: int, work: Array) -> None:
    """Normals of the ground, from its slopes."""
    for k in range(min(width, STRIP)):
        slope_x, slope_y = work[SLOPE_X + k], work[SLOPE_Y + k]
        nz = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        work[NX + k] = -slope_x * nz
        work[NY + k] = -slope_y * nz
        work[NZ + k] = nz


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _thing(normals: Array, triangle: int, second: float, third: float, k: int, work: Array) -> None:
    """Normal of a triangle at a place with these weights of its second and third corner."""
    rest = 1.0 - second - third
    nx = rest * normals[triangle, 0, 0] + second * normals[triangle, 1, 0] + third * normals[triangle, 2, 0]
    ny = rest * normals[triangle, 0, 1] + second * normals[triangle, 1, 1] + third * normals[triangle, 2, 1]
    nz = rest * normals[triangle, 0, 2] + second * normals[triangle, 1, 2] + third * normals[triangle, 2, 2]
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    work[NX + k] = nx / length
    work[NY + k] = ny / length
    work[NZ + k] = nz / length


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _thing_footprint(across: float, k: int, work: Array) -> float:
    """Footprint on a thing of a pixel that is so wide across its line of sight."""
    facing = -(work[DX + k] * work[NX + k] + work[DY + k] * work[NY + k] + work[DZ + k] * work[NZ + k])
    footprint: float = across / math.sqrt(max(facing, 0.05))
    return footprint


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _lean(sun: tuple[float, float, float], width: int, work: Array) -> None:
    """Cosines of incidence, emission and phase."""
    for k in range(min(width, STRIP)):
        dx, dy, dz = work[DX + k], work[DY + k], work[DZ + k]
        nx, ny, nz = work[NX + k], work[NY + k], work[NZ + k]
        work[COS_I + k] = sun[0] * nx + sun[1] * ny + sun[2] * nz
        work[COS_E + k] = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
        work[COS_G + k] = min(max(-(dx * sun[0] + dy * sun[1] + dz * sun[2]), -1.0), 1.0)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _reflect(law: tuple[float, float, float, float, float, float], width: int, work: Array, radiance: Array32) -> None:
    """Radiance factor of ground under sun and sky: Lunar-Lambert with an opposition surge."""
    lunar, amplitude, surge_width, normalisation, sky_share, bounced = law
    for k in range(min(width, STRIP)):
        nz, cos_i, cos_g = work[NZ + k], work[COS_I + k], work[COS_G + k]
        tan_half = math.sqrt(max(1.0 - cos_g, 0.0) / max(1.0 + cos_g, 1e-9))
        surge = 1.0 + amplitude / (1.0 + tan_half / surge_width)
        brightness = normalisation * surge * (2.0 * lunar * cos_i / (cos_i + work[COS_E + k]) + (1.0 - lunar) * cos_i)
        value = sky_share * 0.5 * (1.0 + nz) + bounced * 0.5 * (1.0 - nz)
        value += work[LIT + k] * brightness if cos_i > 0.0 else 0.0
        radiance[k] = work[ALBEDO + k] * value


@njit(cache=True)
def _keep_normals(width: int, work: Array, normal: Array32) -> None:
    """Writes the normals of a strip, three numbers each."""
    for k in range(min(width, STRIP)):
        normal[3 * k] = work[NX + k]
        normal[3 * k + 1] = work[NY + k]
        normal[3 * k + 2] = work[NZ + k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def shade(
    levels: tuple[Level, ...],
    top_level: int,
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
    levels, top_level, spacing
        The surface's pyramid (`marsyard.sim.render.pyramid`), its coarsest level, and the spacing of its level 0.
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
    towards = (sun[0], sun[1], sun[2])
    rotation = numbers(world_from_body)
    centre = (position[0], position[1], position[2])
    reflectance = (law[0], law[1], law[2], law[3], law[4], law[5])
    caster, sun_radius = law[6], law[7]
    cover, drift = clouds
    dimmed = drift[4] > 0.0
    across = math.sqrt(sun[0] * sun[0] + sun[1] * sun[1])
    row_m = shadow_spacing / max(abs(sun[0]), abs(sun[1]), 1e-9)
    inverse_spacing = 1.0 / spacing
    shadowed = shadow[0].shape[0] > 1
    finest = levels[0]
    things = casters[0].shape[0] > 0
    flat_origins, flat_directions, flat_normals = origins.reshape(-1), directions.reshape(-1), normal.reshape(-1)
    work = np.empty(ROWS * ROW)
    near = no_cells()
    level_of = np.empty(STRIP, dtype=np.int64)
    ground = np.empty(STRIP, dtype=np.int64)
    mixed = np.empty(STRIP, dtype=np.int64)
    other = np.empty(STRIP, dtype=np.int64)
    hidden = np.empty(STRIP, dtype=np.bool_)
    count = directions.shape[0]
    for first in range(0, count, STRIP):
        width = min(STRIP, count - first)
        last = first + width
        _place(
            rotation,
            centre,
            flat_origins[3 * first : 3 * last],
            flat_directions[3 * first : 3 * last],
            pixel_angles[first:last],
            distance[first:last],
            width,
            work,
        )
        n_ground = 0
        n_other = 0
        n_mixed = 0
        for k in range(width):
            n = first + k
            body[n] = GROUND
            work[BLEND + k] = 0.0
            if distance[n] == math.inf or triangle_of_pixel[n] >= 0:
                other[n_other] = k
                n_other += 1
                continue
            # the level whose samples are as far apart as the pixel's footprint, blended between the two nearest
            lower = 0
            if level_of_pixel[n] > 0 or work[FOOTPRINT + k] > SHARP_UNTIL * spacing:
                suited = math.log2(max(work[FOOTPRINT + k] / (SHARP_UNTIL * spacing), 1.0))
                fractional = max(suited, float(level_of_pixel[n]))
                lower = min(int(fractional), top_level)
                if lower < top_level and fractional > lower:
                    work[BLEND + k] = min(fractional - lower, 1.0)
                    mixed[n_mixed] = k
                    n_mixed += 1
            level_of[k] = lower
            work[SCALE + k] = inverse_spacing / (1 << lower)
            ground[n_ground] = k
            n_ground += 1
        if n_ground > 0:
            x, y = work[X : X + ROW], work[Y : Y + ROW]
            fetch_levels(levels, inverse_spacing, level_of, ground, n_ground, x, y, near)
            _ground(near, width, work[HEIGHT : HEIGHT + 4 * ROW])
            if n_mixed > 0:
                for m in range(n_mixed):
                    level_of[mixed[m]] += 1
                fetch_levels(levels, inverse_spacing, level_of, mixed, n_mixed, x, y, near)
                _ground(near, width, work[COARSE_HEIGHT : COARSE_HEIGHT + 4 * ROW])
            _blend(width, work)
        _face(width, work)
        seen = 0
        for m in range(n_other):
            k = other[m]
            n = first + k
            if distance[n] == math.inf:
                body[n] = SKY
                work[FOOTPRINT + k] = math.inf
                work[NX + k] = 0.0
                work[NY + k] = 0.0
                work[NZ + k] = 0.0
            elif triangle_of_pixel[n] >= 0:
                _thing(normals, triangle_of_pixel[n], weights[n, 0], weights[n, 1], k, work)
                body[n] = body_of_triangle[triangle_of_pixel[n]]
                work[ALBEDO + k] = albedos[body[n]]
                work[FOOTPRINT + k] = math.inf
                work[THING_X + seen] = work[X + k]
                work[THING_Y + seen] = work[Y + k]
                work[THING_Z + seen] = work[Z + k]
                work[THING_FOOTPRINT + seen] = _thing_footprint(distance[n] * pixel_angles[n], k, work)
                work[THING_CHANGE + seen] = 0.0
                other[seen] = k
                seen += 1
        _lean(towards, width, work)
        add_texture(
            work[X : X + width],
            work[Y : Y + width],
            work[Z : Z + width],
            work[FOOTPRINT : FOOTPRINT + width],
            ground_texture[0],
            ground_texture[1],
            work[CHANGE : CHANGE + width],
        )
        if seen > 0:
            add_texture(
                work[THING_X : THING_X + seen],
                work[THING_Y : THING_Y + seen],
                work[THING_Z : THING_Z + seen],
                work[THING_FOOTPRINT : THING_FOOTPRINT + seen],
                object_texture[0],
                object_texture[1],
                work[THING_CHANGE : THING_CHANGE + seen],
            )
            for m in range(seen):
                work[CHANGE + other[m]] = work[THING_CHANGE + m]
        for k in range(width):
            if work[CHANGE + k] != 0.0:
                work[ALBEDO + k] *= math.exp(work[CHANGE + k])
        asked = 0
        for k in range(width):
            n = first + k
            if work[COS_I + k] <= 0.0 or body[n] == SKY:
                continue
            px, py, pz = work[X + k], work[Y + k], work[Z + k]
            triangle = triangle_of_pixel[n]
            met = level_of_pixel[n] == 0
            lit = 1.0
            if shadowed:
                if triangle < 0 and not met:
                    # the terrain itself, where the pixel saw it smoothed: its own bumps must not shade a smooth ground
                    height, _slope_x, _slope_y, _albedo = sample(levels[shadow_level], 1.0 / shadow_spacing, px, py)
                    pz = max(pz, height)
                    work[Z + k] = pz
                clear, rows = shadow_clearance(shadow, 1.0 / shadow_spacing, px, py, pz)
                # half the depth of the penumbra, which a disc casts past what is so far away
                soft = sun_radius * rows * row_m / across
                if triangle >= 0 or not met:
                    lit = disc_above(clear / soft)
                elif clear <= -UNSURE * shadow_spacing - soft:
                    lit = 0.0
                elif clear < UNSURE * shadow_spacing + soft:
                    # at the shadow's edge the swept grid is too coarse: look towards the sun from here
                    lit = sun_over_ground(
                        finest, inverse_spacing, shadow, shadow_spacing, row_m, px, py, pz, sun, sun_radius, highest
                    )
            work[LIT + k] = lit
            if lit > 0.0 and things and (triangle >= 0 or _in_reach(reach, px, py)):
                # lifted off its own facet, so that this and those beside do not shade it by rounding
                lift = 1e-4 + (0.05 * distance[n] * pixel_angles[n] if triangle >= 0 else 0.0)
                work[THING_X + asked] = px + lift * work[NX + k]
                work[THING_Y + asked] = py + lift * work[NY + k]
                work[THING_Z + asked] = pz + lift * work[NZ + k]
                other[asked] = k
                asked += 1
        if asked > 0:
            x, y, z = work[THING_X : THING_X + asked], work[THING_Y : THING_Y + asked], work[THING_Z : THING_Z + asked]
            sun_hidden(casters, x, y, z, hidden)
            for m in range(asked):
                work[LIT + other[m]] *= 0.0 if hidden[m] else 1.0
        if caster > 0.0 or dimmed:
            for k in range(width):
                if work[COS_I + k] <= 0.0:
                    continue
                cos_g = work[COS_G + k]
                if caster > 0.0 and cos_g > 0.9:
                    seen_wide = 0.5 * caster / distance[first + k]
                    work[LIT + k] *= 1.0 - disc_overlap(seen_wide, sun_radius, math.acos(cos_g))
                if dimmed:
                    up = max(drift[1] - work[Z + k], 0.0) / sun[2]
                    work[LIT + k] *= 1.0 - drift[4] * cloud_cover(
                        cover,
                        drift[0],
                        work[X + k] + up * sun[0] - drift[2],
                        work[Y + k] + up * sun[1] - drift[3],
                    )
        _reflect(reflectance, width, work, radiance[first:last])
        _keep_normals(width, work, flat_normals[3 * first : 3 * last])
        for k in range(width):
            n = first + k
            if body[n] == SKY:
                cos_g = work[DX + k] * sun[0] + work[DY + k] * sun[1] + work[DZ + k] * sun[2]
                radiance[n] = sky_brightness(sky, sun[2], sun_radius, work[DZ + k], cos_g, pixel_angles[n])
