"""Wind over height: a mean profile with a boundary layer, and continuous gusts that the falling parachute meets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics.kernels.swing import WindField, winds
from marsyard.sim.parameters import Parameters

#: Shortest gusts, m: two diameters of the canopy, which feels the mean over its own width.
SHORTEST_WAVE_M = 30.0
#: Longest gusts over the length scale of gusts: longer ones would be the mean wind, which is a parameter of its own.
LONGEST_WAVE_SCALES = 20.0
WAVES = 24


class WindParameters(Parameters):
    """Mean wind above the boundary layer, the layer's profile, and gusts."""

    wind_east_m_s: Annotated[float, Field(ge=-60.0, le=60.0, description="mean wind to the east, m/s")] = 0.0
    wind_north_m_s: Annotated[float, Field(ge=-60.0, le=60.0, description="mean wind to the north, m/s")] = 0.0
    wind_layer_m: Annotated[
        float, Field(gt=0.0, le=5000.0, description="height below which the mean wind falls off, m; assumed")
    ] = 500.0
    wind_roughness_m: Annotated[
        float, Field(gt=0.0, le=1.0, description="roughness length of the ground, m (Mars Pathfinder: 0.03)")
    ] = 0.03
    gust_intensity_m_s: Annotated[
        float, Field(ge=0.0, le=20.0, description="RMS of each of the gusts' components, m/s; assumed")
    ] = 1.5
    gust_length_m: Annotated[
        float, Field(ge=50.0, le=5000.0, description="length scale, m (MIL-F-8785C above 610 m: 533 m)")
    ] = 533.0


@dataclass(frozen=True)
class Wind:
    """Wind as a smooth function of height, the same at all times and places: turbulence frozen while one falls through.

    The mean wind is constant above the boundary layer and logarithmic in it, ``ln(1 + h / roughness)``, zero on the
    ground. Gusts have Dryden's spectra (MIL-F-8785C, 3.7.2) along a vertical path: upward gusts the longitudinal one,
    ``2 sigma^2 L / pi / (1 + (L k)^2)``, the others the transverse one, ``sigma^2 L / pi (1 + 3 (L k)^2) / (1 + (L
    k)^2)^2``, k in rad/m; between the longest and shortest wave, with sigma^2 the variance of what lies between. They
    are sums of waves with normal amplitudes (Rice 1944), evenly spaced in log k, each k drawn within its interval.

    Attributes
    ----------
    field
        Mean wind, layer and waves, as the compiled equations take them.
    """

    field: WindField

    @classmethod
    def drawn(cls, parameters: WindParameters, ground_height_m: float, rng: np.random.Generator) -> Wind:
        """One wind over ground at a height of the world's z, metres; the generator draws the gusts."""
        p = parameters
        edges = np.geomspace(
            2.0 * np.pi / (LONGEST_WAVE_SCALES * p.gust_length_m), 2.0 * np.pi / SHORTEST_WAVE_M, WAVES + 1
        )
        wavenumbers = edges[:-1] * (edges[1:] / edges[:-1]) ** rng.random(WAVES)
        variances = np.stack(
            [_transverse(edges, p.gust_length_m)] * 2 + [_longitudinal(edges, p.gust_length_m)], axis=1
        )
        deviations = p.gust_intensity_m_s * np.sqrt(variances / variances.sum(axis=0))
        amplitudes = np.tile(deviations, 2) * rng.standard_normal((WAVES, 6))
        field = WindField(
            ground_height_m=ground_height_m,
            mean_east_m_s=p.wind_east_m_s,
            mean_north_m_s=p.wind_north_m_s,
            layer_m=p.wind_layer_m,
            roughness_m=p.wind_roughness_m,
            waves=np.column_stack([wavenumbers, amplitudes]),
        )
        return cls(field)

    @property
    def without_gusts(self) -> Wind:
        """The mean wind alone."""
        return Wind(self.field._replace(waves=np.zeros((0, 7))))

    def velocities(self, heights_m: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Wind towards east, north and up, m/s, at heights of the world's z, metres."""
        return np.asarray(winds(heights_m, self.field))


def _transverse(edges: Float64[np.ndarray, "m"], length_m: float) -> Float64[np.ndarray, "m-1"]:
    """Shares of variance between wavenumbers: the spectrum's integral is (2 atan x - x / (1 + x^2)) / pi, x = L k."""
    x = length_m * edges
    return np.asarray(np.diff(2.0 * np.arctan(x) - x / (1.0 + x**2)) / np.pi)


def _longitudinal(edges: Float64[np.ndarray, "m"], length_m: float) -> Float64[np.ndarray, "m-1"]:
    """Shares of variance between wavenumbers: the spectrum's integral is 2 atan(L k) / pi."""
    return np.asarray(np.diff(2.0 * np.arctan(length_m * edges)) / np.pi)
