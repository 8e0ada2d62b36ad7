"""Reflectance law, illumination, sky, clouds, and texture finer than the terrain's samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float as FloatArray
from jaxtyping import Float32
from pydantic import Field
from scipy.ndimage import map_coordinates
from scipy.special import expn, ndtri

from marsyard.sim.parameters import Parameters
from marsyard.sim.render.device import Float, Float64
from marsyard.sim.render.reflectance import Law, Sky, scattered_moments
from marsyard.sim.render.skylight import SkyLight
from marsyard.sim.render.sunlight import Clouds, Grid
from marsyard.sim.render.texture import Octaves

#: Angular radius of the sun seen from Mars at 1.52 AU, radians (0.35 deg across).
SUN_RADIUS_AT_MARS_RAD = 0.00305


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


@dataclass(frozen=True)
class DustySky:
    """Brightness of a dusty sky: brighter towards the sun and the horizon, with the disc of the sun.

    Radiance by single scattering in a plane layer of air (Chandrasekhar 1960, section 7), relative to direct sunlight
    at the ground::

        I/F = (w tau / 4 t) P(g) mu0 / (mu0 - mu) (1 - exp(t / mu0 - t / mu))

    with the Henyey-Greenstein phase function P, optical depth tau, single-scattering albedo w, mean cosine g of the
    scattering angle, and the sines of elevation mu of the view and mu0 of the sun. The extinction depth is
    ``t = (1 - w g**2) tau``: the forward peak, a fraction g**2 of the scattered light, is part of the direct sunlight
    (Joseph et al. 1976). Light scattered several times is isotropic: it adds ``J (1 - exp(-t / mu))``, so that the
    irradiance of level ground without the peak is `Photometry.sky_fraction`. If single scattering exceeds this
    irradiance, it is scaled down.
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
        irradiance, mean, towards_sun = _scattered_moments(sun_z, t, self.asymmetry / (1.0 + self.asymmetry))
        single = min(self._scattered_irradiance(sun_z) / sky_fraction, 1.0)
        # irradiance and mean radiance of the isotropic layer are J (1 - 2 E_3) and J (1 - E_2)
        layer_mean = float((1.0 - expn(2, t)) / (1.0 - 2.0 * expn(3, t)))
        mean_radiance = single * mean / irradiance + (1.0 - single) * layer_mean
        return SkyLight.of(sky_fraction, mean_radiance, single * towards_sun / irradiance, sun.direction)

    def _scattered_irradiance(self, sun_z: float) -> float:
        """Irradiance of level ground by single scattering without the forward peak."""
        scale = self.single_scattering_albedo * self.optical_depth / (4.0 * self.depth)
        return (1.0 - self.asymmetry**2) * scale * _scattered_moments(sun_z, self.depth, self.asymmetry)[0]


