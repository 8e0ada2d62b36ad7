"""Fixtures of the rendering tests: the renderer, a rough terrain, and a factory of descent cameras."""

from collections.abc import Callable

import numpy as np
import pytest

from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.render import Renderer, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.terrain import Surface, TerrainParameters, synthesise


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return process_renderer(default_backend())


@pytest.fixture(scope="session")
def terrain() -> Surface:
    """Return a terrain of 768 m with craters and slopes of 6 deg."""
    parameters = TerrainParameters(
        samples=512,
        rms_slope_deg=6.0,
        outer_scale_m=400.0,
        craters_per_km2=200.0,
        crater_diameter_max_m=120.0,
        albedo_contrast=0.2,
    )
    return synthesise(parameters, np.random.default_rng(11))


@pytest.fixture(scope="session")
def descent_camera() -> Callable[..., Cahvor]:
    """Return a function that makes descent cameras of given size (pixels) and distortion, in the body frame."""

    def make_camera(size: int = 1024, r: tuple[float, float, float] = (0.00096, -0.002183, 0.018547)) -> Cahvor:
        pinhole = Cahv.from_focal_length(
            focal_m=14.67e-3,
            pixel_pitch_m=12e-6 * 1024 / size,
            size=(size, size),
            centre=np.zeros(3),
            axis=np.array([0.0, 0.0, -1.0]),
            right=np.array([1.0, 0.0, 0.0]),
        )
        return Cahvor.from_cahv(pinhole, r=np.array(r))

    return make_camera
