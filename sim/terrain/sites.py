"""Sites: planet and atmosphere, ground reflectance, and terrain parameters at two scales."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from marsyard.sim.parameters import Fraction, Parameters, Positive, bounded_field
from marsyard.sim.terrain.parameters import TerrainParameters

MIN_SUN_SINE = 0.05  #: Lower limit of the sine of the sun's elevation in the plane-parallel atmosphere model.
SUN_RADIUS_AT_1_AU_RAD = 0.00465  #: Angular radius of the sun at 1 AU.


class Environment(Parameters):
    """Gravity, planet rotation, sunlight and dusty atmosphere at a site."""

    planet: Annotated[str, Field(description="name of the planet")] = "Mars"
    gravity_m_s2: Annotated[Positive, Field(description="gravity, m/s2")] = 3.72
    rotation_rad_s: Annotated[float, Field(ge=0.0, description="sidereal rotation rate, rad/s")] = 7.0882e-5
    solar_irradiance: Annotated[Positive, Field(description="solar irradiance relative to that at 1 AU")] = 0.44
    optical_depth: Annotated[float, Field(ge=0.0, le=10.0, description="optical depth of the atmosphere")] = 0.5
    single_scattering_albedo: Annotated[float, Field(ge=0.0, lt=1.0, description="scattering / extinction")] = 0.94
    asymmetry: Annotated[float, Field(gt=-1.0, lt=1.0, description="mean cosine of the scattering angle")] = 0.65
    scale_height_m: Annotated[Positive, Field(description="height over which extinction falls to 1/e, m")] = 11100.0

    @property
    def sun_radius_rad(self) -> float:
        """Angular radius of the sun's disc, proportional to the square root of the irradiance."""
        return float(SUN_RADIUS_AT_1_AU_RAD * np.sqrt(self.solar_irradiance))

    def direct_fraction(self, sun_elevation_rad: float) -> float:
        """Compute the fraction of sunlight on a plane facing the sun, including light scattered by a few degrees.

        ``exp(-tau' / sin elevation)``, where tau' is the optical depth without the forward peak of scattering (delta
        scaling, Joseph et al. 1976).
        """
        return float(np.exp(-self._apply_delta_scaling()[0] / max(np.sin(sun_elevation_rad), MIN_SUN_SINE)))

    def sky_fraction(self, sun_elevation_rad: float, ground_albedo: float = 0.0) -> float:
        """Compute the diffuse irradiance on level ground divided by the direct irradiance on a plane facing the sun.

        Delta-Eddington approximation (Joseph, Wiscombe & Weinman 1976) over ground with an albedo, which reflects light
        to the atmosphere. The value is also the radiance factor of a uniform sky with this irradiance.
        """
        tau, albedo, asymmetry = self._apply_delta_scaling()
        if tau == 0.0:
            return 0.0
        mu = max(float(np.sin(sun_elevation_rad)), MIN_SUN_SINE)
        k = np.sqrt(3.0 * (1.0 - albedo) * (1.0 - albedo * asymmetry))
        if abs(1.0 - k * mu) < 1e-6:
            mu *= 1.0 + 2e-6  # the particular solution is singular at k mu = 1, but the irradiance is continuous
        p = np.sqrt(3.0 * (1.0 - albedo) / (1.0 - albedo * asymmetry))
        # intensity I + I1 cos(angle from the nadir) for a solar flux of pi, particular solution -alpha, -beta
        alpha = 0.75 * albedo * mu**2 * (1.0 + asymmetry * (1.0 - albedo)) / (1.0 - (k * mu) ** 2)
        beta = 0.75 * albedo * mu * (1.0 + 3.0 * asymmetry * (1.0 - albedo) * mu**2) / (1.0 - (k * mu) ** 2)
        # I = C1 e^-kt + C2 e^kt - alpha e^-t/mu, I1 = p (C1 e^-kt - C2 e^kt) - beta e^-t/mu; boundary conditions: no
        # downward diffuse light at the top (I + 2/3 I1 = 0); upward light from ground with the albedo A:
        # I - 2/3 I1 = A (I + 2/3 I1 + mu e^-t/mu)
        two_thirds = 2.0 / 3.0
        direct = np.exp(-tau / mu)
        plus, minus = 1.0 + two_thirds * p, 1.0 - two_thirds * p
        a = ground_albedo
        at_ground = [(minus - a * plus) * np.exp(-k * tau), (plus - a * minus) * np.exp(k * tau)]
        source = alpha - two_thirds * beta - a * (alpha + two_thirds * beta - mu)
        c1, c2 = np.linalg.solve(np.array([[plus, minus], at_ground]), [alpha + two_thirds * beta, source * direct])
        i0 = c1 * np.exp(-k * tau) + c2 * np.exp(k * tau) - alpha * direct
        i1 = p * (c1 * np.exp(-k * tau) - c2 * np.exp(k * tau)) - beta * direct
        return float(max(i0 + two_thirds * i1, 0.0) / direct)

    def mean_extinction_m(self, height_m: float) -> float:
        """Return the mean extinction coefficient between the ground and a height above it, 1/m."""
        height_m = max(height_m, 1.0)
        return float(-self.optical_depth * np.expm1(-height_m / self.scale_height_m) / height_m)

    def _apply_delta_scaling(self) -> tuple[float, float, float]:
        """Compute optical depth, single-scattering albedo and asymmetry g without the forward peak (fraction g**2)."""
        peak = self.asymmetry**2
        remainder = 1.0 - self.single_scattering_albedo * peak
        albedo = self.single_scattering_albedo * (1.0 - peak) / remainder
        return self.optical_depth * remainder, albedo, self.asymmetry / (1.0 + self.asymmetry)


