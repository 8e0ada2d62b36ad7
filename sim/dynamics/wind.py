"""Wind as a function of height: a mean profile with a boundary layer, and Dryden gusts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics.kernels.swing import WindField, wind_profile
from marsyard.sim.parameters import Parameters, Positive, bounded

#: Shortest gusts, m: two diameters of the canopy, which responds to the mean over its own width.
SHORTEST_WAVE_M = 30.0
#: Longest gusts over the gusts' length scale: longer ones belong to the mean wind, which has its own parameters.
LONGEST_WAVE_SCALES = 20.0
WAVES = 24


class WindParameters(Parameters):
    """Mean wind above the boundary layer, profile of the layer, and gusts."""

    wind_east_m_s: Annotated[float, bounded(-60.0, 60.0, "mean wind to the east")] = 0.0
    wind_north_m_s: Annotated[float, bounded(-60.0, 60.0, "mean wind to the north")] = 0.0
    wind_layer_m: Annotated[Positive, Field(le=5000.0, description="depth of the boundary layer (assumed)")] = 500.0
    wind_roughness_m: Annotated[Positive, Field(le=1.0, description="roughness (Mars Pathfinder: 0.03)")] = 0.03
    gust_intensity_m_s: Annotated[float, bounded(0.0, 20.0, "RMS of each component of the gusts (assumed)")] = 1.5
    gust_length_m: Annotated[float, bounded(50.0, 5000.0, "length scale (MIL-F-8785C above 610 m: 533 m)")] = 533.0


@dataclass(frozen=True)
class Wind:
    """Wind as a smooth function of height alone: frozen turbulence, the same at all times and horizontal positions.

    The mean wind is constant above the boundary layer and logarithmic in it, ``ln(1 + h / roughness)``, zero on the
    ground. Gusts have Dryden's spectra (MIL-F-8785C, 3.7.2) along a vertical path: upward gusts the longitudinal one,
    ``2 sigma^2 L / pi / (1 + (L k)^2)``, the others the transverse one, ``sigma^2 L / pi (1 + 3 (L k)^2) / (1 + (L
    k)^2)^2``, k in rad/m, between the longest and the shortest wave; sigma^2 is the variance in that band. They are
    sums of waves with normal amplitudes (Rice 1944), evenly spaced in log k, each k drawn within its interval.
    """

    field: WindField

    @classmethod
    def draw(cls, parameters: WindParameters, ground_height_m: float, rng: np.random.Generator) -> Wind:
        """Draw the gusts over ground at a height of the world's z."""
        p = parameters
        longest_m = LONGEST_WAVE_SCALES * p.gust_length_m
        edges = np.geomspace(2.0 * np.pi / longest_m, 2.0 * np.pi / SHORTEST_WAVE_M, WAVES + 1)
        wavenumbers = edges[:-1] * (edges[1:] / edges[:-1]) ** rng.random(WAVES)
        # integrals of the transverse and the longitudinal spectrum between wavenumbers, x = L k
        x = p.gust_length_m * edges
        transverse = np.diff(2.0 * np.arctan(x) - x / (1.0 + x**2)) / np.pi
        longitudinal = np.diff(2.0 * np.arctan(x)) / np.pi
        variances = np.stack([transverse, transverse, longitudinal], axis=1)
        deviations = p.gust_intensity_m_s * np.sqrt(variances / variances.sum(axis=0))
        amplitudes = np.tile(deviations, 2) * rng.standard_normal((WAVES, 6))
        return cls(
            WindField(
                ground_height_m=ground_height_m,
                mean_east_m_s=p.wind_east_m_s,
                mean_north_m_s=p.wind_north_m_s,
                layer_m=p.wind_layer_m,
                roughness_m=p.wind_roughness_m,
                waves=np.column_stack([wavenumbers, amplitudes]),
            )
        )

    @property
    def without_gusts(self) -> Wind:
        """The mean wind alone."""
        return Wind(self.field._replace(waves=np.zeros((0, 7))))

    def velocities(self, heights_m: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Wind towards east, north and up, m/s, at heights of the world's z, metres."""
        return np.asarray(wind_profile(heights_m, self.field))
