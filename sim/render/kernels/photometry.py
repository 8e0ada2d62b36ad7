"""Compiled photometry of a strip of pixels: cosines of light and view, what dims the sun, reflection, and the sky."""

from __future__ import annotations

import math

from numba import njit

from marsyard.sim.render.kernels.sky import sky_brightness
from marsyard.sim.render.kernels.strips import ROW, STRIP
from marsyard.sim.render.kernels.structs import Array32, Ints, Light
from marsyard.sim.render.kernels.sun import cloud_cover, disc_overlap
from marsyard.sim.terrain.kernels import Array

#: Body number of pixels that see the ground, and of pixels that see the sky.
GROUND, SKY = -1, -2
#: Rows of what is kept of a strip of pixels: the place seen and the direction to it, its pixel's footprint (infinite
#: where no ground is seen), the terrain there, the normal, how texture changes albedo, cosines of incidence, emission
#: and phase, and the share of the sun that is seen.
X, Y, Z, DX, DY, DZ, FOOTPRINT, HEIGHT, SLOPE_X, SLOPE_Y, ALBEDO, NX, NY, NZ, CHANGE, COS_I, COS_E, COS_G, LIT = (
    ROW * n for n in range(19)
)
#: Rows of the ground's level: its samples to the metre, the share of the next coarser level, and the terrain there.
SCALE, BLEND, COARSE_HEIGHT, COARSE_SLOPE_X, COARSE_SLOPE_Y, COARSE_ALBEDO = (ROW * n for n in range(19, 25))
#: Rows of objects alone: places, footprints and changes.
OBJECT_X, OBJECT_Y, OBJECT_Z, OBJECT_FOOTPRINT, OBJECT_CHANGE = (ROW * n for n in range(25, 30))
ROWS = 30


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def photometric_angles(sun: tuple[float, float, float], width: int, work: Array) -> None:
    """Cosines of incidence, emission and phase."""
    for k in range(min(width, STRIP)):
        dx, dy, dz = work[DX + k], work[DY + k], work[DZ + k]
        nx, ny, nz = work[NX + k], work[NY + k], work[NZ + k]
        work[COS_I + k] = sun[0] * nx + sun[1] * ny + sun[2] * nz
        work[COS_E + k] = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
        work[COS_G + k] = min(max(-(dx * sun[0] + dy * sun[1] + dz * sun[2]), -1.0), 1.0)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def reflect(law: tuple[float, float, float, float, float, float], width: int, work: Array, radiance: Array32) -> None:
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


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def dim_sun(light: Light, distance: Array, work: Array) -> None:
    """What a round body at the camera's place and clouds leave of the sun."""
    sun, law, drift, cover = light.sun, light.law, light.drift, light.cover
    for k in range(distance.size):
        if work[COS_I + k] <= 0.0:
            continue
        cos_g = work[COS_G + k]
        if law[6] > 0.0 and cos_g > 0.9:
            work[LIT + k] *= 1.0 - disc_overlap(0.5 * law[6] / distance[k], law[7], math.acos(cos_g))
        if drift[4] > 0.0:
            up = max(drift[1] - work[Z + k], 0.0) / sun[2]
            x, y = work[X + k] + up * sun[0] - drift[2], work[Y + k] + up * sun[1] - drift[3]
            work[LIT + k] *= 1.0 - drift[4] * cloud_cover(cover, drift[0], x, y)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def draw_sky(light: Light, pixel_angles: Array32, body: Ints, work: Array, radiance: Array32) -> None:
    """Radiance factor of the pixels that see the sky."""
    sun, sky, radius = light.sun, light.sky, light.law[7]
    for k in range(body.size):
        if body[k] == SKY:
            cos_g = work[DX + k] * sun[0] + work[DY + k] * sun[1] + work[DZ + k] * sun[2]
            radiance[k] = sky_brightness(sky, sun[2], radius, work[DZ + k], cos_g, pixel_angles[k])
