"""Tests of terrain files from users: valid files pass; invalid files are rejected before their data are read."""

import io
import math
import re
import warnings
import zipfile
from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pydantic import ValidationError
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.warp import transform

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios import terrain_files
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.terrain_files import check_source, grid_north_deg, load_site
from marsyard.sim.terrain.rasters import RealTerrain, TerrainFileError, read_rasters

#: Mars, equidistant cylindrical about the equator, in metres (IAU 2000 sphere).
MARS = "+proj=eqc +lat_ts=0 +lon_0=0 +R=3396190 +units=m +no_defs"


def write_tif(folder: Path, name: str = "dtm.tif", **changes: Any) -> Path:
    """Write a DTM of 40 x 50 posts with GDAL."""
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
        warnings.simplefilter("ignore")  # Some tests need files without a geotransform.
        with rasterio.open(path, "w", **profile) as file:
            file.write(values, 1)
            for key, value in tags.items():
                setattr(file, key, value)
    return path


@pytest.mark.parametrize("projection", ["airy +lat_0=10", "vandg2", "adams_ws1"])
def test_projections_without_inverse_are_refused(tmp_path: Path, projection: str) -> None:
    path = write_tif(tmp_path, crs=CRS.from_string(f"+proj={projection} +R=3396190 +units=m +no_defs"))
    with pytest.raises(TerrainFileError, match=r"projection has no inverse in PROJ .*; allowed: a projection"):
        check_source(RealTerrain(dtm=path))


def write_pds3_dtm(folder: Path, heights: np.ndarray) -> Path:
    """Write a DTM as PDS3 product with posts every 2 m, in the form of HiRISE's; missing heights are NaN."""
    rows, columns = heights.shape
    label = f"""PDS_VERSION_ID = PDS3
RECORD_TYPE = FIXED_LENGTH
RECORD_BYTES = 4096
^IMAGE = 2
OBJECT = IMAGE_MAP_PROJECTION
  MAP_PROJECTION_TYPE = "EQUIRECTANGULAR"
  A_AXIS_RADIUS = 3396.19 <KM>
  B_AXIS_RADIUS = 3396.19 <KM>
  C_AXIS_RADIUS = 3396.19 <KM>
  CENTER_LATITUDE = 0.0 <DEG>
  CENTER_LONGITUDE = 137.0 <DEG>
  COORDINATE_SYSTEM_NAME = PLANETOCENTRIC
  POSITIVE_LONGITUDE_DIRECTION = EAST
  MAP_SCALE = 2.0 <METERS/PIXEL>
  LINE_PROJECTION_OFFSET = 0.5 <PIXEL>
  SAMPLE_PROJECTION_OFFSET = 0.5 <PIXEL>
END_OBJECT = IMAGE_MAP_PROJECTION
OBJECT = IMAGE
  LINES = {rows}
  LINE_SAMPLES = {columns}
  SAMPLE_TYPE = PC_REAL
  SAMPLE_BITS = 32
  BANDS = 1
  MISSING_CONSTANT = 16#FF7FFFFB#
END_OBJECT = IMAGE
END
"""
    missing = np.array([0xFF7FFFFB], dtype="<u4").view("<f4")[0]
    samples = np.where(np.isnan(heights), missing, heights).astype("<f4")
    path = folder / "DTEEC_SMALL.IMG"
    path.write_bytes(label.encode().ljust(4096) + samples.tobytes())
    return path


def test_pds3_products_are_terrain_models(tmp_path: Path) -> None:
    heights = np.add.outer(np.linspace(-2000.0, -1990.0, 48), np.linspace(0.0, 5.0, 64))
    heights[3, 4] = np.nan
    path = write_pds3_dtm(tmp_path, heights)
    raster, _ = read_rasters(RealTerrain(dtm=path))
    assert raster.posting_m == 2.0
    np.testing.assert_allclose(raster.values[::-1], heights, atol=1e-3)
    assert load_site(str(path)).terrain().source == RealTerrain(dtm=path)


def test_other_files_are_refused_with_the_command_that_converts_them(tmp_path: Path) -> None:
    (tmp_path / "dtm.asc").write_text("ncols 4")
    for name in (str(tmp_path / "dtm.asc"), "absent.jp2", "folder/gusev"):
        with pytest.raises(TerrainFileError, match=r"is not a terrain model; allowed: .npz, .tif, .*rio convert"):
            load_site(name)
    with pytest.raises(ValueError, match="no site is called 'gusow'; allowed: pisgah"):
        load_site("gusow")


