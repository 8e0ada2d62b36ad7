"""Own terrain: the real tile passes, and files that cannot be meant are refused with their names, unread."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pydantic import ValidationError
from rasterio.crs import CRS
from rasterio.transform import Affine

from campaigns.definition.loading import load_campaign
from scenarios.descent import DescentScenarioParameters
from scenarios.terrain_files import check_source
from sim.terrain.imported import RealTerrain, TerrainFileError

#: Mars, equidistant cylindrical about the equator, in metres (IAU 2000 sphere).
MARS = "+proj=eqc +lat_ts=0 +lon_0=0 +R=3396190 +units=m +no_defs"


def tif(folder: Path, name: str = "dtm.tif", **changes: Any) -> Path:
    """A DTM of 40 x 50 posts, written by GDAL."""
    path = folder / name
    values = changes.pop("values", np.full((50, 40), -4450.0, dtype=np.float32))
    tags: Mapping[str, Any] = changes.pop("tags", {})
    profile = {
        "driver": "GTiff",
        "height": values.shape[0],
        "width": values.shape[1],
        "count": 1,
        "dtype": values.dtype,
        "crs": CRS.from_string(MARS),
        "transform": Affine(1.0, 0.0, 8_142_406.0, 0.0, -1.0, -276_455.0),
        "nodata": -32767.0,
    } | changes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # files without a place are meant to be
        with rasterio.open(path, "w", **profile) as file:
            file.write(values, 1)
            for key, value in tags.items():
                setattr(file, key, value)
    return path


def test_the_hirise_tile_passes(shared_data: Path) -> None:
    folder = shared_data / "gale_hirise"
    check_source(RealTerrain(dtm=folder / "dem.tif"))
    check_source(RealTerrain(dtm=folder / "gale_1m_dem_0p5m_ortho.npz"))


@pytest.mark.parametrize("name", ["dimes-hirise", "hda-hirise"])
def test_campaigns_over_the_tile_are_complete(shared_data: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """They name its file from the checkout's own folder, as they are run."""
    monkeypatch.chdir(shared_data.parents[1] / Path(__file__).parents[2].name)
    loaded = load_campaign(f"docs/examples/{name}.toml")
    assert loaded.draws(7)


def test_a_dtm_and_its_picture_pass(tmp_path: Path) -> None:
    picture = tif(tmp_path, "ortho.tif", values=np.full((100, 80), 120, dtype=np.uint8), nodata=0)
    check_source(RealTerrain(dtm=tif(tmp_path), ortho=picture))


FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"crs": CRS.from_string("+proj=longlat +R=3396190 +no_defs")}, r"is in degrees; project it to metres"),
    ({"crs": None}, "states no projection"),
    ({"crs": CRS.from_string("+proj=geocent +R=3396190 +units=m +no_defs")}, "coordinates are no map projection's"),
    (
        {"crs": CRS.from_epsg(3857), "transform": Affine(1.0, 0.0, 1_000_000.0, 0.0, -1.0, 8_399_738.0)},
        r"stretches lengths by 2\.000 to the east",
    ),
    ({"transform": Affine(1.0, 0.1, 0.0, -0.1, -1.0, 0.0)}, "rotated or oblong cells"),
    ({"transform": Affine(1.0, 0.0, 0.0, 0.0, -2.0, 0.0)}, "rotated or oblong cells"),
    ({"values": np.full((3, 40), 1.0, dtype=np.float32)}, "has 40 x 3 values; at least 4 x 4"),
    ({"values": np.full((8, 6000), 1.0, dtype=np.float32)}, "at most 5461 along a side"),
    ({"values": np.full((50, 40), 120, dtype=np.uint8), "nodata": None}, "8-bit values, which are a picture's"),
    ({"values": np.full((50, 40), -32767.0, dtype=np.float32)}, "has no valid height at all"),
    ({"tags": {"units": ("ft",)}}, "heights are in 'ft'; metres are needed"),
    ({"tags": {"scales": (0.1,)}}, "states scale 0.1 and offset 0; apply them"),
]


@pytest.mark.parametrize(("changes", "fault"), FAULTS, ids=[fault for _, fault in FAULTS])
def test_faults_are_named(tmp_path: Path, changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(TerrainFileError, match=fault) as raised:
        check_source(RealTerrain(dtm=tif(tmp_path, **changes)))
    assert "dtm.tif" in str(raised.value)


def test_missing_nodata_is_told_by_impossible_heights(tmp_path: Path) -> None:
    values = np.full((50, 40), -4450.0, dtype=np.float32)
    values[10, 10] = -32767.0
    with pytest.raises(TerrainFileError, match=r"holds heights of -32767 m and states no nodata value"):
        check_source(RealTerrain(dtm=tif(tmp_path, values=values, nodata=None)))
    check_source(RealTerrain(dtm=tif(tmp_path, "stated.tif", values=values)))


def test_pictures_of_another_projection_are_refused(tmp_path: Path) -> None:
    other = CRS.from_string(MARS.replace("lon_0=0", "lon_0=137"))
    picture = tif(tmp_path, "ortho.tif", values=np.full((100, 80), 120, dtype=np.uint8), nodata=0, crs=other)
    with pytest.raises(TerrainFileError, match=r"ortho.tif: its projection is not that of .*dtm.tif"):
        check_source(RealTerrain(dtm=tif(tmp_path), ortho=picture))


def test_a_picture_of_a_gigabyte_is_refused_by_its_header(tmp_path: Path) -> None:
    """32768 x 32768 bytes, none of which are written."""
    path = tmp_path / "huge.tif"
    profile = {"driver": "GTiff", "height": 32768, "width": 32768, "count": 1, "dtype": "uint8", "SPARSE_OK": "TRUE"}
    place = {"crs": CRS.from_string(MARS), "transform": Affine(0.25, 0.0, 0.0, 0.0, -0.25, 0.0)}
    with rasterio.open(path, "w", **profile, **place):
        pass
    with pytest.raises(TerrainFileError, match=r"huge.tif: has 32768 x 32768 values; at most 8192 along a side"):
        check_source(RealTerrain(dtm=tif(tmp_path), ortho=path))


@pytest.mark.parametrize(
    ("name", "contents", "fault"),
    [
        ("empty.tif", b"", "is empty"),
        ("no.tif", b"hello", "is no GeoTIFF"),
        ("no.npz", b"hello", "is no .npz archive"),
        ("empty.npz", b"", "is empty"),
    ],
)
def test_files_that_are_none(tmp_path: Path, name: str, contents: bytes, fault: str) -> None:
    (tmp_path / name).write_bytes(contents)
    with pytest.raises(TerrainFileError, match=fault):
        check_source(RealTerrain(dtm=tmp_path / name))
    with pytest.raises(TerrainFileError, match=r"absent.tif: no such file"):
        check_source(RealTerrain(dtm=tmp_path / "absent.tif"))


def test_campaigns_refuse_them_when_they_are_read(tmp_path: Path) -> None:
    path = tif(tmp_path, crs=None)
    with pytest.raises(ValidationError, match=r"dtm.tif: states no projection"):
        DescentScenarioParameters.model_validate({"terrain": {"source": {"dtm": str(path)}}})