@dataclass(frozen=True)
class Photometry:
    """A Lunar-Lambert surface with an opposition surge, under direct sunlight, light from the sky and from the ground.

    Radiance factor (I/F) of ground with albedo A, incidence angle i, emission angle e and phase angle g::

        I/F = A K S(g) [2 L cos i / (cos i + cos e) + (1 - L) cos i] + A D (1 + n_z) / 2 + A B (1 - n_z) / 2
        S(g) = 1 + B0 / (1 + tan(g / 2) / h)

    The Lunar-Lambert law is from McEwen (1991); the surge has the form of Hapke's shadow-hiding term (1986). K
    normalises the law so that A is its spherical albedo, the reflected fraction of isotropic light. The law is
    reciprocal. The term of D is that of a uniform sky without obstructions; see `skylight` for others.

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
        law = (self.lunar_fraction, self.surge_amplitude, self.surge_width, self.normalisation(), ground_light)
        lunar_fraction, amplitude, width, normalisation, from_ground = map(Float, law)
        return Law(lunar_fraction, amplitude, width, normalisation, from_ground, sky_light)

    def sky_model(self, sun: Sun) -> Sky:
        """Return the sky in pixels without ground."""
        if self.sky is None:
            return Sky(Float64(self.sky_radiance), None, Float64(0.0), Float64(0.0))
        return self.sky.model(float(sun.direction[2]), self.sky_fraction)


@dataclass(frozen=True)
class Texture:
    """Albedo variation finer than the terrain's samples: octaves of three-dimensional noise, evaluated per pixel.

    - coarsest_m: size of the coarsest octave's cells; each further octave is half as large
    - amplitudes: amplitude of each octave in the natural logarithm of albedo, coarsest first
    """

    coarsest_m: float = 1.0
    amplitudes: tuple[float, ...] = ()

    @property
    def octaves(self) -> Octaves:
        """The octaves on the device."""
        return Octaves.of(self.coarsest_m, self.amplitudes)


_scattered_moments = cache(scattered_moments)


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


#: Cells along each side of the periodic layer, and its period divided by the mean cloud size.
CELLS, PERIOD_SIZES = 1024, 32.0
#: Relative lengths and variances of the field's octaves; the fine octaves give the clouds irregular outlines.
OCTAVES = ((1.0, 1.0), (0.5, 1.0 / 16.0), (0.25, 1.0 / 256.0))


class CloudParameters(Parameters):
    """Fair-weather clouds. The defaults are small cumuli over a desert at noon; they are assumed, not from a paper."""

    base_m: Annotated[float, Field(gt=0.0, le=20000.0, description="height of the layer above the ground, m")] = 2500.0
    cover: Annotated[float, Field(ge=0.0, le=0.9, description="fraction of the ground in the clouds' shadows")] = 0.3
    size_m: Annotated[
        float, Field(ge=50.0, le=10000.0, description="mean chord length of a cloud along a horizontal line, m")
    ] = 800.0
    edge_m: Annotated[
        float, Field(ge=0.0, le=1000.0, description="RMS width of a shadow's edge, including the penumbra, m")
    ] = 40.0
    optical_depth: Annotated[float, Field(ge=0.0, le=100.0, description="vertical optical depth of a cloud")] = 10.0
    asymmetry: Annotated[float, Field(ge=0.0, lt=1.0, description="mean cosine of the scattering angle")] = 0.85
    wind_east_m_s: Annotated[float, Field(ge=-100.0, le=100.0, description="drift to the east, m/s")] = 6.0
    wind_north_m_s: Annotated[float, Field(ge=-100.0, le=100.0, description="drift to the north, m/s")] = 3.0

    def direct_transmittance(self, sun: Sun) -> float:
        """Fraction of direct sunlight behind a cloud: ``exp(-tau / sin elevation)``; 0 for a sun below the horizon."""
        up = float(sun.direction[2])
        return float(np.exp(-self.optical_depth / up)) if up > 0.0 else 0.0

    def sky_light(self, sun: Sun) -> float:
        """Irradiance scattered down by the clouds, divided by that of direct sunlight on a plane facing the sun.

        The transmittance of a cloud without absorption is ``2 / (2 + (1 - g) tau)`` (two-stream approximation; Bohren,
        Am. J. Phys. 55, 1987). It includes the unscattered `direct_transmittance`. The scattered light is assumed to be
        uniform over the ground, because the height of the clouds is similar to their distances.
        """
        transmittance = 2.0 / (2.0 + (1.0 - self.asymmetry) * self.optical_depth)
        scattered = max(transmittance - self.direct_transmittance(sun), 0.0)
        return self.cover * scattered * max(float(sun.direction[2]), 0.0)


@dataclass(frozen=True)
class CloudLayer:
    """One realisation of the clouds: a thin, periodic layer of constant shape that drifts with the wind.

    A cloud between a point and the sun attenuates direct sunlight. Skylight increases by the light that all clouds
    scatter down. The clouds are not visible in images from above the layer or of the sky. The layer has no thickness,
    so the cover does not depend on the sun's elevation.

    - height_m: height of the layer above z = 0
    - cover: cloud fraction of each cell; y increases with the row, and cells are `cell_m` apart
    """

    parameters: CloudParameters
    height_m: float
    cover: Float32[np.ndarray, "rows columns"]

    @classmethod
    def draw(cls, parameters: CloudParameters, rng: np.random.Generator, *, ground_m: float = 0.0) -> CloudLayer:
        """Generate a random layer at `base_m` above ground with the mean height `ground_m`.

        Clouds are the regions where a Gaussian random field with three octaves exceeds a threshold; the threshold is
        set by `cover`. The number of clouds per metre along a line is ``sqrt(m2) exp(-u**2 / 2) / 2 pi`` (Rice 1944)
        with the threshold u and the mean square slope m2 of the field, both for a standard deviation of 1. This
        determines the length of the octaves for the mean chord `size_m`. A Gaussian filter smooths the edges.
        """
        noise = np.fft.rfft2(rng.standard_normal((CELLS, CELLS)))
        if parameters.cover == 0.0:
            return cls(parameters, ground_m + parameters.base_m, np.zeros((CELLS, CELLS), dtype=np.float32))
        # squared wavenumbers of the real transform's terms, rad2/m2
        spacing = parameters.size_m * PERIOD_SIZES / CELLS
        y, x = 2.0 * np.pi * np.fft.fftfreq(CELLS, spacing), 2.0 * np.pi * np.fft.rfftfreq(CELLS, spacing)
        squared_k = y[:, None] ** 2 + x**2
        threshold = float(ndtri(1.0 - parameters.cover))
        total_variance = sum(variance for _, variance in OCTAVES)
        mean_square_slope = sum(variance / (2.0 * scale**2) for scale, variance in OCTAVES) / total_variance
        length = parameters.size_m * np.sqrt(mean_square_slope) * np.exp(-0.5 * threshold**2)
        length /= 2.0 * np.pi * parameters.cover
        power = sum(
            variance * (scale * length) ** 2 * np.exp(-squared_k * (scale * length) ** 2) for scale, variance in OCTAVES
        )
        field = np.fft.irfft2(noise * np.sqrt(power), s=(CELLS, CELLS))
        excess = field - np.quantile(field, 1.0 - parameters.cover)
        # cloud fraction of a cell at an outline, by linear interpolation
        slope = np.hypot(*(0.5 * (np.roll(excess, -1, k) - np.roll(excess, 1, k)) for k in (0, 1)))
        cloud_fraction = np.clip(0.5 + excess / np.maximum(slope, 1e-12), 0.0, 1.0)
        smoothed = np.fft.irfft2(
            np.fft.rfft2(cloud_fraction) * np.exp(-0.5 * squared_k * parameters.edge_m**2), s=(CELLS, CELLS)
        )
        return cls(parameters, ground_m + parameters.base_m, np.clip(smoothed, 0.0, 1.0).astype(np.float32))

    @property
    def cell_m(self) -> float:
        """Distance between cell centres, metres."""
        return self.parameters.size_m * PERIOD_SIZES / CELLS

    def at_time(self, sun: Sun, time_s: float) -> Clouds:
        """Return the clouds at their positions at a time."""
        p = self.parameters
        numbers = (self.height_m, p.wind_east_m_s * time_s, p.wind_north_m_s * time_s, p.direct_transmittance(sun))
        height, east, north, transmittance = map(Float64, numbers)
        return Clouds(self._cover_grid, height, east, north, 1.0 - transmittance)

    @cached_property
    def _cover_grid(self) -> Grid:
        return Grid.of(self.cover, 1.0 / self.cell_m)

    def transmittance(
        self, points: FloatArray[np.ndarray, "*batch 3"], sun: Sun, time_s: float
    ) -> FloatArray[np.ndarray, "*batch"]:
        """Fraction of direct sunlight that reaches world points (metres) through the layer; NaN for NaN points.

        Ground truth of an image: ``clouds.transmittance(frame.points_world(), scene.sun, time_s)``.
        """
        p, direction = self.parameters, np.asarray(sun.direction, dtype=np.float64)
        opacity = 1.0 - p.direct_transmittance(sun)
        distance = np.maximum(self.height_m - points[..., 2], 0.0) / direction[2]
        drifts = ((0, p.wind_east_m_s * time_s), (1, p.wind_north_m_s * time_s))
        x, y = ((points[..., k] + distance * direction[k] - drift) / self.cell_m for k, drift in drifts)
        is_finite = np.isfinite(x) & np.isfinite(y)
        cells = np.where(is_finite, np.stack([y, x]), 0.0)
        cover = map_coordinates(self.cover.astype(np.float64), cells, order=1, mode="grid-wrap")
        return np.asarray(np.where(is_finite, 1.0 - opacity * cover, np.nan))
