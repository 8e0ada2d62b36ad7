"""Tests of terrain from elevation models (DTM): heights at posts, holes, brightness, border to synthetic terrain."""

import sys
from pathlib import Path

import numpy as np
import pytest

from marsyard.sim.terrain import Surface, TerrainBank, TerrainParameters, synthesise
from marsyard.sim.terrain.imported import choose_grid, embed, fill_holes
from marsyard.sim.terrain.rasters import RealTerrain, TerrainFileError, read_rasters
from marsyard.sim.terrain.statistics import terrain_statistics

#: Size of the synthetic elevation model of the tests, in posts (1 m apart in `tile.npz`).
ROWS, COLUMNS = 90, 110


def make_dem() -> np.ndarray:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return np.asarray(100.0 + 3.0 * np.sin(x / 9.0) + 2.0 * np.cos(y / 7.0) + 0.05 * x)


@pytest.fixture
def npz(tmp_path: Path) -> Path:
    """Write a file with row 0 in the north, a hole of six posts, and an image at half spacing, brighter in the east."""
    heights = make_dem().astype(np.float32)
    heights[40:42, 50:53] = np.nan
    image = np.broadcast_to(np.linspace(80, 160, 2 * COLUMNS), (2 * ROWS, 2 * COLUMNS)).astype(np.uint8).copy()
    valid = np.ones(image.shape, dtype=bool)
    valid[:4] = False
    path = tmp_path / "tile.npz"
    np.savez(path, dem=heights, dem_gsd=1.0, ortho=image, ortho_gsd=0.5, ortho_valid=valid)
    return path


def make_terrain_parameters(source: RealTerrain, **changes: object) -> TerrainParameters:
    values: dict[str, object] = {"samples": 256, "spacing_m": 1.0, "craters_per_km2": 0.0, "outer_scale_m": 100.0}
    return TerrainParameters.model_validate({**values, "source": source, **changes})


def build_surface(parameters: TerrainParameters) -> Surface:
    return synthesise(parameters, np.random.default_rng(1))


def test_surface_interpolates_the_posts(npz: Path) -> None:
    source = RealTerrain(dtm=npz, border_m=10.0, roughen=False)
    extent = embed(source, 256, 1.0).extent
    assert (extent.holes, extent.ortho_holes) == (6, 8 * COLUMNS)
    surface = build_surface(make_terrain_parameters(source))
    heights, _ = fill_holes(read_rasters(source)[0].values)
    x, y = np.meshgrid(extent.west_m + np.arange(11, COLUMNS - 11), extent.south_m + np.arange(11, ROWS - 11))
    expected = heights[11:-11, 11:-11] - heights.mean()
    np.testing.assert_allclose(surface.height(x, y), expected, atol=1e-4)
    # The first row of the file is the northernmost row.
    np.testing.assert_allclose(heights[-1], make_dem()[0], atol=1e-4)


@pytest.mark.parametrize("spacing_m", [0.5, 1.5])
def test_resampling_preserves_the_heights(npz: Path, spacing_m: float) -> None:
    source = RealTerrain(dtm=npz, border_m=10.0, roughen=False)
    surface = build_surface(make_terrain_parameters(source, samples=512 if spacing_m < 1 else 128, spacing_m=spacing_m))
    extent = embed(source, surface.levels[0].shape[0], spacing_m).extent
    x, y = np.meshgrid(np.arange(15.0, 45.0), np.arange(15.0, 35.0))
    expected = 3.0 * np.sin(x / 9.0) + 2.0 * np.cos((ROWS - 1 - y) / 7.0) + 0.05 * x + 100.0
    actual = surface.height(extent.west_m + x, extent.south_m + y)
    # The shortest waves are 44 m long, so cubic interpolation is accurate to centimetres.
    np.testing.assert_allclose(actual - actual.mean(), expected - expected.mean(), atol=0.02)


def test_border_of_the_imported_terrain_has_no_step(npz: Path) -> None:
    source = RealTerrain(dtm=npz, border_m=15.0)
    surface = build_surface(make_terrain_parameters(source, rms_slope_deg=3.0))
    x, y = np.meshgrid(np.arange(256.0), np.arange(256.0))
    slope = np.degrees(np.arctan(np.hypot(*np.moveaxis(surface.gradient(x, y), -1, 0))))
    # The DTM has slopes of up to 25 deg. A step of one metre between two posts would have a slope of 45 deg.
    assert slope.max() < 42.0


