"""The reflectance law of ground and objects under sun and sky."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import numpy as np

from marsyard.sim.render.arrays import Values, clip, larger, smaller
from marsyard.sim.render.device import Array3f, Float, Float64
from marsyard.sim.render.sky import DustySky, Sky, SkyLight, Sun


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

    def radiance(self, angles: Angles, normal: Values, sunlight: Values, blocked: Values) -> Values:
        """Compute the radiance factor of a surface with albedo 1, which receives a fraction of the direct sunlight.

        `blocked` are the vectors of the hidden sky (`obstructions`). Ground below a body that hides the sky is dark; it
        reflects less light by the same fraction.
        """
        cos_i, lunar = angles.cos_i, self.lunar_fraction
        surge = 1.0 + self.surge_amplitude / (1.0 + angles.tan_half_g / self.surge_width)
        disc = 2.0 * lunar * cos_i / (cos_i + angles.cos_e) + (1.0 - lunar) * cos_i
        direct = dr.select(cos_i > 0.0, sunlight * self.normalisation * surge * disc, 0.0)
        diffuse = self.sky_light.irradiance(normal, blocked)
        ground_light = 0.5 * self.ground_light * (1.0 - smaller(blocked.z, 1.0))
        return direct + dr.fma(ground_light, 1.0 - normal.z, diffuse)


@dataclass(frozen=True)
class Photometry:
    """A Lunar-Lambert surface with an opposition surge, under direct sunlight, light from the sky and from the ground.

    Radiance factor (I/F) of ground with albedo A, incidence angle i, emission angle e and phase angle g::

        I/F = A K S(g) [2 L cos i / (cos i + cos e) + (1 - L) cos i] + A D (1 + n_z) / 2 + A B (1 - n_z) / 2
        S(g) = 1 + B0 / (1 + tan(g / 2) / h)

    The Lunar-Lambert law is from McEwen (1991); the surge has the form of Hapke's shadow-hiding term (1986). K
    normalises the law so that A is its spherical albedo, the reflected fraction of isotropic light. The law is
    reciprocal. The term of D is that of a uniform sky without obstructions; see `sky` and `obstructions` for others.

    - lunar_fraction: L, between 0 (Lambert) and 1 (Lommel-Seeliger). About 0.55 for Mars at small phase (McEwen 1991)
    - surge_amplitude, surge_width: B0 and h
    - sky_fraction: D, diffuse irradiance from the sky divided by that of direct sunlight on a plane facing the sun
    - sky_radiance: radiance factor of a uniform sky in pixels without ground
    - sky: model that replaces the uniform sky in these pixels, and its light on surfaces
    - surrounding_albedo: albedo of the ground that scatters light onto slopes and into shadows; B is this albedo times
      the irradiance of level ground
    """

    lunar_fraction: float = 0.55
    surge_amplitude: float = 0.7
    surge_width: float = 0.06
    sky_fraction: float = 0.15
    sky_radiance: float = 0.1
    surrounding_albedo: float = 0.2
    sky: DustySky | None = None

    def normalisation(self) -> float:
        """Compute K of the law."""
        return 1.0 / _spherical_albedo(self.lunar_fraction, self.surge_amplitude, self.surge_width)

    def law(self, sun: Sun) -> Law:
        """Return the reflectance law under a sun."""
        ground_light = self.surrounding_albedo * (max(float(sun.direction[2]), 0.0) + self.sky_fraction)
        if self.sky is None:
            sky_light = SkyLight.of(self.sky_fraction, 1.0, 0.0, sun.direction)
        else:
            sky_light = self.sky.light(sun, self.sky_fraction)
        return Law(
            lunar_fraction=Float(self.lunar_fraction),
            surge_amplitude=Float(self.surge_amplitude),
            surge_width=Float(self.surge_width),
            normalisation=Float(self.normalisation()),
            ground_light=Float(ground_light),
            sky_light=sky_light,
        )

    def disc_fraction(self, sun: Sun) -> float:
        """Fraction of direct sunlight that comes from the sun's disc; 1 under a uniform sky, which has no aureole."""
        return 1.0 if self.sky is None else self.sky.disc_fraction(float(sun.direction[2]))

    def sky_model(self, sun: Sun) -> Sky:
        """Return the sky in pixels without ground."""
        if self.sky is None:
            return Sky(Float64(self.sky_radiance), None, Float64(0.0), Float64(0.0))
        return self.sky.model(float(sun.direction[2]), self.sky_fraction)


@cache
def _spherical_albedo(lunar_fraction: float, surge_amplitude: float, surge_width: float) -> float:
    """Spherical albedo of the law with A = K = 1, by Gauss-Legendre quadrature over incidence, emission and azimuth.

    ``2 int_0^1 [(1 / pi) int I/F cos e dOmega_e / cos i] cos i d(cos i)``. The substitution phi = pi s^3 gives dense
    nodes at the surge's narrow peak.
    """
    nodes, weights = np.polynomial.legendre.leggauss(96)
    mu, mu_weights = 0.5 * (nodes + 1.0), 0.5 * weights
    phi, phi_weights = np.pi * mu**3, 3.0 * np.pi * mu**2 * mu_weights
    cos_i, cos_e, azimuth = mu[:, None, None], mu[None, :, None], phi[None, None, :]
    cos_g = cos_i * cos_e + np.sqrt((1.0 - cos_i**2) * (1.0 - cos_e**2)) * np.cos(azimuth)
    tan_half = np.sqrt(np.clip(1.0 - cos_g, 0.0, None) / (1.0 + cos_g))
    surge = 1.0 + surge_amplitude / (1.0 + tan_half / surge_width)
    radiance = surge * (2.0 * lunar_fraction * cos_i / (cos_i + cos_e) + (1.0 - lunar_fraction) * cos_i)
    # the factor 2: both halves of the azimuth
    flux = 2.0 * np.einsum("ijk,j,k->i", radiance * cos_e, mu_weights, phi_weights) / np.pi
    return float(2.0 * np.sum(flux * mu_weights))
