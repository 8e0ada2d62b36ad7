"""Wind: mean wind with a boundary layer, and gusts with Dryden's spectra."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics.kernels.wind import AMPLITUDES, WAVE_COLUMNS, WindField, compute_wind_profile
from marsyard.sim.error_sources import GUSTS
from marsyard.sim.parameters import Parameters, Positive, bounded_field

#: Shortest wavelength of the gusts: two diameters of the canopy, over which shorter gusts average out.
SHORTEST_WAVE_M = 30.0
#: Longest wavelength of the gusts in units of their length scale; longer waves are part of the mean wind.
LONGEST_WAVE_SCALES = 20.0
#: Number of waves of the gusts.
WAVES = 24


class WindParameters(Parameters):
    """Parameters of the wind: mean wind above the boundary layer, profile within the layer, and gusts."""

    wind_east_m_s: Annotated[float, bounded_field(-60.0, 60.0, "mean wind to the east")] = 0.0
    wind_north_m_s: Annotated[float, bounded_field(-60.0, 60.0, "mean wind to the north")] = 0.0
    wind_layer_m: Annotated[Positive, Field(le=5000.0, description="depth of the boundary layer (assumed)")] = 500.0
    wind_roughness_m: Annotated[Positive, Field(le=1.0, description="roughness (Mars Pathfinder: 0.03)")] = 0.03
    gust_intensity_m_s: Annotated[
        float, GUSTS, bounded_field(0.0, 20.0, "RMS of each component of the gusts (assumed)")
    ] = 1.5
    gust_length_m: Annotated[float, bounded_field(50.0, 5000.0, "length scale (MIL-F-8785C above 610 m: 533 m)")] = (
        533.0
    )


@dataclass(frozen=True)
class Wind:
    """Mean wind and gusts as a function of height only: the same at all times and horizontal positions.

    Mean wind at the height h above ground: the wind of `WindParameters` times ``ln(1 + h / z0) / ln(1 + H / z0)``, with
    the roughness z0 and the depth H of the boundary layer; constant above H.

    Gusts: Dryden's spectra (MIL-F-8785C, 3.7.2) for the wavenumber k in rad/m along a vertical path, with the length
    scale L. Vertical gusts have the longitudinal spectrum ``2 sigma^2 L / pi / (1 + (L k)^2)``, horizontal gusts the
    transverse one ``sigma^2 L / pi (1 + 3 (L k)^2) / (1 + (L k)^2)^2``. k is limited to wavelengths from
    `SHORTEST_WAVE_M` to `LONGEST_WAVE_SCALES` L; sigma^2 is the variance in this band. The gusts are sums of `WAVES`
    waves with normal amplitudes (Rice 1944); each k is drawn within one of `WAVES` equal intervals of log k.
    """

    field: WindField

    @classmethod
    def draw(cls, parameters: WindParameters, ground_height_m: float, rng: np.random.Generator) -> Wind:
        """Draw the gusts; `ground_height_m` is the world z of the ground."""
        p = parameters
        longest_m = LONGEST_WAVE_SCALES * p.gust_length_m
        edges = np.geomspace(2.0 * np.pi / longest_m, 2.0 * np.pi / SHORTEST_WAVE_M, WAVES + 1)
        wavenumbers = edges[:-1] * (edges[1:] / edges[:-1]) ** rng.random(WAVES)
        # integrals of the transverse and the longitudinal spectrum over each interval, with x = L k
        x = p.gust_length_m * edges
        transverse = np.diff(2.0 * np.arctan(x) - x / (1.0 + x**2)) / np.pi
        longitudinal = np.diff(2.0 * np.arctan(x)) / np.pi
        variances = np.stack([transverse, transverse, longitudinal], axis=1)
        deviations = p.gust_intensity_m_s * np.sqrt(variances / variances.sum(axis=0))
        amplitudes = np.tile(deviations, 2) * rng.standard_normal((WAVES, AMPLITUDES))
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
        """The same mean wind without gusts."""
        return Wind(self.field._replace(waves=np.zeros((0, WAVE_COLUMNS))))

    def velocities(self, heights_m: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Compute the wind towards east, north and up, m/s, at heights (world z, metres)."""
        return np.asarray(compute_wind_profile(heights_m, self.field))
