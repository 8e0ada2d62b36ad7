"""Radiance of a surface under sun and sky, of the sky, and of the dusty air before the ground."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float as FloatArray
from jaxtyping import Float32

from marsyard.sim.render.arrays import Values, clip, compiled, larger, smaller, to_device, to_host
from marsyard.sim.render.device import Array3f, Float, Float64
from marsyard.sim.render.skylight import SkyLight

#: Sine of the elevation below which the sky's brightness is constant.
MIN_ELEVATION_SINE = 1e-3


@dataclass(frozen=True, eq=False)
class Angles:
    """Cosines of the incidence, emission and phase angles, and tangent of half the phase angle."""

    cos_i: Values
    cos_e: Values
    cos_g: Values
    tan_half_g: Values

    @classmethod
    def of(cls, normal: Values, direction: Values, sun: Values) -> Angles:
        """Compute the angles at surfaces with unit normals, seen along a direction; sun and direction are float64."""
        cos_g = clip(-dr.dot(direction, sun), -1.0, 1.0)
        # near opposition the tangent needs double precision
        tan_half_g = Float(dr.sqrt((1.0 - cos_g) / larger(1.0 + cos_g, 1e-9)))
        cos_e = larger(-dr.dot(Array3f(direction), normal), 1e-3)
        return cls(dr.dot(Array3f(sun), normal), cos_e, cos_g, tan_half_g)


@dataclass(frozen=True, eq=False)
class Law:
    """Coefficients of the reflectance law of `Photometry`: L, B0, h and K; light of the ground and of the sky."""

    lunar_fraction: Values
    surge_amplitude: Values
    surge_width: Values
    normalisation: Values
    ground_light: Values
    sky_light: SkyLight

    def radiance(self, angles: Angles, normal: Values, sun_fraction: Values, blocked: Values) -> Values:
        """Compute the radiance factor of a surface with albedo 1, of which the sun illuminates a fraction.

        `blocked` are the vectors of the hidden sky (`skylight`). Ground below a body that hides the sky is dark; it
        reflects less light by the same fraction.
        """
        cos_i, lunar = angles.cos_i, self.lunar_fraction
        surge = 1.0 + self.surge_amplitude / (1.0 + angles.tan_half_g / self.surge_width)
        disc = 2.0 * lunar * cos_i / (cos_i + angles.cos_e) + (1.0 - lunar) * cos_i
        direct = dr.select(cos_i > 0.0, sun_fraction * self.normalisation * surge * disc, 0.0)
        diffuse = self.sky_light.irradiance(normal, blocked)
        ground_light = 0.5 * self.ground_light * (1.0 - smaller(blocked.z, 1.0))
        return direct + dr.fma(ground_light, 1.0 - normal.z, diffuse)


def single_scattering(mu: Values, mu0: Values, cos_g: Values, depth: Values, asymmetry: Values) -> Values:
    """Single-scattering radiance of a plane air layer from below, relative to direct sunlight, up to a factor.

    ``P(g) mu0 / (mu0 - mu) (1 - exp(tau / mu0 - tau / mu))`` with the Henyey-Greenstein phase function P and the
    optical depth tau. mu and mu0 are the sines of the elevations of the direction and of the sun.
    """
    mu, mu0 = larger(mu, MIN_ELEVATION_SINE), larger(mu0, MIN_ELEVATION_SINE)
    # the limit for equal elevations avoids 0 / 0
    difference = depth / mu - depth / mu0
    path = dr.select(dr.abs(difference) < 1e-6, 1.0 - 0.5 * difference, (1.0 - dr.exp(-difference)) / difference)
    return henyey_greenstein(cos_g, asymmetry) * path * depth / mu


def henyey_greenstein(cos_g: Values, asymmetry: Values) -> Values:
    """Phase function of scattering by an angle from the direction of the light, relative to isotropic scattering."""
    base = 1.0 + asymmetry**2 - 2.0 * asymmetry * cos_g
    return (1.0 - asymmetry**2) / (base * dr.sqrt(base))


@dataclass(frozen=True, eq=False)
class Sky:
    """Radiance factor of a uniform sky (`scattering` is None), or a dusty layer.

    - diffuse: radiance factor of a uniform sky, or of a layer of infinite depth by multiple scattering
    - scattering, depth, asymmetry: factor of the singly scattered light, optical depth, and asymmetry of the layer
    """

    diffuse: Values
    scattering: Values | None
    depth: Values
    asymmetry: Values

    def radiance(self, sun_z: Values, sun_radius: Values, mu: Values, cos_g: Values, pixel_rad: Values) -> Values:
        """Radiance factor in a direction; a dusty sky includes the disc of the sun.

        - sun_z, sun_radius: sine of the sun's elevation, and its angular radius
        - mu, cos_g: sine of the direction's elevation, and cosine of its angle from the sun
        - pixel_rad: angle that the pixel subtends, radians: the width of the disc's edge
        """
        if self.scattering is None:
            return self.diffuse
        layer = 1.0 - dr.exp(-self.depth / larger(mu, MIN_ELEVATION_SINE))
        scattered = self.scattering * single_scattering(mu, sun_z, cos_g, self.depth, self.asymmetry)
        angle = dr.acos(clip(cos_g, -1.0, 1.0))
        disc_fraction = clip((sun_radius - angle) / pixel_rad + 0.5, 0.0, 1.0)
        # the radiance factor of the disc is pi / solid angle, 1 / radius**2; the ramp across the edge adds
        # pixel**2 / 12 to the squared radius, on average
        return self.diffuse * layer + scattered + disc_fraction / (sun_radius**2 + pixel_rad**2 / 12.0)


def scattered_moments(sun_z: float, depth: float, asymmetry: float) -> tuple[float, float, float]:
    """Moments of the sky of `single_scattering`.

    Returns the irradiance of level ground divided by pi, ``1 / pi int L mu dOmega``; the mean radiance over the
    hemisphere, ``1 / (2 pi) int L dOmega``; and the horizontal component towards the sun of ``1 / pi int L w dOmega``.
    Midpoint rule with 256 steps in the squared sine of elevation and 256 steps in azimuth over 180 deg (the other half
    is symmetric).
    """
    midpoints = (np.arange(256) + 0.5) / 256
    mu, azimuth = np.sqrt(midpoints)[:, None], np.pi * midpoints
    towards_sun = np.sqrt(1.0 - mu**2) * np.cos(azimuth)
    cos_g = mu * sun_z + towards_sun * np.sqrt(max(1.0 - sun_z**2, 0.0))
    elevations, angles = to_device(Float64, np.repeat(mu, 256)), to_device(Float64, cos_g)
    # the directions have a density proportional to mu
    radiance = to_host(single_scattering(elevations, Float64(sun_z), angles, depth, asymmetry)).reshape(256, 256)
    return float(radiance.mean()), float((0.5 * radiance / mu).mean()), float((radiance * towards_sun / mu).mean())


def add_air_light(
    radiance: Float32[np.ndarray, "pixels"],
    transmission: Float32[np.ndarray, "pixels"],
    directions: Values,
    sun: FloatArray[np.ndarray, "3"],
    albedo: float,
    asymmetry: float,
    ambient: float,
) -> Float32[np.ndarray, "pixels"]:
    """Compute the radiance factors behind dusty air, from those without it.

    - transmission: transmission of the air up to the surface; 1 for the sky
    - directions, sun: unit vectors of the lines of sight on the device, and to the sun, in the same axes
    - albedo, asymmetry: single-scattering albedo, and asymmetry of the phase function
    - ambient: mean light that the air scatters, excluding direct sunlight
    """
    arguments = (Array3f(*sun.tolist()), Float(albedo), Float(asymmetry), Float(ambient))
    return to_host(_blend_with_air(to_device(Float, radiance), to_device(Float, transmission), directions, *arguments))


@compiled
def _blend_with_air(
    radiance: Values, transmission: Values, direction: Values, sun: Values, albedo: Values, g: Values, ambient: Values
) -> Values:
    source = albedo * (0.25 * henyey_greenstein(dr.dot(direction, sun), g) + ambient)
    return dr.lerp(source, radiance, transmission)
