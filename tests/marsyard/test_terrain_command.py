"""`marsyard terrain`: what it prints, and how it ends."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from marsyard.cli.app import app
from marsyard.sim.terrain import sites


def invoke(*arguments: str) -> tuple[int, str]:
    ended = CliRunner().invoke(app, ["terrain", *arguments])
    return ended.exit_code, ended.output


@pytest.fixture
def tile(tmp_path: Path) -> str:
    path = tmp_path / "tile.npz"
    y, x = np.mgrid[:60, :60]
    heights = np.sin(x / 9.0) + np.cos(y / 8.0)
    heights[5, 5] = np.nan
    np.savez(path, dem=heights, dem_gsd=2.0)
    return str(path)


def test_list_names_every_site() -> None:
    status, printed = invoke("list")
    assert status == 0
    for name in sites():
        assert name in printed


def test_stats_of_a_site_stand_next_to_the_papers() -> None:
    status, printed = invoke("stats", "meridiani", "--json")
    assert status == 0
    record = json.loads(printed)
    assert record["site"] == "meridiani"
    assert record["paper"]["mean_slope_deg"] == [1.0, 2.0]
    assert 1.0 <= record["measured"]["mean_slope_30_m_deg"] <= 2.0
    assert record["real"] is None


def test_stats_of_a_file_say_what_is_real_and_what_was_filled(tile: str) -> None:
    status, printed = invoke("stats", tile)
    assert status == 0
    message = " ".join(printed.split())
    assert "Filled: 1 posts without height" in message
    assert "mean slope over 30 m, deg" in message
    assert "synthetic around it" in message
    assert json.loads(invoke("stats", tile, "--json")[1])["real"]["posting_m"] == 2.0


def test_holes_are_refused_or_counted_and_shown(tmp_path: Path) -> None:
    """A tile half of which has no height, as reprojection leaves it."""
    path, picture = tmp_path / "half.npz", tmp_path / "half.png"
    heights = np.add.outer(np.sin(np.arange(64) / 5.0), np.cos(np.arange(64) / 6.0))
    heights[:, :31] = np.nan
    np.savez(path, dem=heights, dem_gsd=2.0)
    status, printed = invoke("stats", str(path))
    assert status == 2
    assert "48.4% of its posts have no height; allowed: up to 5.0%" in printed
    status, printed = invoke("stats", str(path), "--max-holes", "0.5", "--picture", str(picture))
    assert status == 0, printed
    assert "1984 posts without height (48.4%)" in " ".join(printed.split())
    shown = cv2.imread(str(picture))
    assert shown is not None
    red = (shown[..., 2].astype(int) - shown[..., 1]) > 40
    # 128 samples a side; a line of the outline covers some
    assert red.sum() == pytest.approx(31 * 64, rel=0.1)
    west = np.flatnonzero(red.any(axis=0))
    assert west[0] == pytest.approx(32, abs=1)
    assert invoke("stats", str(path), "--max-holes", "0.5", "--picture", str(picture))[0] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("stats", "jezero"), "no site is called 'jezero'; allowed: pisgah"),
        (("stats", "mars-yard", "--scale", "descent"), "has no terrain at the scale 'descent'"),
        (("stats", "nowhere.npz"), "nowhere.npz: no such file"),
    ],
)
def test_says_what_is_wrong(arguments: tuple[str, ...], message: str) -> None:
    status, printed = invoke(*arguments)
    assert status == 2
    assert message in printed
