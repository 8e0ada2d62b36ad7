"""Clouds in a thin, periodic layer that drifts with the wind and casts shadows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float as FloatArray
from jaxtyping import Float32
from pydantic import Field
from scipy.ndimage import map_coordinates
from scipy.special import ndtri

from marsyard.sim.parameters import Parameters
from marsyard.sim.render.arrays import Values, larger
from marsyard.sim.render.device import Float, Float64
from marsyard.sim.render.periodic_grid import PeriodicGrid
from marsyard.sim.render.sky import Sun

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


@dataclass(frozen=True, eq=False)
class Clouds:
    """Clouds in a thin layer: cover on a periodic grid, height, displacement to east and north, metres, and opacity."""

    cover: PeriodicGrid
    height: Values
    east: Values
    north: Values
    opacity: Values

    def transmittance(self, position: Values, sun: Values) -> Values:
        """Fraction of direct sunlight that reaches positions through the layer."""
        path = larger(self.height - position.z, 0.0) / sun.z
        x, y = position.x + path * sun.x - self.east, position.y + path * sun.y - self.north
        return Float(1.0 - self.opacity * self.cover.interpolate(x, y, kind=Float64))


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
        """Return the clouds at their positions at a time, for a sun above the horizon."""
        p = self.parameters
        return Clouds(
            cover=self._cover_grid,
            height=Float64(self.height_m),
            east=Float64(p.wind_east_m_s * time_s),
            north=Float64(p.wind_north_m_s * time_s),
            opacity=1.0 - Float64(p.direct_transmittance(sun)),
        )

    @cached_property
    def _cover_grid(self) -> PeriodicGrid:
        return PeriodicGrid.of(self.cover, 1.0 / self.cell_m)

    def transmittance(
        self, points: FloatArray[np.ndarray, "*batch 3"], sun: Sun, time_s: float
    ) -> FloatArray[np.ndarray, "*batch"]:
        """Fraction of direct sunlight that reaches world points (metres) through the layer; NaN for NaN points.

        The sun must be above the horizon.
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
