"""Tests of outcrops: area of the slabs, and their relief and albedo relative to the sand."""

import numpy as np
import pytest
from jaxtyping import Float32

from marsyard.sim.terrain import TerrainParameters
from marsyard.sim.terrain.landforms import Outcrop, TerrainGround
from marsyard.sim.terrain.landforms.kernels.bedrock import add_slabs


def _apply(**changes: float) -> TerrainGround:
    height, log_albedo = np.zeros((2, 512, 512), dtype=np.float32)
    ground = TerrainGround(height, log_albedo, 0.05)
    Outcrop(**{"patch_m": 4.0, "slab_m": 1.0, "joint_m": 0.05, **changes}).apply(ground, np.random.default_rng(3))
    return ground


@pytest.mark.parametrize("fraction", [0.2, 0.6])
def test_slabs_cover_the_specified_fraction_and_rise_above_the_sand(fraction: float) -> None:
    ground = _apply(fraction=fraction, height_m=0.1, tilt_deg=0.0, log_albedo=0.3, log_albedo_sd=0.0)
    is_slab = ground.height > 0.005
    # 26 x 26 large slabs with patches of 4 m: the area is known to about a tenth; joints lie below the threshold
    assert np.mean(is_slab) == pytest.approx(fraction, abs=0.07)
    # mean heights of the generations are 1 and 0.35 of the parameter, and so are albedos; joints, and the borders of
    # patches, where only one generation exists, are lower
    assert np.median(ground.height[is_slab]) == pytest.approx(0.1 * 1.35, rel=0.25)
    assert np.median(ground.log_albedo[is_slab]) == pytest.approx(0.3 * 1.35, rel=0.25)
    assert np.all(ground.height[~is_slab] >= 0.0)


def test_ground_without_bedrock_is_unchanged() -> None:
    ground = _apply(fraction=0.0)
    # the quantile that bounds the patches is the maximum of the field
    assert np.mean(ground.height > 0.0) < 0.01


def _add_one_slab(slope_x: float) -> Float32[np.ndarray, "64 64"]:
    """Add one slab among empty cells: four cells of 1.6 m, points in their middles."""
    height, log_albedo = np.zeros((2, 64, 64), dtype=np.float32)
    points, slabs = np.full((2, 2, 2), 0.5), np.zeros((2, 2, 4))
    slabs[0, 0] = (0.2, slope_x, 0.0, 0.1)
    add_slabs(height, log_albedo, 0.05, points, slabs, 1.6, 0.2)
    return height


def test_slab_is_a_tilted_plateau_with_rounded_edges() -> None:
    level, tilted = _add_one_slab(0.0), _add_one_slab(0.1)
    # the cell is the square from 0 to 1.6 m; its middle part is level, and its height falls over 0.2 m at the border
    assert level[4:29, 4:29] == pytest.approx(0.2)
    assert level[16, 2] == pytest.approx(0.2 * 0.5, abs=0.01)
    assert np.all(level[34:, :] == 0.0)
    assert np.all(level[:, 34:] == 0.0)
    # along x, columns are 0.05 m apart
    assert np.diff(tilted[16, 5:28]) == pytest.approx(0.1 * 0.05, abs=1e-6)
    assert tilted[16, 16] == pytest.approx(0.2, abs=1e-6)


def test_outcrop_is_a_landform_of_a_terrain() -> None:
    parameters = TerrainParameters.model_validate({"samples": 64, "outcrop": {"fraction": 0.5}})
    assert parameters.outcrop == Outcrop(fraction=0.5)
    assert parameters.with_changes({"outcrop": None}).outcrop is None
