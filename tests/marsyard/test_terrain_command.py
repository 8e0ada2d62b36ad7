"""Tests of `marsyard terrain`: output and exit status."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from marsyard.sim.terrain import sites
from tests.command import run_command


@pytest.fixture
def tile(tmp_path: Path) -> str:
    path = tmp_path / "tile.npz"
    y, x = np.mgrid[:60, :60]
    heights = np.sin(x / 9.0) + np.cos(y / 8.0)
    heights[5, 5] = np.nan
    np.savez(path, dem=heights, dem_gsd=2.0)
    return str(path)


def test_list_names_every_site() -> None:
    status, output = run_command("terrain", "list")
    assert status == 0
    for name in sites():
        assert name in output


@pytest.mark.slow
def test_site_statistics_include_values_of_the_paper() -> None:
    status, output = run_command("terrain", "stats", "meridiani", "--json")
    assert status == 0
    record = json.loads(output)
    assert record["site"] == "meridiani"
    assert record["paper"]["mean_slope_deg"] == [1.0, 2.0]
    assert 1.0 <= record["measured"]["mean_slope_30_m_deg"] <= 2.0
    assert record["real"] is None


def test_file_statistics_report_real_and_filled_posts(tile: str) -> None:
    status, output = run_command("terrain", "stats", tile)
    assert status == 0
    message = " ".join(output.split())
    assert "Filled: 1 posts without height" in message
    assert "mean slope over 30 m, deg" in message
    assert "the terrain around it is synthetic" in message
    assert json.loads(run_command("terrain", "stats", tile, "--json")[1])["real"]["posting_m"] == 2.0


def test_holes_are_rejected_or_counted_and_marked(tmp_path: Path) -> None:
    """Half of the tile has no heights, as after reprojection."""
    path, figure = tmp_path / "half.npz", tmp_path / "half.png"
    heights = np.add.outer(np.sin(np.arange(64) / 5.0), np.cos(np.arange(64) / 6.0))
    heights[:, :31] = np.nan
    np.savez(path, dem=heights, dem_gsd=2.0)
    status, output = run_command("terrain", "stats", path)
    assert status == 2
    assert "48.4% of its posts have no height; allowed: up to 5.0%" in output
    status, output = run_command("terrain", "stats", path, "--max-holes", "0.5", "--image", figure)
    assert status == 0, output
    assert "1984 posts without height (48.4%)" in " ".join(output.split())
    image = cv2.imread(str(figure))
    assert image is not None
    is_red = (image[..., 2].astype(int) - image[..., 1]) > 40
    # the tile of 64 samples is centred in 128 samples; its outline covers a few red pixels
    assert is_red.sum() == pytest.approx(31 * 64, rel=0.1)
    red_columns = np.flatnonzero(is_red.any(axis=0))
    assert red_columns[0] == pytest.approx(32, abs=1)
    assert run_command("terrain", "stats", path, "--max-holes", "0.5", "--image", figure)[0] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("stats", "jezero"), "no site is called 'jezero'; allowed: pisgah"),
        (("stats", "mars-yard", "--scale", "descent"), "has no terrain at the scale 'descent'"),
        (("stats", "nowhere.npz"), "nowhere.npz: no such file"),
    ],
)
def test_invalid_arguments_are_reported(arguments: tuple[str, ...], message: str) -> None:
    status, output = run_command("terrain", *arguments)
    assert status == 2
    assert message in output