class SitePhotometry(Parameters):
    """Parameters of the Lunar-Lambert law with an opposition surge; see `marsyard.sim.render.Photometry`."""

    lunar_fraction: Annotated[float, Field(ge=0.0, le=1.0, description="L: 0 Lambert, 1 Lommel-Seeliger")] = 0.55
    surge_amplitude: Annotated[float, Field(ge=0.0, le=3.0, description="B0: amplitude of the surge")] = 0.7
    surge_width: Annotated[float, Field(gt=0.0, le=1.0, description="h: angular width of the surge")] = 0.06
    rock_albedo: Annotated[float, Field(gt=0.0, lt=1.0, description="albedo of rocks")] = 0.15
    dust_albedo: Annotated[float, Field(gt=0.0, lt=1.0, description="albedo of dust on rocks")] = 0.3
    dust_cover: Annotated[Fraction, Field(description="fraction of level faces of rocks that dust covers")] = 0.0
    source: Annotated[str, Field(description="source of these values")] = "assumed"


class PhotometryChanges(Parameters):
    """Changes of a site's photometry (`SitePhotometry`)."""

    lunar_fraction: Annotated[
        float | None, Field(ge=0.0, le=1.0, description="L: 0 Lambert, 1 Lommel-Seeliger; default: the site's")
    ] = None
    surge_amplitude: Annotated[
        float | None, Field(ge=0.0, le=3.0, description="B0: amplitude of the surge; default: the site's")
    ] = None


class SiteTexture(Parameters):
    """Albedo variation finer than the terrain's samples: octaves of noise in the natural logarithm of albedo.

    The coarsest octave is the first; the cell size is halved with each octave.
    """

    coarsest_m: Annotated[Positive, Field(description="size of the coarsest octave's cells, m")]
    amplitudes: Annotated[tuple[float, ...], Field(description="amplitude of each octave")]


class SitePebbles(Parameters):
    """Pebbles and granules that are too many and too small for triangles.

    All octaves of the diameter cover the same fraction of the ground: the number of pebbles larger than D is in
    proportion to D**-2, as for fragmented rock (Turcotte 1997). The law of Golombek & Rapp (1997), with an exponent of
    -1 at these sizes, was fitted to rocks above 3 cm.
    """

    coverage: Annotated[float, bounded_field(0.0, 0.4, "fraction of the ground that pebbles cover")]
    largest_m: Annotated[Positive, Field(description="largest diameter, m")] = 0.02
    smallest_m: Annotated[Positive, Field(description="smallest diameter, m")] = 0.002
    height_ratio: Annotated[float, bounded_field(0.05, 1.0, "height divided by diameter; assumed")] = 0.4
    log_albedo: Annotated[float, bounded_field(-1.5, 1.5, "mean logarithm of albedo divided by the ground's")] = 0.0
    log_albedo_sd: Annotated[float, bounded_field(0.0, 1.0, "standard deviation of this logarithm; assumed")] = 0.2


class Hill(Parameters):
    """A hill on the horizon of a site; the direction is that from the origin of the site's terrain."""

    azimuth_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth of its middle, clockwise from north")]
    distance_m: Annotated[Positive, Field(description="distance of its middle, m")]
    width_m: Annotated[Positive, Field(description="width across the line of sight, m")]
    depth_m: Annotated[Positive, Field(description="extent along the line of sight, m")]
    height_m: Annotated[Positive, Field(description="height above the plain, m")]


