"""Reflectance law, illumination, sky, and texture finer than the terrain's samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Float64

from marsyard.sim.render.kernels.photometry import scattered_irradiance

#: Angular radius of the sun seen from Mars at 1.52 AU, radians (0.35 deg across).
SUN_RADIUS_AT_MARS_RAD = 0.00305


@dataclass(frozen=True)
class Sun:
    """Direct sunlight: unit vector towards the sun in world axes, and half the angle that its disc subtends."""

    direction: Float[np.ndarray, "3"]
    angular_radius_rad: float = SUN_RADIUS_AT_MARS_RAD

    def __post_init__(self) -> None:
        if abs(float(np.linalg.norm(self.direction)) - 1.0) > 1e-9:
            raise ValueError(f"the sun's direction {self.direction} is not a unit vector")
        if not self.angular_radius_rad > 0.0:
            raise ValueError(f"the sun's angular radius is {self.angular_radius_rad} rad; more than 0 is needed")


@dataclass(frozen=True)
class DustySky:
    """A sky that is brighter towards the sun and the horizon, for cameras that see it, with the sun's disc.

    Light scattered once in a plane layer of air (Chandrasekhar 1960, section 7), over the sun's at the ground::

        I/F = (w tau / 4 t) P(g) mu0 / (mu0 - mu) (1 - exp(t / mu0 - t / mu))

    with the Henyey-Greenstein phase function P, optical depth tau, single-scattering albedo w, mean cosine g of the
    scattering angle, and the sines of elevation mu of the view and mu0 of the sun. Light is weakened on its way by
    ``t = (1 - w g**2) tau``: the forward peak, a fraction g**2 of the scattered light, counts as direct sun (Joseph et
    al. 1976). Multiply scattered light is spread evenly, so that all light except that peak gives level ground the
    irradiance `Photometry.sky_share`; where single scattering exceeds that, it is scaled down to it. The ground is lit
    as by an even sky.
    """

    optical_depth: float
    single_scattering_albedo: float
    asymmetry: float

    def __post_init__(self) -> None:
        if not (
            self.optical_depth > 0.0 and 0.0 < self.single_scattering_albedo <= 1.0 and 0.0 <= self.asymmetry < 1.0
        ):
            raise ValueError(
                f"a dusty sky of optical depth {self.optical_depth}, single-scattering albedo "
                f"{self.single_scattering_albedo} and asymmetry {self.asymmetry}; "
                "allowed: above 0, above 0 and at most 1, at least 0 and below 1"
            )

    def coefficients(self, sun_z: float, sky_share: float) -> tuple[float, float, float, float]:
        """Coefficients of `sky_brightness`: even radiance; factor, depth and asymmetry of single scattering."""
        depth = (1.0 - self.single_scattering_albedo * self.asymmetry**2) * self.optical_depth
        scale = self.single_scattering_albedo * self.optical_depth / (4.0 * depth)
        without_peak = 1.0 - self.asymmetry**2
        once = without_peak * scale * _scattered_irradiance(sun_z, depth, self.asymmetry)
        return max(sky_share - once, 0.0), scale * min(sky_share / once, 1.0), depth, self.asymmetry


@dataclass(frozen=True)
class Photometry:
    """A Lunar-Lambert surface with an opposition surge, under direct sun, an even sky and light from the ground around.

    Radiance factor (I/F) of ground of albedo A under incidence i, emission e, phase angle g::

        I/F = A K S(g) [2 L cos i / (cos i + cos e) + (1 - L) cos i] + A D (1 + n_z) / 2 + A B (1 - n_z) / 2
        S(g) = 1 + B0 / (1 + tan(g / 2) / h)

    The Lunar-Lambert law is that of McEwen (1991); the surge has the form of Hapke's shadow-hiding term (1986). K makes
    A the spherical albedo of the law: the fraction of isotropic light that a surface reflects. The law is reciprocal.

    - lunar_fraction: L, between 0 (Lambert) and 1 (Lommel-Seeliger). About 0.55 for Mars at small phase (McEwen 1991)
    - surge_amplitude, surge_width: B0 and h
    - sky_share: D, diffuse irradiance from the sky over the direct sun's on a plane facing it
    - sky_radiance: radiance factor of an even sky in pixels without ground
    - sky: replaces the even sky there
    - surrounding_albedo: albedo of the ground that scatters light onto slopes and into shadows: B is this times the
      irradiance of level ground
    """

    lunar_fraction: float = 0.55
    surge_amplitude: float = 0.7
    surge_width: float = 0.06
    sky_share: float = 0.15
    sky_radiance: float = 0.1
    surrounding_albedo: float = 0.2
    sky: DustySky | None = None

    def normalisation(self) -> float:
        """Compute K of the law."""
        return 1.0 / _spherical_albedo(self.lunar_fraction, self.surge_amplitude, self.surge_width)

    def law(self, sun: Sun, caster_diameter_m: float) -> Float64[np.ndarray, "8"]:
        """Coefficients of the reflectance kernel, in its order."""
        bounced = self.surrounding_albedo * (max(float(sun.direction[2]), 0.0) + self.sky_share)
        law = (self.lunar_fraction, self.surge_amplitude, self.surge_width, self.normalisation())
        return np.array([*law, self.sky_share, bounced, caster_diameter_m, sun.angular_radius_rad])

    def sky_coefficients(self, sun: Sun) -> Float64[np.ndarray, "4"]:
        """Coefficients of the sky kernel."""
        if self.sky is None:
            return np.array([self.sky_radiance, 0.0, 0.0, 0.0])
        return np.array(self.sky.coefficients(float(sun.direction[2]), self.sky_share))


@dataclass(frozen=True)
class Texture:
    """Albedo finer than the terrain's samples: octaves of three-dimensional noise, evaluated per pixel.

    - coarsest_m: size of the coarsest octave's cells; each further octave is half as large
    - amplitudes: amplitude of each octave in the natural logarithm of albedo, coarsest first
    """

    coarsest_m: float = 1.0
    amplitudes: tuple[float, ...] = ()

    def arrays(self) -> tuple[float, Float64[np.ndarray, "octaves"]]:
        """Arguments of the texture kernel."""
        return float(self.coarsest_m), np.asarray(self.amplitudes, dtype=np.float64)


_scattered_irradiance = cache(scattered_irradiance)


@cache
def _spherical_albedo(lunar_fraction: float, surge_amplitude: float, surge_width: float) -> float:
    """Spherical albedo of the law with A = K = 1, by Gauss-Legendre quadrature over incidence, emission and azimuth.

    ``2 int_0^1 [(1 / pi) int I/F cos e dOmega_e / cos i] cos i d(cos i)``. The substitution phi = pi s^3 samples the
    surge's narrow peak densely.
    """
    nodes, weights = np.polynomial.legendre.leggauss(96)
    mu, mu_weights = 0.5 * (nodes + 1.0), 0.5 * weights
    phi, phi_weights = np.pi * mu**3, 3.0 * np.pi * mu**2 * mu_weights
    cos_i, cos_e, azimuth = mu[:, None, None], mu[None, :, None], phi[None, None, :]
    cos_g = cos_i * cos_e + np.sqrt((1.0 - cos_i**2) * (1.0 - cos_e**2)) * np.cos(azimuth)
    tan_half = np.sqrt(np.clip(1.0 - cos_g, 0.0, None) / (1.0 + cos_g))
    surge = 1.0 + surge_amplitude / (1.0 + tan_half / surge_width)
    radiance = surge * (2.0 * lunar_fraction * cos_i / (cos_i + cos_e) + (1.0 - lunar_fraction) * cos_i)
    # both halves of the azimuth
    flux = 2.0 * np.einsum("ijk,j,k->i", radiance * cos_e, mu_weights, phi_weights) / np.pi
    return float(2.0 * np.sum(flux * mu_weights))
