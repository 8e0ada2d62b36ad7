"""Test that rendering kernels receive a constant number of resolution levels of the ground, for any terrain size."""

import numpy as np
import pytest

from marsyard.sim.render.renderer import LEVELS, NO_CEILING, ground_struct
from marsyard.sim.terrain import Surface


@pytest.mark.parametrize("side", [16, 128])
def test_kernels_receive_a_constant_number_of_levels(side: int) -> None:
    surface = Surface.from_samples(np.zeros((side, side, 2), dtype=np.float32), 1.0)
    ground = ground_struct(surface, (0.0, 1.0, 0.0, 1.0, 2.0), ceilings=True)
    levels, top_level = ground.levels, ground.top_level
    assert len(levels) == len(ground.ceilings) == LEVELS
    assert levels[top_level].shape[0] == 16
    assert all(level is expected for level, expected in zip(levels, surface.levels, strict=False))
    # Kernels are compiled for levels of the same array type.
    assert {(level.dtype.str, level.flags.writeable, level.flags.c_contiguous) for level in levels} == {
        ("<f4", False, True)
    }
    assert all(ceiling is expected for ceiling, expected in zip(ground.ceilings, surface.ceilings, strict=False))
    ground_without_ceilings = ground_struct(surface, ground.extent, ceilings=False)
    assert all(ceiling is NO_CEILING for ceiling in ground_without_ceilings.ceilings)
