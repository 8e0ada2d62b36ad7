"""The sun, the dusty sky and its light on surfaces, and dusty air before the ground.

Irradiances are divided by pi. The sky above level ground has the radiance ``D (a + g . w)`` in the direction w.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import numpy as np
from jaxtyping import Float as FloatArray
from jaxtyping import Float32
from scipy.special import expn

from marsyard.sim.render.arrays import Values, clip, compiled, larger, smaller, to_device, to_host
from marsyard.sim.render.device import Array3f, Float, Float64
from marsyard.sim.terrain.environment import MIN_SUN_SINE

#: Angular radius of the sun seen from Mars at 1.52 AU, radians (0.35 deg across).
SUN_RADIUS_AT_MARS_RAD = 0.00305
#: Sine of the elevation below which the sky's brightness is constant.
MIN_ELEVATION_SINE = 1e-3
#: Angular radius of the aureole, a uniform disc around the sun, radians. In the simulation of scattering
#: (`benchmarks.validation.air_checks`) half of its light comes from within 16 to 17 deg, for all suns and depths.
AUREOLE_RADIUS_RAD = 0.42


@dataclass(frozen=True)
class Sun:
    """Direct sunlight: unit vector towards the sun in world axes, and angular radius of its disc."""

    direction: FloatArray[np.ndarray, "3"]
    angular_radius_rad: float = SUN_RADIUS_AT_MARS_RAD

    def __post_init__(self) -> None:
        if abs(float(np.linalg.norm(self.direction)) - 1.0) > 1e-9:
            raise ValueError(f"the sun's direction {self.direction} is not a unit vector")
        if not self.angular_radius_rad > 0.0:
            raise ValueError(f"the sun's angular radius is {self.angular_radius_rad} rad; it must be greater than 0")


@dataclass(frozen=True, eq=False)
class SkyLight:
    """Diffuse light: irradiance D of level ground; radiance a, and its gradient g, of a sky with the irradiance 1."""

    level: Values
    base: Values
    gradient: Values

    @classmethod
    def of(cls, level: float, mean_radiance: float, towards_sun: float, sun: FloatArray[np.ndarray, "3"]) -> SkyLight:
        """Fit the linear sky to moments of a sky with the irradiance 1.

        - mean_radiance: mean of the radiance over the hemisphere; above 1 if the horizon is brighter than the zenith
        - towards_sun: horizontal component, towards the sun, of ``1 / pi int L w d(solid angle)``
        """
        horizontal = sun[:2] / max(float(np.hypot(*sun[:2])), 1e-9)
        # the radiance at the zenith, a + g_z = 1 + g_z / 3, is not negative
        upwards = max(6.0 * (1.0 - mean_radiance), -3.0)
        gradient = [*(1.5 * towards_sun * horizontal).tolist(), upwards]
        return cls(Float(level), Float(1.0 - 2.0 / 3.0 * upwards), Array3f(*gradient))

    def irradiance(self, normal: Values, blocked: Values) -> Values:
        """Irradiance of surfaces with unit normals, of whose sky the vectors `blocked` are hidden.

        Exact for the linear sky above a horizontal horizon: the sky that a surface sees is a lune with the angle pi -
        acos(n_z).
        """
        cosine = clip(normal.z, -1.0, 1.0)
        tilt, sine = dr.acos(cosine) / dr.pi, dr.sqrt(1.0 - cosine * cosine) / dr.pi
        gradient = dr.fma(1.0 - tilt, dr.dot(self.gradient, normal), sine * self.gradient.z)
        visible = dr.fma(0.5 * self.base, 1.0 + cosine, 2.0 / 3.0 * gradient)
        direction = blocked / larger(dr.norm(blocked), 1e-6)
        radiance = larger(self.base + dr.dot(self.gradient, direction), 0.0)
        return self.level * larger(dr.fma(-radiance, larger(dr.dot(normal, blocked), 0.0), visible), 0.0)


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


def disc_above(offset: Values) -> Values:
    """Fraction of a disc above a straight line `offset` radii below its centre."""
    offset = clip(offset, -1.0, 1.0)
    return 0.5 + (offset * dr.sqrt(1.0 - offset * offset) + dr.asin(offset)) / dr.pi


def disc_overlap(first: Values, second: Values, distance: Values) -> Values:
    """Fraction of the second disc that the first disc covers, from their radii and the distance of their centres."""
    alpha = dr.acos(clip((distance**2 + first**2 - second**2) / (2.0 * distance * first), -1.0, 1.0))
    beta = dr.acos(clip((distance**2 + second**2 - first**2) / (2.0 * distance * second), -1.0, 1.0))
    lens = first**2 * (alpha - 0.5 * dr.sin(2.0 * alpha)) + second**2 * (beta - 0.5 * dr.sin(2.0 * beta))
    is_inside = distance <= dr.abs(first - second)
    fraction = dr.select(is_inside, smaller((first / second) ** 2, 1.0), lens / (dr.pi * second**2))
    return dr.select(distance >= first + second, 0.0, fraction)


def single_scattering(mu: Values, mu0: Values, cos_g: Values, depth: Values, asymmetry: Values) -> Values:
    """Single-scattering radiance of a plane air layer from below, relative to direct sunlight, up to a factor.

    ``P(g) mu0 / (mu0 - mu) (1 - exp(tau / mu0 - tau / mu))`` with the Henyey-Greenstein phase function P and the
    optical depth tau. mu and mu0 are the sines of the elevations of the direction and of the sun; at a lower sun than
    that of `MIN_SUN_SINE`, direct sunlight is so weak that the ratio would overflow.
    """
    mu, mu0 = larger(mu, MIN_ELEVATION_SINE), larger(mu0, MIN_SUN_SINE)
    # the limit for equal elevations avoids 0 / 0
    difference = depth / mu - depth / mu0
    path = dr.select(dr.abs(difference) < 1e-6, 1.0 - 0.5 * difference, (1.0 - dr.exp(-difference)) / difference)
    return henyey_greenstein(cos_g, asymmetry) * path * depth / mu


def henyey_greenstein(cos_g: Values, asymmetry: Values) -> Values:
    """Phase function of scattering by an angle from the direction of the light, relative to isotropic scattering."""
    base = 1.0 + asymmetry**2 - 2.0 * asymmetry * cos_g
    return (1.0 - asymmetry**2) / (base * dr.sqrt(base))


@cache
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


@dataclass(frozen=True)
class DustySky:
    """Brightness of a dusty sky: brighter towards the sun and the horizon, with the disc of the sun.

    Radiance by single scattering in a plane layer of air (Chandrasekhar 1960, section 7), relative to direct sunlight
    at the ground::

        I/F = (w tau / 4 t) P(g) mu0 / (mu0 - mu) (1 - exp(t / mu0 - t / mu))

    with the Henyey-Greenstein phase function P, optical depth tau, single-scattering albedo w, mean cosine g of the
    scattering angle, and the sines of elevation mu of the view and mu0 of the sun. The extinction depth is
    ``t = (1 - w g**2) tau``: the forward peak, a fraction g**2 of the scattered light, is part of the direct sunlight
    (Joseph et al. 1976), in which it is the aureole around the disc. Light scattered several times is isotropic: it
    adds ``J (1 - exp(-t / mu))``, so that the irradiance of level ground without the peak is `Photometry.sky_fraction`.
    If single scattering exceeds this irradiance, it is scaled down.
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

    @property
    def depth(self) -> float:
        """Extinction depth t."""
        return (1.0 - self.single_scattering_albedo * self.asymmetry**2) * self.optical_depth

    def disc_fraction(self, sun_z: float) -> float:
        """Fraction of direct sunlight that comes from the sun's disc; the rest comes from the aureole."""
        return float(np.exp((self.depth - self.optical_depth) / max(sun_z, MIN_SUN_SINE)))

    def model(self, sun_z: float, sky_fraction: float) -> Sky:
        """Return the sky whose irradiance without the forward peak is `sky_fraction`."""
        scale = self.single_scattering_albedo * self.optical_depth / (4.0 * self.depth)
        scattered = self._scattered_irradiance(sun_z)
        multiple = max(sky_fraction - scattered, 0.0) / (1.0 - 2.0 * float(expn(3, self.depth)))
        return Sky(*map(Float64, (multiple, scale * min(sky_fraction / scattered, 1.0), self.depth, self.asymmetry)))

    def light(self, sun: Sun, sky_fraction: float) -> SkyLight:
        """Return the light of the sky without the forward peak, which is part of the direct sunlight.

        Without the peak, the phase function has the asymmetry ``g / (1 + g)``.
        """
        sun_z, t = float(sun.direction[2]), self.depth
        if sky_fraction == 0.0:
            return SkyLight.of(0.0, 1.0, 0.0, sun.direction)
        irradiance, mean, towards_sun = scattered_moments(sun_z, t, self.asymmetry / (1.0 + self.asymmetry))
        single = min(self._scattered_irradiance(sun_z) / sky_fraction, 1.0)
        # irradiance and mean radiance of the isotropic layer are J (1 - 2 E_3) and J (1 - E_2)
        layer_mean = float((1.0 - expn(2, t)) / (1.0 - 2.0 * expn(3, t)))
        mean_radiance = single * mean / irradiance + (1.0 - single) * layer_mean
        return SkyLight.of(sky_fraction, mean_radiance, single * towards_sun / irradiance, sun.direction)

    def _scattered_irradiance(self, sun_z: float) -> float:
        """Irradiance of level ground by single scattering without the forward peak."""
        scale = self.single_scattering_albedo * self.optical_depth / (4.0 * self.depth)
        return (1.0 - self.asymmetry**2) * scale * scattered_moments(sun_z, self.depth, self.asymmetry)[0]


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
