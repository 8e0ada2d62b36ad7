"""Kernels take as many levels of every surface."""

import numpy as np
import pytest

from marsyard.sim.render.pyramid import LEVELS, pyramid
from marsyard.sim.terrain import Surface


@pytest.mark.parametrize("side", [16, 128])
def test_every_surface_has_as_many_levels_for_kernels(side: int) -> None:
    surface = Surface.from_samples(np.zeros((side, side, 2), dtype=np.float32), 1.0)
    levels, coarsest = pyramid(surface)
    assert len(levels) == LEVELS
    assert levels[coarsest].shape[0] == 16
    assert all(one is other for one, other in zip(levels, surface.levels, strict=False))
    # compiled for one type of all levels
    assert {(one.dtype.str, one.flags.writeable, one.flags.c_contiguous) for one in levels} == {("<f4", False, True)}
