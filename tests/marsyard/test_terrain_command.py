"""`marsyard terrain`: what it prints, and how it ends."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from marsyard.cli import app
from sim.terrain import sites


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


def test_stats_of_a_site_stand_beside_the_papers() -> None:
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
    said = " ".join(printed.split())
    assert "Filled: 1 posts without height" in said
    assert "mean slope over 30 m, deg" in said
    assert "synthetic around it" in said
    assert json.loads(invoke("stats", tile, "--json")[1])["real"]["posting_m"] == 2.0


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
