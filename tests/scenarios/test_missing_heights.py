"""Tests of undeclared missing values in DTMs: values that are found, and real ground that is not mistaken for them."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from typer.testing import CliRunner

from marsyard.cli.app import app
from marsyard.scenarios.missing_heights import MissingValue, find_missing_value
from marsyard.scenarios.terrain_files import check_source
from marsyard.sim.terrain.rasters import RealTerrain, TerrainFileError
from tests.scenarios.test_terrain_files import write_tif

ROWS, COLUMNS = 150, 200


def ground(mean_m: float = -2250.0, relief_m: float = 6.0, seed: int = 1) -> np.ndarray:
    """Return smooth random ground with this mean and relief."""
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal((ROWS, COLUMNS)), 6.0, mode="wrap")
    return np.asarray(mean_m + relief_m * (noise - noise.mean()) / np.ptp(noise), dtype=np.float64)


def collar(heights: np.ndarray, value: float) -> np.ndarray:
    """Fill the corners outside of a rotated square, as reprojection does."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return np.where(np.abs(x - COLUMNS / 2) + np.abs(y - ROWS / 2) > 120.0, value, heights)


def one_post(heights: np.ndarray, value: float) -> np.ndarray:
    return np.where(np.arange(heights.size).reshape(heights.shape) == 5050, value, heights)


def holes(heights: np.ndarray, value: float, fraction: float) -> np.ndarray:
    """Fill single random posts."""
    return np.where(np.random.default_rng(2).random(heights.shape) < fraction, value, heights)


