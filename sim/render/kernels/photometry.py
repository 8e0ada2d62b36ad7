"""Kernels of the light of dusty air, in the sky and before the ground, and of the surface texture (albedo noise)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.noise import NoiseBuffers, noise_3d
from marsyard.sim.render.kernels.strips import STRIP
from marsyard.sim.render.kernels.structs import Array32
from marsyard.sim.terrain.kernels import Array

#: Sine of the elevation below which the sky's brightness is constant.
MIN_ELEVATION_SINE = 1e-3


@njit(cache=True)
def single_scattering(cos_zenith: float, cos_sun_zenith: float, cos_g: float, depth: float, asymmetry: float) -> float:
    """Single-scattering radiance of a plane air layer from below, relative to direct sunlight, up to a factor.

    ``P(g) mu0 / (mu0 - mu) (1 - exp(tau / mu0 - tau / mu))`` with the Henyey-Greenstein phase function P and
    the optical depth tau. mu and mu0 are the sines of the elevations of the direction and of the sun.
    """
    mu = max(cos_zenith, MIN_ELEVATION_SINE)
    mu0 = max(cos_sun_zenith, MIN_ELEVATION_SINE)
    # the limit for equal elevations avoids 0 / 0
    difference = depth / mu - depth / mu0
    path = 1.0 - 0.5 * difference if abs(difference) < 1e-6 else -math.expm1(-difference) / difference
    phase = (1.0 - asymmetry * asymmetry) / (1.0 + asymmetry * asymmetry - 2.0 * asymmetry * cos_g) ** 1.5
    brightness: float = phase * path * depth / mu
    return brightness


@njit(cache=True)
def sky_brightness(sky: Array, sun_z: float, sun_radius: float, dz: float, cos_g: float, pixel_rad: float) -> float:
    """Radiance factor of the sky in a direction; a dusty sky includes the disc of the sun.

    - sky: uniform radiance factor, factor of single scattering (0 for a uniform sky), its optical depth, asymmetry
    - sun_z, sun_radius: sine of the sun's elevation, and its angular radius
    - dz, cos_g: sine of the direction's elevation, and cosine of its angle from the sun
    - pixel_rad: angle that the pixel subtends, radians: the width of the disc's edge
    """
    brightness: float = sky[0]
    if sky[1] <= 0.0:
        return brightness
    brightness += sky[1] * single_scattering(dz, sun_z, cos_g, sky[2], sky[3])
    if cos_g > 0.9:
        disc_fraction = (sun_radius - math.acos(min(cos_g, 1.0))) / pixel_rad + 0.5
        # the radiance factor of the disc is pi / solid angle, 1 / radius**2; the ramp across the edge adds
        # pixel**2 / 12 to the squared radius, on average
        brightness += min(max(disc_fraction, 0.0), 1.0) / (sun_radius * sun_radius + pixel_rad * pixel_rad / 12.0)
    return brightness


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def add_air_light(
    radiance: Array32,
    distance: Array,
    transmission: Array32,
    directions: Array32,
    sun: tuple[np.float32, np.float32, np.float32],
    air: tuple[np.float32, np.float32, np.float32],
    hazy: Array32,
) -> None:
    """Compute the radiance factors behind dusty air, from those without it; the sky is not changed.

    - distance, transmission: distance to the ground, infinite for the sky, and transmission of the air up to there
    - directions, sun: unit vectors of the lines of sight and to the sun, in the same axes
    - air: single-scattering albedo, asymmetry of the phase function, and mean light that the air scatters, excluding
      direct sunlight
    - hazy: output
    """
    one = np.float32(1.0)
    albedo, g, ambient = air
    for n in range(radiance.size):
        cosine = directions[n, 0] * sun[0] + directions[n, 1] * sun[1] + directions[n, 2] * sun[2]
        base = one + g * g - np.float32(2.0) * g * cosine
        phase = (one - g * g) / (base * np.sqrt(base))
        source = albedo * (np.float32(0.25) * phase + ambient)
        value = transmission[n] * radiance[n] + (one - transmission[n]) * source
        hazy[n] = value if distance[n] < math.inf else radiance[n]


@njit(cache=True)
def scattered_irradiance(sun_z: float, depth: float, asymmetry: float) -> float:
    """Irradiance of level ground divided by pi, under the sky of `single_scattering`: ``1 / pi int L mu dOmega``.

    Midpoint rule with 256 steps in the squared sine of elevation and 256 steps in azimuth over 180 deg (the other half
    is symmetric).
    """
    steps = 256
    sun_cos_elevation = math.sqrt(max(1.0 - sun_z * sun_z, 0.0))
    total = 0.0
    for i in range(steps):
        mu = math.sqrt((i + 0.5) / steps)
        cos_elevation = math.sqrt(1.0 - mu * mu)
        for k in range(steps):
            cos_g = mu * sun_z + cos_elevation * sun_cos_elevation * math.cos(math.pi * (k + 0.5) / steps)
            total += single_scattering(mu, sun_z, cos_g, depth, asymmetry)
    return total / (steps * steps)


#: Mean square of `noise_3d` over space.
NOISE_VARIANCE = 0.0732
#: A pixel averages over its area: a wave of f cycles per footprint keeps the fraction sinc(f) of its amplitude. (The
#: detector model applies the blur of the optics.) Noise with cells of c footprints has a median frequency of 0.53
#: cycles per cell; ``(1 - FADING / c^2)^2`` approximates its sinc to 0.02 down to the Nyquist frequency. FADING is
#: (0.53 pi)^2 / 12, from the series sinc(f) = 1 - (pi f)^2 / 6. Waves above the Nyquist frequency alias, as in a real
#: camera.
FADING = 0.231
#: Cell size, in footprints, at which an octave vanishes.
MIN_CELLS = math.sqrt(FADING)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _add_octave(
    noise: Array32, footprint: Array, cell: float, amplitude: float, strength: Array, change: Array
) -> None:
    """Add one octave of `add_texture`."""
    for k in range(min(footprint.size, STRIP)):
        ratio = footprint[k] / cell
        fade = max(1.0 - FADING * ratio * ratio, 0.0)
        gain = strength[k] * amplitude * (fade * fade)
        change[k] += gain * noise[k] - 0.5 * NOISE_VARIANCE * gain * gain


@njit(cache=True)
def add_texture(
    position: tuple[Array, Array, Array],
    footprint: Array,
    texture: tuple[float, Array],
    strength: Array,
    buffers: NoiseBuffers,
    change: Array,
) -> None:
    """Add the logarithm of the relative albedo, averaged over the pixels' footprints, to `change`.

    - position, footprint, strength: coordinates of up to `STRIP` points, their footprints, factors of the amplitudes
    - texture: cell size of the coarsest octave, and amplitudes of the octaves

    Octave n has lattice cells of ``coarsest / 2**n``. It fades by the average over the pixel (`FADING`), so that detail
    appears gradually as a camera approaches the surface. Half of each octave's variance is subtracted (mean of a
    log-normal variable): the mean albedo does not depend on the number of visible octaves. Pixels with an infinite
    footprint have no texture.
    """
    finest = math.inf
    for k in range(footprint.size):
        finest = min(finest, footprint[k])
    cell, amplitudes = texture
    for octave in range(amplitudes.size):
        if cell <= MIN_CELLS * finest:
            break
        if amplitudes[octave] != 0.0:
            noise_3d(position[0], position[1], position[2], cell, octave, buffers)
            _add_octave(buffers.noise, footprint, cell, amplitudes[octave], strength, change)
        cell *= 0.5