def test_hirise_tile_is_valid(shared_data: Path) -> None:
    folder = shared_data / "gale_hirise"
    check_source(RealTerrain(dtm=folder / "dem.tif"))
    check_source(RealTerrain(dtm=folder / "gale_1m_dem_0p5m_ortho.npz"))


@pytest.mark.parametrize("name", ["dimes-hirise", "hda-hirise"])
def test_campaigns_over_the_tile_are_valid(shared_data: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The campaigns contain paths relative to the repository."""
    monkeypatch.chdir(shared_data.parents[1] / Path(__file__).parents[2].name)
    loaded = load_campaign(f"docs/examples/{name}.toml")
    assert loaded.draws(7)


def test_dtm_with_orthoimage_is_valid(tmp_path: Path) -> None:
    ortho = write_tif(tmp_path, "ortho.tif", values=np.full((100, 80), 120, dtype=np.uint8), nodata=0)
    check_source(RealTerrain(dtm=write_tif(tmp_path), ortho=ortho))


GEOTIFF_FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"crs": CRS.from_string("+proj=longlat +R=3396190 +no_defs")}, r"is in degrees; project it to metres"),
    ({"crs": None}, "has no projection"),
    ({"crs": CRS.from_string("+proj=geocent +R=3396190 +units=m +no_defs")}, "are not those of a map projection"),
    (
        {"crs": CRS.from_epsg(3857), "transform": Affine(1.0, 0.0, 1_000_000.0, 0.0, -1.0, 8_399_738.0)},
        r"stretches lengths by 2\.000 to 2\.000",
    ),
    ({"transform": Affine(1.0, 0.1, 0.0, -0.1, -1.0, 0.0)}, "rotated or oblong cells"),
    ({"transform": Affine(1.0, 0.0, 0.0, 0.0, -2.0, 0.0)}, "rotated or oblong cells"),
    ({"values": np.full((3, 40), 1.0, dtype=np.float32)}, "has 40 x 3 values; allowed: at least 4 x 4"),
    ({"values": np.full((8, 6000), 1.0, dtype=np.float32)}, "at most 5461 along a side"),
    ({"values": np.full((50, 40), 120, dtype=np.uint8), "nodata": None}, "8-bit values, as in an image"),
    ({"values": np.full((50, 40), -32767.0, dtype=np.float32)}, "has no valid height at all"),
    ({"tags": {"units": ("ft",)}}, "heights are in 'ft'; allowed: metres"),
    (
        {"crs": CRS.from_string("EPSG:32610+5715"), "transform": Affine(1.0, 0.0, 500_000.0, 0.0, -1.0, 4_000_000.0)},
        "its vertical axis points down",
    ),
    ({"tags": {"scales": (0.1,)}}, "has scale 0.1 and offset 0; apply them"),
]


@pytest.mark.parametrize(("changes", "fault"), GEOTIFF_FAULTS, ids=[fault for _, fault in GEOTIFF_FAULTS])
def test_terrain_file_faults_are_reported(tmp_path: Path, changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(TerrainFileError, match=fault) as error_info:
        check_source(RealTerrain(dtm=write_tif(tmp_path, **changes)))
    assert "dtm.tif" in str(error_info.value)


MOON_SPHERE, MARS_ELLIPSOID = "+R=1737400", "+a=3396190 +b=3376200"
#: Projection; longitude, latitude and grid convergence of its file, deg. The convergence of polar and conic projections
#: is (lon - lon_0) times the cone constant n. Transverse Mercator: Eq. 8-9 of Snyder (1987).
CONFORMAL_PROJECTIONS: list[tuple[str, float, float, float]] = [
    *[("+proj=stere +lat_0=90 +lon_0=0 +k=1", lon, 85.0, lon) for lon in (0.0, 45.0, 90.0, 177.0, -120.0)],
    *[("+proj=stere +lat_0=-90 +lon_0=0 +k=1", lon, -85.0, -lon) for lon in (0.0, 45.0, 90.0, 177.0, -120.0)],
    # One standard parallel: n = sin 45 deg.
    *[("+proj=lcc +lat_1=45 +lat_0=45 +lon_0=10", lon, 45.0, (lon - 10.0) * 0.5**0.5) for lon in (-50.0, 10.0, 80.0)],
    *[
        (
            "+proj=tmerc +lat_0=0 +lon_0=137 +k=0.9996",
            137.0 + lon_offset,
            60.0,
            math.degrees(math.atan(math.tan(math.radians(lon_offset)) * math.sin(math.radians(60.0)))),
        )
        for lon_offset in (-5.0, 0.0, 5.0)
    ],
]


@pytest.mark.parametrize("body", [MOON_SPHERE, MARS_ELLIPSOID], ids=["moon", "mars"])
@pytest.mark.parametrize(("projection", "lon", "lat", "convergence"), CONFORMAL_PROJECTIONS)
def test_conformal_maps_are_valid_with_their_grid_convergence(
    tmp_path: Path, projection: str, lon: float, lat: float, convergence: float, body: str
) -> None:
    crs = CRS.from_string(f"{projection} {body} +units=m")
    (x,), (y,) = transform(CRS.from_string(f"+proj=longlat {body} +no_defs"), crs, [lon], [lat])
    path = write_tif(tmp_path, crs=crs, transform=Affine(2.0, 0.0, x - 40.0, 0.0, -2.0, y + 50.0))
    check_source(RealTerrain(dtm=path))
    # The formulas are spherical. The flattening of Mars changes the convergence by thousandths of a degree.
    assert grid_north_deg(path) == pytest.approx(convergence, abs=0.01)


def test_map_centred_on_the_pole_is_valid_without_true_north(tmp_path: Path) -> None:
    crs = CRS.from_string(f"+proj=stere +lat_0=-90 +lon_0=0 +k=1 {MOON_SPHERE} +units=m")
    path = write_tif(tmp_path, crs=crs, transform=Affine(5.0, 0.0, -100.0, 0.0, -5.0, 125.0))
    check_source(RealTerrain(dtm=path))
    assert grid_north_deg(path) is None


def test_sheared_map_is_rejected(tmp_path: Path) -> None:
    """Sinusoidal projection at longitude 10 deg and latitude 60 deg: equal area, but x and y are not perpendicular."""
    crs = CRS.from_string(f"+proj=sinu +lon_0=0 {MOON_SPHERE} +units=m")
    (x,), (y,) = transform(CRS.from_string(f"+proj=longlat {MOON_SPHERE} +no_defs"), crs, [10.0], [60.0])
    path = write_tif(tmp_path, crs=crs, transform=Affine(2.0, 0.0, x - 40.0, 0.0, -2.0, y + 50.0))
    # The shear s = lon sin(lat) = 0.1511 has the singular values (sqrt(4 + s**2) -+ s) / 2.
    with pytest.raises(TerrainFileError, match=r"stretches lengths by 0\.927 to 1\.078"):
        check_source(RealTerrain(dtm=path))


def write_npz(folder: Path, **arrays: Any) -> Path:
    path = folder / "dtm.npz"
    contents: dict[str, Any] = {"dem": np.zeros((20, 30)), "dem_gsd": 1.0} | arrays
    np.savez_compressed(path, **contents)
    return path


NPZ_FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"dem": np.full((20, 30), np.nan)}, "has no valid height at all"),
    ({"dem": np.full((20, 30), "high")}, "dem contains values of type <U4; allowed: real numbers"),
    ({"dem": np.zeros((20, 30), dtype=complex)}, "dem contains values of type complex128"),
    ({"dem": np.zeros((20, 30, 3))}, r"dem has a grid of shape \(20, 30, 3\); allowed: two dimensions"),
    ({"dem": np.full((20, 30), 1e300)}, r"contains heights of 1e\+300 m"),
    ({"dem": np.where(np.eye(20, 30) > 0, -32767.0, 5.0)}, "contains heights of -32767 m"),
    ({"dem": np.array([[{}] * 30] * 20, dtype=object)}, "dem contains values of type object"),
    ({"dem_gsd": np.array("one")}, "dem_gsd contains values of type <U3"),
    ({"dem_gsd": np.array([1.0, 1.0])}, r"dem_gsd has the shape \(2,\); allowed: one number"),
    ({"dem_gsd": -1.0}, "dem_gsd is -1.0; allowed: metres between posts, above 0"),
    ({"ortho": np.zeros((20, 30))}, "has an ortho, but no ortho_gsd"),
    ({"ortho": np.zeros((20, 30)), "ortho_gsd": np.nan}, "ortho_gsd is nan"),
    ({"ortho": np.ones((20, 30)), "ortho_gsd": 1.0, "ortho_valid": np.ones((4, 4), dtype=bool)}, "different shapes"),
]


@pytest.mark.parametrize(("arrays", "fault"), NPZ_FAULTS, ids=[fault for _, fault in NPZ_FAULTS])
def test_invalid_npz_archives_are_rejected(tmp_path: Path, arrays: dict[str, Any], fault: str) -> None:
    with pytest.raises(TerrainFileError, match=fault) as error_info:
        check_source(RealTerrain(dtm=write_npz(tmp_path, **arrays)))
    assert "dtm.npz" in str(error_info.value)


def test_oversized_archive_is_rejected_from_its_headers(tmp_path: Path) -> None:
    """The header specifies 20000 x 20000 zeros (3.2 GB); the archive contains only the header and one value."""
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, shape in (("dem", (20000, 20000)), ("dem_gsd", ())):
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
            archive.writestr(f"{name}.npy", header.getvalue() + np.ones(1).tobytes())
    with pytest.raises(TerrainFileError, match=r"dem has a grid of shape \(20000, 20000\)"):
        check_source(RealTerrain(dtm=path))


def test_missing_nodata_is_detected_from_implausible_heights(tmp_path: Path) -> None:
    values = np.full((50, 40), -4450.0, dtype=np.float32)
    values[10, 10] = -32767.0
    with pytest.raises(TerrainFileError, match=r"contains heights of -32767 m; .*it has no nodata value"):
        check_source(RealTerrain(dtm=write_tif(tmp_path, values=values, nodata=None)))
    check_source(RealTerrain(dtm=write_tif(tmp_path, "with_nodata.tif", values=values)))


def test_image_with_another_projection_is_rejected(tmp_path: Path) -> None:
    other_projection = CRS.from_string(MARS.replace("lon_0=0", "lon_0=137"))
    values = np.full((100, 80), 120, dtype=np.uint8)
    ortho = write_tif(tmp_path, "ortho.tif", values=values, nodata=0, crs=other_projection)
    with pytest.raises(TerrainFileError, match=r"ortho.tif: its projection differs from that of .*dtm.tif"):
        check_source(RealTerrain(dtm=write_tif(tmp_path), ortho=ortho))


def test_oversized_image_is_rejected_from_its_header(tmp_path: Path) -> None:
    """A sparse file with a header for 32768 x 32768 bytes."""
    path = tmp_path / "huge.tif"
    profile = {"driver": "GTiff", "height": 32768, "width": 32768, "count": 1, "dtype": "uint8", "SPARSE_OK": "TRUE"}
    position = {"crs": CRS.from_string(MARS), "transform": Affine(0.25, 0.0, 0.0, 0.0, -0.25, 0.0)}
    with rasterio.open(path, "w", **profile, **position):
        pass
    with pytest.raises(TerrainFileError, match=r"huge.tif: has 32768 x 32768 values; allowed: at most 8192"):
        check_source(RealTerrain(dtm=write_tif(tmp_path), ortho=path))


@pytest.mark.parametrize(
    ("name", "contents", "fault"),
    [
        ("empty.tif", b"", "is empty"),
        ("no.tif", b"hello", "is not a valid GeoTIFF"),
        ("no.npz", b"hello", "is not a valid .npz archive"),
        ("empty.npz", b"", "is empty"),
        ("absent.tif", None, "absent.tif: no such file"),
    ],
)
def test_invalid_files_are_rejected(tmp_path: Path, name: str, contents: bytes | None, fault: str) -> None:
    if contents is not None:
        (tmp_path / name).write_bytes(contents)
    with pytest.raises(TerrainFileError, match=fault):
        check_source(RealTerrain(dtm=tmp_path / name))


def test_campaigns_reject_invalid_terrain_on_load(tmp_path: Path) -> None:
    path = write_tif(tmp_path, crs=None)
    with pytest.raises(ValidationError, match=r"dtm.tif: has no projection"):
        DescentScenarioParameters.model_validate({"terrain": {"source": {"dtm": str(path)}}})


def test_messages_mention_only_installed_rio_commands() -> None:
    commands = set(re.findall(r"\brio ([a-z]+(?:-[a-z]+)*)", Path(terrain_files.__file__).read_text()))
    assert "warp" in commands
    assert commands <= {command.name for command in entry_points(group="rasterio.rio_commands")}