class Site(Parameters):
    """A site with its environment, photometry and terrain.

    `descent` is the terrain for images of a descent (spacing of metres over kilometres). `ground` is the terrain for
    images of a rover or a helicopter (spacing of centimetres over 100-200 m). A site has at least one of them. Pebbles
    are visible at the scale of the ground only.
    """

    name: str
    description: str
    environment: Environment
    photometry: SitePhotometry = SitePhotometry()
    ground_texture: SiteTexture
    rock_texture: SiteTexture
    pebbles: SitePebbles | None = None
    descent: TerrainParameters | None = None
    ground: TerrainParameters | None = None
    hills: tuple[Hill, ...] = ()

    def with_dust(self, optical_depth: float | None) -> Site:
        """Return the site with another optical depth of the atmosphere; None: no change."""
        if optical_depth is None:
            return self
        environment = self.environment.model_copy(update={"optical_depth": optical_depth})
        return self.model_copy(update={"environment": environment})

    def with_photometry(self, changes: PhotometryChanges) -> Site:
        """Return the site with another reflectance law of ground and rocks."""
        photometry = self.photometry.model_copy(update=changes.model_dump(exclude_none=True))
        return self.model_copy(update={"photometry": photometry})

    def terrain(self, scale: str | None = None, changes: Mapping[str, Any] | None = None) -> TerrainParameters:
        """Return the terrain parameters at a scale, 'descent' or 'ground'; the default is the coarsest scale.

        `changes` are those of `TerrainParameters.with_changes`, for example fewer samples, or a DTM as `source`. Raises
        ValueError if the site has no terrain at this scale, or a change is invalid.
        """
        if scale not in (None, "descent", "ground"):
            raise ValueError(f"'{scale}' is not a valid scale of terrain; allowed: descent, ground")
        terrain = (self.descent or self.ground) if scale is None else getattr(self, scale)
        if not isinstance(terrain, TerrainParameters):
            raise ValueError(f"site {self.name} has no terrain at the scale '{scale}'")
        return terrain.with_changes(changes) if changes else terrain


@dataclass(frozen=True)
class PaperFigures:
    """Published values of a site: minimum and maximum; slopes are those for baselines of 30 m and 90 m."""

    albedo: tuple[float, float]
    mean_slope_deg: tuple[float, float]
    relief_m: tuple[float, float] | None
    contrast: str


_MER_SITE = PaperFigures((0.1, 0.3), (1.0, 2.0), None, "MOC: a lower limit, seen through dust")
#: DIMES field test paper, section III.A; it contains common values for the MER landing sites.
PAPER: dict[str, PaperFigures] = {
    "pisgah": PaperFigures((0.1, 0.1), (2.0, 3.0), None, "very little; like synthesised images of most MER sites"),
    "kelso": PaperFigures((0.5, 0.5), (2.0, 3.0), (200.0, float("inf")), "repetitive"),
    "ivanpah": PaperFigures((0.4, 0.4), (2.0, 3.0), None, "bland; the smoothest of the field sites"),
    "gusev": _MER_SITE,
    "meridiani": _MER_SITE,
}


@cache
def sites() -> dict[str, Site]:
    """Return all sites in ``sites.toml`` by name."""
    tables = tomllib.loads(Path(__file__).with_name("sites.toml").read_text("utf-8"))
    sites_by_name = {}
    for name, entry in tables["sites"].items():
        entry["environment"] = _merge_base(tables["environments"][entry["environment"]], tables["environments"])
        for scale in {"descent", "ground"} & set(entry):
            entry[scale] = _merge_base(entry[scale], tables["grounds"])
        for texture, coarsest_m in (("ground_texture", 3.0), ("rock_texture", 0.2)):
            # cells from `coarsest_m` down to 1 mm; the amplitude of each octave is multiplied by `decay`
            first_amplitude, decay = entry[texture]["amplitude"], entry[texture]["decay"]
            octaves = range(int(np.log2(coarsest_m / 0.001)) + 1)
            amplitudes = tuple(round(first_amplitude * decay**n, 5) for n in octaves)
            entry[texture] = SiteTexture(coarsest_m=coarsest_m, amplitudes=amplitudes)
        sites_by_name[name] = Site(name=name, **entry)
    return sites_by_name


def _merge_base(entry: dict[str, Any], bases: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Merge an entry with the values of its base."""
    values = {key: value for key, value in entry.items() if key != "base"}
    return {**_merge_base(bases[entry["base"]], bases), **values} if "base" in entry else values


def site(name: str) -> Site:
    """Return the site with this name. Raises ValueError if there is none; the message lists the sites."""
    if name not in sites():
        raise ValueError(f"no site is called '{name}'; allowed: {', '.join(sites())}")
    return sites()[name]