def test_roughness_finer_than_the_posts_is_optional(npz: Path) -> None:
    smooth, rough = (
        build_surface(
            make_terrain_parameters(RealTerrain(dtm=npz, roughen=fine), samples=1024, spacing_m=0.25, rms_slope_deg=4.0)
        )
        for fine in (False, True)
    )
    middle = np.s_[480:560, 480:560, 0]
    roughness_m = rough.levels[0][middle] - smooth.levels[0][middle]
    assert 0.003 < roughness_m.std() < 0.3
    assert abs(roughness_m.mean()) < 0.2 * roughness_m.std(), "the roughness does not change the mean height"


def test_brightness_uses_the_image_offset(npz: Path) -> None:
    source = RealTerrain(dtm=npz, border_m=5.0, roughen=False)
    surface = build_surface(make_terrain_parameters(source, albedo=0.2, albedo_contrast=0.0))
    extent = embed(source, 256, 1.0).extent
    row = surface.albedo(extent.west_m + np.arange(10.0, 100.0), np.full(90, extent.south_m + 40.0))
    assert row[-1] / row[0] == pytest.approx((80 + 80 * 99.5 / 110) / (80 + 80 * 9.5 / 110), rel=0.02)
    offset_surface = build_surface(
        make_terrain_parameters(source.model_copy(update={"ortho_east_m": 8.0}), albedo=0.2, albedo_contrast=0.0)
    )
    offset_row = offset_surface.albedo(extent.west_m + np.arange(10.0, 90.0), np.full(80, extent.south_m + 40.0))
    np.testing.assert_allclose(offset_row, row[8:88], rtol=0.02)


def test_changed_file_produces_another_terrain(npz: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path / "cache"))
    bank = TerrainBank(make_terrain_parameters(RealTerrain(dtm=npz)), seed=1)
    original = bank.store(0).levels[0].tobytes()
    np.savez(npz, dem=make_dem() * 2.0, dem_gsd=1.0)
    assert bank.store(0).levels[0].tobytes() != original


def test_hirise_tile_is_imported(shared_data: Path) -> None:
    """The orthoimage of the tile is about 2 m east and 1 m south of its heights."""
    source = RealTerrain(
        dtm=shared_data / "gale_hirise" / "gale_1m_dem_0p5m_ortho.npz", ortho_east_m=2.0, ortho_north_m=-1.0
    )
    assert choose_grid(source) == (1024, 1.0)
    surface = build_surface(make_terrain_parameters(source, samples=512))
    extent = embed(source, 512, 1.0).extent
    assert (extent.east_m - extent.west_m, extent.north_m - extent.south_m) == (347.0, 336.0)
    inner_heights = surface.levels[0][100:400, 100:400, 0]
    assert np.ptp(inner_heights) == pytest.approx(-4437.883 + 4472.67, abs=1.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"dem": np.zeros((9, 9))}, "does not contain dem_gsd"),
        ({"dem": np.zeros(9), "dem_gsd": 1.0}, r"grid of shape \(9,\)"),
        ({"dem": np.zeros((9, 9)), "dem_gsd": np.nan}, "a distance of nan m between grid points; it must be positive"),
        ({"dem": np.zeros((9, 9)), "dem_gsd": 9.0, "ortho": np.ones((9, 9)), "ortho_gsd": 0.0}, "distance of 0 m"),
        ({"dem": np.full((9, 9), np.nan), "dem_gsd": 1.0}, "no valid height"),
        ({"dem": np.zeros((400, 9)), "dem_gsd": 1.0}, r"increase terrain\.samples"),
        ({"dem": np.zeros((9, 9)), "dem_gsd": 1.0}, "wider than twice the border"),
    ],
)
def test_file_errors_are_reported(tmp_path: Path, content: dict[str, object], message: str) -> None:
    path = tmp_path / "wrong.npz"
    np.savez(path, **content)  # type: ignore[arg-type]
    with pytest.raises(TerrainFileError, match=message):
        embed(RealTerrain(dtm=path), 256, 1.0)


