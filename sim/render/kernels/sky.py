"""How bright the sky is in a direction."""

from __future__ import annotations

import math

from numba import njit

from marsyard.sim.terrain.kernels import Array

#: Sine of the elevation below which the sky is as bright as there.
HORIZON = 1e-3


@njit(cache=True)
def single_scattering(cos_zenith: float, cos_sun_zenith: float, cos_g: float, depth: float, asymmetry: float) -> float:
    """Brightness of a plane layer of air seen from below over the sun's there, to a constant: light scattered once.

    ``P(g) mu0 / (mu0 - mu) (1 - exp(tau / mu0 - tau / mu))`` with the Henyey-Greenstein phase function P.
    """
    mu = max(cos_zenith, HORIZON)
    mu0 = max(cos_sun_zenith, HORIZON)
    # written so that it stays exact where both directions are as high
    apart = depth / mu - depth / mu0
    path = 1.0 - 0.5 * apart if abs(apart) < 1e-6 else -math.expm1(-apart) / apart
    phase = (1.0 - asymmetry * asymmetry) / (1.0 + asymmetry * asymmetry - 2.0 * asymmetry * cos_g) ** 1.5
    brightness: float = phase * path * depth / mu
    return brightness


@njit(cache=True)
def sky_brightness(sky: Array, sun_z: float, sun_radius: float, dz: float, cos_g: float, pixel: float) -> float:
    """Radiance factor of the sky in a direction, the sun's disc included where a dusty sky is given.

    Parameters
    ----------
    sky
        Even radiance factor, factor of light scattered once (0 for an even sky), its optical depth, asymmetry.
    sun_z, sun_radius
        Sine of the sun's elevation, and its angular radius.
    dz, cos_g
        Sine of the direction's elevation, and cosine of its angle from the sun.
    pixel
        Angle that the pixel takes: the disc's edge is that soft.
    """
    brightness: float = sky[0]
    if sky[1] <= 0.0:
        return brightness
    brightness += sky[1] * single_scattering(dz, sun_z, cos_g, sky[2], sky[3])
    if cos_g > 0.9:
        inside = (sun_radius - math.acos(min(cos_g, 1.0))) / pixel + 0.5
        # the ramp across the edge adds pixel**2 / 12 to the squared radius, on average
        brightness += min(max(inside, 0.0), 1.0) / (sun_radius * sun_radius + pixel * pixel / 12.0)
    return brightness


@njit(cache=True)
def scattered_irradiance(sun_z: float, depth: float, asymmetry: float) -> float:
    """Irradiance of a level ground over pi under a sky of `single_scattering`: ``1 / pi int L mu dOmega``.

    Midpoints of 256 equal steps in the squared sine of elevation, which is how irradiance weighs the sky, and of 256
    steps of azimuth over the half that differs.
    """
    steps = 256
    beside = math.sqrt(max(1.0 - sun_z * sun_z, 0.0))
    total = 0.0
    for i in range(steps):
        mu = math.sqrt((i + 0.5) / steps)
        level = math.sqrt(1.0 - mu * mu)
        for k in range(steps):
            cos_g = mu * sun_z + level * beside * math.cos(math.pi * (k + 0.5) / steps)
            total += single_scattering(mu, sun_z, cos_g, depth, asymmetry)
    return total / (steps * steps)
