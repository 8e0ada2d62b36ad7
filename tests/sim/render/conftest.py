"""Fixtures of the rendering tests: the renderer and a rough terrain."""

import numpy as np
import pytest

from marsyard.sim.render import Renderer, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.terrain import Surface, TerrainParameters, synthesise


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return process_renderer(default_backend())


@pytest.fixture(scope="session")
def terrain() -> Surface:
    """Return a terrain of 768 m with craters and slopes of 6 deg."""
    craters: dict[str, float] = {"craters_per_km2": 200.0, "crater_diameter_max_m": 120.0}
    relief = TerrainParameters(samples=512, rms_slope_deg=6.0, outer_scale_m=400.0, albedo_contrast=0.2)
    return synthesise(relief.model_copy(update=craters), np.random.default_rng(11))