def test_terrain_with_coarser_samples_than_the_dtm_is_wide_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "narrow.npz"
    np.savez(path, dem=np.zeros((40, 5)), dem_gsd=0.7)
    with pytest.raises(TerrainFileError, match=r"27\.3 m; it must be wider than terrain\.spacing_m, 3 m"):
        embed(RealTerrain(dtm=path, border_m=0.4), 128, 3.0)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(TerrainFileError, match="does not exist"):
        read_rasters(RealTerrain(dtm=tmp_path / "none.npz"))


def test_missing_geotiff_reader_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dtm.tif").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(TerrainFileError, match="pip install rasterio"):
        read_rasters(RealTerrain(dtm=tmp_path / "dtm.tif"))


# The package affine warns about its operators.
@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_geotiff_units_and_holes_are_read(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    heights = make_dem().astype(np.float32)
    heights[3, 4] = -9999.0
    path = tmp_path / "dtm.tif"
    size = {"driver": "GTiff", "height": ROWS, "width": COLUMNS, "count": 1, "dtype": "float32", "nodata": -9999.0}
    origin = rasterio.transform.from_origin(5000.0, 9000.0, 2.0, 2.0)
    with rasterio.open(path, "w", **size, crs="EPSG:32611", transform=origin) as file:
        file.write(heights, 1)
    raster, ortho = read_rasters(RealTerrain(dtm=path))
    assert ortho is None
    assert raster.posting_m == 2.0
    assert (raster.west_m, raster.south_m) == (5001.0, 9000.0 - 2.0 * ROWS + 1.0)
    assert np.isnan(raster.values[ROWS - 4, 4])
    np.testing.assert_allclose(raster.values[-1], heights[0])
    with rasterio.open(path, "r+") as file:
        file.crs = "EPSG:4326"
    with pytest.raises(TerrainFileError, match="in degrees"):
        read_rasters(RealTerrain(dtm=path))


def test_statistics_use_only_valid_posts(tmp_path: Path) -> None:
    """If half of a tile is missing, slopes and relief are those of the valid half."""
    x, y = np.meshgrid(np.arange(160.0), np.arange(140.0))
    heights = 3.0 * np.sin(x / 9.0) + 2.0 * np.cos(y / 7.0)
    heights[:, 80:] = np.nan
    path = tmp_path / "half.npz"
    np.savez(path, dem=heights, dem_gsd=1.0)
    source = RealTerrain(dtm=path, border_m=2.0, roughen=False, max_hole_fraction=0.6)
    embedding = embed(source, 256, 1.0)
    assert embedding.extent.hole_fraction == pytest.approx(0.5)
    assert embedding.real_samples(256).sum() == np.isfinite(heights).sum()
    assert embedding.filled_samples(256).sum() == np.isnan(heights).sum()
    statistics = terrain_statistics(build_surface(make_terrain_parameters(source)), embedding.real_samples(256))
    valid_heights = heights[:, :80]
    rises = (valid_heights[30:] - valid_heights[:-30], valid_heights[:, 30:] - valid_heights[:, :-30])
    expected = np.mean([np.degrees(np.arctan(np.abs(rise) / 30.0)).mean() for rise in rises])
    # The outermost 2 m blend into the synthetic terrain.
    assert statistics.mean_slope_30_m_deg == pytest.approx(expected, rel=0.02)
    assert statistics.relief_m == pytest.approx(float(np.ptp(valid_heights)), rel=0.02)


def test_many_holes_are_rejected_unless_allowed(tmp_path: Path) -> None:
    heights = make_dem()
    heights[:, :9] = np.nan  # 8.2 % of 110 columns
    path = tmp_path / "holes.npz"
    np.savez(path, dem=heights, dem_gsd=1.0)
    with pytest.raises(TerrainFileError, match=r"holes.npz: 8.2% of its posts have no height; allowed: up to 5.0%"):
        embed(RealTerrain(dtm=path), 256, 1.0)
    assert embed(RealTerrain(dtm=path, max_hole_fraction=0.1), 256, 1.0).extent.holes == 9 * ROWS
