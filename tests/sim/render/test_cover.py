"""Tests of sharp borders between sand and bedrock."""

import numpy as np
import pytest
from scipy.special import expit

from marsyard.sim.frames import direction
from marsyard.sim.render import Renderer, Scene, Sun
from marsyard.sim.terrain.sites import SiteCover
from marsyard.sim.terrain.surface import ALBEDO, Surface
from tests.sim.scenes import LAMBERT, NEAR_MESH, look_down


def test_border_is_sharper_than_the_samples(renderer: Renderer) -> None:
    """Albedo rises from sand, in the west, to bedrock over about a metre; the border is much narrower."""
    x = np.arange(64.0)
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    # periodic: two borders, at columns 8 and 40
    samples[..., ALBEDO] = 0.2 * np.exp(0.6 * (expit(4.0 * (x - 8.0)) - expit(4.0 * (x - 40.0))) - 0.3)
    surface, sun = Surface.from_samples(samples, 1.0), Sun(direction(0.5 * np.pi, 1.0))
    plain, covered = (
        look_down(
            renderer, Scene(surface, (8.0, 8.0), sun, LAMBERT, cover=cover, **NEAR_MESH), (8.0, 8.0, 9.0), 0.6, 200
        )
        .radiance[100]
        .astype(np.float64)
        for cover in (None, SiteCover(border=0.0, contrast=0.2, softness=0.05))
    )
    change = np.log(covered / plain)
    # sand is unchanged, bedrock has twice the contrast; 0.3 is six times the softness
    assert change[:20] == pytest.approx(0.0, abs=1e-3)
    assert change[-20:] == pytest.approx(0.4, abs=1e-3)
    # the mean logarithm of albedo, which is that of the border, is in the middle of the ramp
    assert np.searchsorted(change, 0.2) == pytest.approx(100, abs=4)

    def width(values: np.ndarray) -> int:
        """Count the pixels between a tenth and nine tenths of the rise."""
        rise = (values - values.min()) / np.ptp(values)
        return int(np.count_nonzero((rise > 0.1) & (rise < 0.9)))

    assert width(change) < 0.4 * width(np.log(plain))
