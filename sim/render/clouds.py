"""A layer of fair-weather clouds that drifts over the scene and dims the direct sun below it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Float64
from pydantic import Field
from scipy.ndimage import map_coordinates
from scipy.special import ndtri

from marsyard.sim.parameters import Parameters
from marsyard.sim.render.photometry import Sun

#: Cells along each side of the periodic layer, and its period in mean sizes of a cloud.
CELLS, PERIOD_SIZES = 1024, 32.0
#: Relative lengths and variances of the field's octaves; the finer ones make the clouds' outlines ragged.
OCTAVES = ((1.0, 1.0), (0.5, 1.0 / 16.0), (0.25, 1.0 / 256.0))


class CloudParameters(Parameters):
    """Fair-weather clouds. The defaults are small cumuli over a desert at noon; they are assumed, not from a paper."""

    base_m: Annotated[float, Field(gt=0.0, le=20000.0, description="height of the layer above the ground, m")] = 2500.0
    cover: Annotated[float, Field(ge=0.0, le=0.9, description="fraction of the ground in the clouds' shadows")] = 0.3
    size_m: Annotated[
        float, Field(ge=50.0, le=10000.0, description="mean length of a straight line's passage through a cloud, m")
    ] = 800.0
    edge_m: Annotated[
        float, Field(ge=0.0, le=1000.0, description="RMS width of a shadow's edge, the sun's disc included, m")
    ] = 40.0
    optical_depth: Annotated[float, Field(ge=0.0, le=100.0, description="vertical optical depth of a cloud")] = 10.0
    asymmetry: Annotated[
        float, Field(ge=0.0, lt=1.0, description="mean cosine of the angle by which a droplet scatters light")
    ] = 0.85
    wind_east_m_s: Annotated[float, Field(ge=-100.0, le=100.0, description="drift to the east, m/s")] = 6.0
    wind_north_m_s: Annotated[float, Field(ge=-100.0, le=100.0, description="drift to the north, m/s")] = 3.0

    def direct_transmittance(self, sun: Sun) -> float:
        """Fraction of the direct sun that passes a cloud: ``exp(-tau / sin elevation)``; 0 for a sun that is down."""
        up = float(sun.direction[2])
        return float(np.exp(-self.optical_depth / up)) if up > 0.0 else 0.0

    def sky_light(self, sun: Sun) -> float:
        """Irradiance that the clouds scatter down, over the direct sun's on a plane facing it.

        A cloud that absorbs nothing lets ``2 / (2 + (1 - g) tau)`` of the light through (two streams; Bohren, Am. J.
        Phys. 55, 1987), of which `direct_transmittance` keeps its direction. The rest is spread evenly over the ground:
        the clouds are about as high as they are wide apart.
        """
        passed = 2.0 / (2.0 + (1.0 - self.asymmetry) * self.optical_depth)
        scattered = max(passed - self.direct_transmittance(sun), 0.0)
        return self.cover * scattered * max(float(sun.direction[2]), 0.0)


@dataclass(frozen=True)
class CloudLayer:
    """One realisation of the clouds: a thin, periodic layer that keeps its shape and drifts with the wind.

    The layer dims the direct sun where the line from a point to the sun passes a cloud; skylight remains and grows by
    the light that all clouds scatter down. The clouds themselves are not drawn: pictures from above the layer, or of
    the sky, lack them. The layer has no thickness, so a low sun meets no more cover than a high one.

    - height_m: height of the layer above the world's datum
    - cover: fraction of the light's path through cloud, read-only: y grows with the row, one cell every `cell_m`
    """

    parameters: CloudParameters
    height_m: float
    cover: Float32[np.ndarray, "rows columns"]

    @classmethod
    def draw(cls, parameters: CloudParameters, rng: np.random.Generator, *, ground_m: float = 0.0) -> CloudLayer:
        """Draw a layer over ground of this mean height.

        A Gaussian field of three octaves is cut at the level that leaves `cover` above it. Lines through it meet
        cloud ``sqrt(m2) exp(-u**2 / 2) / 2 pi`` times a metre (Rice 1944), m2 the mean square of its slope along the
        line and u the cut, both in standard deviations: that sets the octaves' length so that the mean passage is
        `size_m`. The edge is softened by a Gaussian, which keeps the mean cover.
        """
        noise = np.fft.rfft2(rng.standard_normal((CELLS, CELLS)))
        if parameters.cover == 0.0:
            return cls(parameters, ground_m + parameters.base_m, _frozen(np.zeros((CELLS, CELLS))))
        # squared wave numbers of the real transform's terms, rad2/m2
        spacing = parameters.size_m * PERIOD_SIZES / CELLS
        y, x = 2.0 * np.pi * np.fft.fftfreq(CELLS, spacing), 2.0 * np.pi * np.fft.rfftfreq(CELLS, spacing)
        wave = y[:, None] ** 2 + x**2
        cut = float(ndtri(1.0 - parameters.cover))
        total = sum(variance for _, variance in OCTAVES)
        bend = sum(variance / (2.0 * length**2) for length, variance in OCTAVES) / total
        length = parameters.size_m * np.sqrt(bend) * np.exp(-0.5 * cut**2) / (2.0 * np.pi * parameters.cover)
        power = sum(
            variance * (part * length) ** 2 * np.exp(-wave * (part * length) ** 2) for part, variance in OCTAVES
        )
        field = np.fft.irfft2(noise * np.sqrt(power), s=(CELLS, CELLS))
        above = field - np.quantile(field, 1.0 - parameters.cover)
        # a cell that the outline crosses is cloud by about the fraction that lies inside
        slope = np.hypot(*(0.5 * (np.roll(above, -1, k) - np.roll(above, 1, k)) for k in (0, 1)))
        inside = np.clip(0.5 + above / np.maximum(slope, 1e-12), 0.0, 1.0)
        soft = np.fft.irfft2(np.fft.rfft2(inside) * np.exp(-0.5 * wave * parameters.edge_m**2), s=inside.shape)
        return cls(parameters, ground_m + parameters.base_m, _frozen(np.clip(soft, 0.0, 1.0)))

    @property
    def cell_m(self) -> float:
        """Distance between cells."""
        return self.parameters.size_m * PERIOD_SIZES / CELLS

    def coefficients(self, sun: Sun, time_s: float) -> Float64[np.ndarray, "5"]:
        """Coefficients of the kernel: cells per metre, height, drift to east and north, opacity of a cloud."""
        p = self.parameters
        drift = p.wind_east_m_s * time_s, p.wind_north_m_s * time_s
        return np.array([1.0 / self.cell_m, self.height_m, *drift, 1.0 - p.direct_transmittance(sun)])

    def transmittance(
        self, points: Float[np.ndarray, "*batch 3"], sun: Sun, time_s: float
    ) -> Float64[np.ndarray, "*batch"]:
        """Fraction of the direct sun that reaches world points (metres) through the layer; NaN where they are NaN.

        The truth of a picture: ``clouds.transmittance(frame.points_world(), scene.sun, time_s)``.
        """
        _cells, height, east, north, loss = self.coefficients(sun, time_s)
        towards = np.asarray(sun.direction, dtype=np.float64)
        up = np.maximum(height - points[..., 2], 0.0) / towards[2]
        x, y = ((points[..., k] + up * towards[k] - drift) / self.cell_m for k, drift in ((0, east), (1, north)))
        finite = np.isfinite(x) & np.isfinite(y)
        cells = np.where(finite, np.stack([y, x]), 0.0)
        cover = map_coordinates(self.cover.astype(np.float64), cells, order=1, mode="grid-wrap")
        return np.asarray(np.where(finite, 1.0 - loss * cover, np.nan))


def no_cover() -> Float32[np.ndarray, "one one"]:
    """The cover of a scene without clouds, of the same numba type as a layer's."""
    return _frozen(np.zeros((1, 1)))


def _frozen(cover: Float64[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
    kept = np.ascontiguousarray(cover, dtype=np.float32)
    kept.setflags(write=False)
    return kept
