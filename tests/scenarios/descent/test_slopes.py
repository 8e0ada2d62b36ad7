"""Slopes of the simulated sites over the overlap of descent images; `DimesOptions.slope_sd_rad` is their prior."""

from __future__ import annotations

import numpy as np
import pytest

from marsyard.algorithms.dimes import DimesOptions
from marsyard.sim.terrain import TerrainBank, site

#: Side of the square whose plane is fitted, m: about the overlap of two descent images.
SIDE_M = 1000.0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sd_deg"), [("gusev", 0.32), ("meridiani", 0.38)])
def test_slopes_over_a_kilometre_are_below_the_prior(name: str, sd_deg: float) -> None:
    """The values per axis are those of 60 and 40 descents over 12 terrains (calibration seed 5406)."""
    terrain = site(name).terrain("descent").model_copy(update={"samples": 2048, "spacing_m": 2.0})
    bank = TerrainBank(terrain, 1)
    steps = np.linspace(-0.5 * SIDE_M, 0.5 * SIDE_M, 41)
    east, north = (grid.ravel() for grid in np.meshgrid(steps, steps))
    design = np.column_stack([east, north, np.ones(east.size)])
    slopes = []
    for number in range(4):
        surface = bank.terrain(number)
        for centre_east, centre_north in np.random.default_rng(number).uniform(0.0, 4096.0, (20, 2)):
            heights = surface.height(centre_east + east, centre_north + north)
            slopes.append(np.linalg.lstsq(design, heights, rcond=None)[0][:2])
    rms_deg = np.degrees(np.sqrt(np.mean(np.square(slopes))))
    # about 16 independent squares of 1 km in each terrain of 4 km: 128 values, and terrains that differ
    assert rms_deg == pytest.approx(sd_deg, rel=0.3)
    assert rms_deg < np.degrees(DimesOptions().slope_sd_rad)