def blurred_hole(heights: np.ndarray, value: float) -> np.ndarray:
    """Fill a disc, with a ring of averages of value and ground, as bilinear resampling writes them."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    weight = np.clip(20.5 - np.hypot(x - 90.3, y - 70.2), 0.0, 1.0)
    return (1.0 - weight) * heights + weight * value


MISSING: list[tuple[str, Callable[[], np.ndarray], float]] = [
    ("one post of -9999", lambda: one_post(ground(), -9999.0), -9999.0),
    ("scattered -9999", lambda: holes(ground(), -9999.0, 0.04), -9999.0),
    ("collar of -9999", lambda: collar(ground(), -9999.0), -9999.0),
    ("blurred -9999", lambda: blurred_hole(ground(), -9999.0), -9999.0),
    ("9999 in mountains", lambda: collar(ground(500.0, 3000.0), 9999.0), 9999.0),
    ("collar of 0", lambda: collar(ground(), 0.0), 0.0),
    ("holes of 0", lambda: holes(ground(-4450.0), 0.0, 0.03), 0.0),
    ("0 over constant ground", lambda: collar(np.full((ROWS, COLUMNS), -4450.0), 0.0), 0.0),
    ("-9999 over integers", lambda: collar(np.rint(ground(-2250.0, 60.0)), -9999.0), -9999.0),
    ("0 over integers", lambda: collar(np.rint(ground(-2250.0, 60.0)), 0.0), 0.0),
    ("collar of another value", lambda: collar(ground(), -3000.5), -3000.5),
    ("holes of another value", lambda: blurred_hole(ground(), -7777.0), -7777.0),
    ("0 and -9999", lambda: holes(collar(ground(), 0.0), -9999.0, 0.01), -9999.0),
    ("collar 90 m below", lambda: collar(ground(90.0), 0.0), 0.0),
    ("collar 8 m below", lambda: collar(ground(12.0, 6.0), 0.0), 0.0),
    ("collar within the relief", lambda: collar(ground(0.0, 40.0), 0.0), 0.0),
    ("minimum of the file repeated", lambda: collar(ground(0.0, 6.0), -8.0), -8.0),
]  # fmt: skip


@pytest.mark.parametrize(("heights", "value"), [case[1:] for case in MISSING], ids=[case[0] for case in MISSING])
def test_missing_values_are_found(heights: Callable[[], np.ndarray], value: float) -> None:
    values = heights()
    assert find_missing_value(values, 1.0) == MissingValue(value, int(np.count_nonzero(values == value)))


def box(heights: np.ndarray, top_m: float) -> np.ndarray:
    """Set a rectangle to one height: a lander, a test object, or a table mountain."""
    heights = heights.copy()
    heights[60:90, 80:120] = top_m
    return heights


REAL: list[tuple[str, Callable[[], np.ndarray]]] = [
    ("ground", ground),
    ("steep ground", lambda: ground(0.0, 3000.0)),
    ("constant", lambda: np.zeros((ROWS, COLUMNS))),
    ("ground about 0", lambda: ground(0.0)),
    ("integers", lambda: np.rint(ground(0.0, 60.0))),
    ("integers of steep ground", lambda: np.rint(ground(0.0, 3000.0))),
    ("integers of rough ground", lambda: np.rint(1000.0 * np.random.default_rng(3).standard_normal((ROWS, COLUMNS)))),
    ("steps of 10 m", lambda: 10.0 * np.rint(ground(0.0, 200.0) / 10.0)),
    ("lake at 0", lambda: np.maximum(ground(2.0, 20.0), 0.0)),
    ("lake at -2300", lambda: np.maximum(ground(-2297.0, 20.0), -2300.0)),
    ("sea with rough islands", lambda: np.maximum(ground(-5.0, 300.0), 0.0)),
    ("plain with hills", lambda: np.maximum(ground(-50.0, 200.0), 0.0)),
    ("table mountain", lambda: np.minimum(ground(0.0, 400.0), 30.0)),
    ("box on a plain", lambda: box(np.zeros((ROWS, COLUMNS)), 1.0)),
    ("box on ground", lambda: box(ground(0.0, 0.3), 1.0)),
    ("flat pad", lambda: box(ground(0.0, 6.0), 0.0)),
    ("building", lambda: box(ground(0.0, 0.3), 40.0)),
    ("pit", lambda: box(ground(50.0, 6.0), 20.0)),
    ("declared holes", lambda: collar(ground(), np.nan)),
    ("outlier", lambda: one_post(ground(), -2000.0)),
]


@pytest.mark.parametrize("heights", [case[1] for case in REAL], ids=[case[0] for case in REAL])
@pytest.mark.parametrize("posting_m", [0.25, 1.0, 463.0])
def test_real_ground_is_not_missing(heights: Callable[[], np.ndarray], posting_m: float) -> None:
    assert find_missing_value(heights(), posting_m) is None


@pytest.mark.parametrize("quantum_m", [0.0, 0.1, 1.0, 5.0])
def test_hirise_tile_is_not_missing(shared_data: Path, quantum_m: float) -> None:
    heights = np.load(shared_data / "gale_hirise" / "gale_1m_dem_0p5m_ortho.npz")["dem"].astype(np.float64)
    if quantum_m:
        heights = quantum_m * np.rint(heights / quantum_m)
    assert find_missing_value(heights, 1.0) is None
    lowest = float(np.min(heights))
    assert find_missing_value(np.maximum(heights, lowest + 10.0), 1.0) is None, "a lake"
    heights[:, -5:] = 0.0
    assert find_missing_value(heights, 1.0) == MissingValue(0.0, 5 * len(heights))


@pytest.mark.parametrize("nodata", [None, -32768.0, -9998.0])
@pytest.mark.parametrize(("value", "dtype"), [(-9999.0, "float32"), (0.0, "float32"), (-9999, "int16"), (0, "int16")])
def test_undeclared_values_are_rejected(tmp_path: Path, value: float, dtype: str, nodata: float | None) -> None:
    values: np.ndarray = collar(ground(), value).astype(dtype)
    declared = "it has no nodata value" if nodata is None else f"it has the nodata value {nodata:g}"
    posts = np.count_nonzero(values == value)
    problem = re.escape(
        f"dtm.tif: the height {value:g} m at {posts} of {values.size} posts is probably a value for missing"
    )
    with pytest.raises(TerrainFileError, match=f"{problem}.*{declared}; set the value .* rio edit-info --nodata"):
        check_source(RealTerrain(dtm=write_tif(tmp_path, values=values, nodata=nodata)))
    check_source(RealTerrain(dtm=write_tif(tmp_path, "valid.tif", values=values, nodata=value), max_hole_fraction=0.6))


def test_archives_with_undeclared_values_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "dtm.npz"
    np.savez(path, dem=collar(ground(), -9999.0), dem_gsd=1.0)
    with pytest.raises(TerrainFileError, match=r"dtm.npz: the height -9999 m .* mark posts without height with NaN"):
        check_source(RealTerrain(dtm=path))
    np.savez(path, dem=np.where(np.eye(ROWS, COLUMNS) > 0, -32767.0, ground()), dem_gsd=1.0)
    with pytest.raises(TerrainFileError, match=r"heights of -32767 m; .* posts with this height: 150 of 30000"):
        check_source(RealTerrain(dtm=path))


def test_command_ends_with_status_2(tmp_path: Path) -> None:
    values: Any = collar(ground(), -9999.0).astype(np.float32)
    path = write_tif(tmp_path, values=values, nodata=None)
    result = CliRunner().invoke(app, ["terrain", "stats", str(path)])
    assert result.exit_code == 2
    assert "-9999" in result.output
