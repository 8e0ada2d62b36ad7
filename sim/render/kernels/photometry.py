"""Kernels of sky brightness and surface texture."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

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


#: Mean square of `gradient_noise` over space.
NOISE_VARIANCE = 0.0732
#: A pixel averages over its area: a wave of f cycles per footprint keeps the fraction sinc(f) of its amplitude. (The
#: detector model applies the blur of the optics.) Noise with cells of c footprints has a median frequency of 0.53
#: cycles per cell; ``(1 - FADING / c^2)^2`` approximates its sinc to 0.02 down to the Nyquist frequency. FADING is
#: (0.53 pi)^2 / 12, from the series sinc(f) = 1 - (pi f)^2 / 6. Waves above the Nyquist frequency alias, as in a real
#: camera.
FADING = 0.231
#: Cell size, in footprints, at which an octave vanishes.
MIN_CELLS = math.sqrt(FADING)


@njit(cache=True)
def _hash_point(i: int, j: int, k: int, seed: int) -> np.uint32:
    """Hash a lattice point (the finaliser of MurmurHash3 over a linear combination of its coordinates)."""
    h = np.uint32(i) * np.uint32(0x8DA6B343)
    h ^= np.uint32(j) * np.uint32(0xD8163841)
    h ^= np.uint32(k) * np.uint32(0xCB1AB31F)
    h ^= np.uint32(seed) * np.uint32(0x9E3779B1)
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x85EBCA6B)
    h ^= h >> np.uint32(13)
    h *= np.uint32(0xC2B2AE35)
    h ^= h >> np.uint32(16)
    return h


@njit(cache=True)
def _gradient_product(h: np.uint32, x: float, y: float, z: float) -> float:
    """Scalar product of an offset and one of Perlin's twelve gradients.

    The last four bits of a hash select one of 16 entries: four gradients have two entries. Written without a table,
    and with selections instead of branches, for vector instructions.
    """
    selector = h & np.uint32(15)
    first = x if selector < np.uint32(8) else y
    second = y if selector < np.uint32(4) else (x if selector & np.uint32(13) == np.uint32(12) else z)
    return (-first if selector & np.uint32(1) else first) + (-second if selector & np.uint32(2) else second)


@njit(cache=True, inline="always")
def gradient_noise(x: float, y: float, z: float, seed: int) -> float:
    """Perlin's improved noise (2002): smooth, of mean zero, with wavelengths of about one to two units."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    x, y, z = x - fx, y - fy, z - fz
    u = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    v = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    w = z * z * z * (z * (z * 6.0 - 15.0) + 10.0)
    below = (1.0 - v) * (
        (1.0 - u) * _gradient_product(_hash_point(i, j, k, seed), x, y, z)
        + u * _gradient_product(_hash_point(i + 1, j, k, seed), x - 1.0, y, z)
    ) + v * (
        (1.0 - u) * _gradient_product(_hash_point(i, j + 1, k, seed), x, y - 1.0, z)
        + u * _gradient_product(_hash_point(i + 1, j + 1, k, seed), x - 1.0, y - 1.0, z)
    )
    above = (1.0 - v) * (
        (1.0 - u) * _gradient_product(_hash_point(i, j, k + 1, seed), x, y, z - 1.0)
        + u * _gradient_product(_hash_point(i + 1, j, k + 1, seed), x - 1.0, y, z - 1.0)
    ) + v * (
        (1.0 - u) * _gradient_product(_hash_point(i, j + 1, k + 1, seed), x, y - 1.0, z - 1.0)
        + u * _gradient_product(_hash_point(i + 1, j + 1, k + 1, seed), x - 1.0, y - 1.0, z - 1.0)
    )
    noise: float = (1.0 - w) * below + w * above
    return noise


@njit(cache=True, error_model="numpy")
def _add_octave(
    x: Array,
    y: Array,
    z: Array,
    footprint: Array,
    cell: float,
    octave: tuple[int, float],
    strength: Array,
    change: Array,
) -> None:
    """Add one octave of `add_texture`; `octave` contains its number and amplitude."""
    number, amplitude = octave
    for k in range(x.size):
        ratio = footprint[k] / cell
        fade = max(1.0 - FADING * ratio * ratio, 0.0)
        gain = strength[k] * amplitude * (fade * fade)
        noise = gradient_noise(x[k] / cell, y[k] / cell, z[k] / cell, number)
        change[k] += gain * noise - 0.5 * NOISE_VARIANCE * gain**2


@njit(cache=True)
def add_texture(
    x: Array, y: Array, z: Array, footprint: Array, coarsest: float, amplitudes: Array, strength: Array, change: Array
) -> None:
    """Add the logarithm of the relative albedo, averaged over the pixels' footprints, to `change`.

    Octave n has lattice cells of ``coarsest / 2**n``. It fades by the average over the pixel (`FADING`), so that detail
    appears gradually as a camera approaches the surface. Half of each octave's variance is subtracted (mean of a
    log-normal variable): the mean albedo does not depend on the number of visible octaves. `strength` is a factor of
    the amplitudes. Pixels with an infinite footprint have no texture.
    """
    finest = math.inf
    for k in range(footprint.size):
        finest = min(finest, footprint[k])
    cell = coarsest
    for octave in range(amplitudes.size):
        if cell <= MIN_CELLS * finest:
            break
        if amplitudes[octave] != 0.0:
            _add_octave(x, y, z, footprint, cell, (octave, amplitudes[octave]), strength, change)
        cell *= 0.5
