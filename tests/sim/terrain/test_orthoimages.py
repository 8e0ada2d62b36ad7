"""Tests of orthoimages: position relative to the DTM, scaled integers, palettes, colours and transparency."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

from marsyard.scenarios.terrain_files import check_source
from marsyard.sim.terrain import TerrainParameters, synthesise
from marsyard.sim.terrain.imported import embed
from marsyard.sim.terrain.rasters import RealTerrain, TerrainFileError, full_turn, read_rasters

RADIUS_M = 3_396_190.0
#: Mars, equidistant cylindrical about the equator, on a sphere.
MARS = f"+proj=eqc +lat_ts=0 +lon_0=0 +R={RADIUS_M} +units=m +no_defs"
FULL_TURN_M = 2.0 * math.pi * RADIUS_M
#: Posts of the DTM (1 m) and pixels of the image (0.5 m) along x and y; map position of the north-western corner, m.
COLUMNS, ROWS = 80, 60
EAST_M, NORTH_M = 8_142_406.0, 30_000.0
#: Brightness of the image: texture, and twice as bright in the eastern half.
BRIGHTNESS = np.random.default_rng(1).integers(20, 60, (2 * ROWS, 2 * COLUMNS)) * np.where(
    np.arange(2 * COLUMNS) < COLUMNS, 1, 2
)


def write(path: Path, bands: np.ndarray, pixel_m: float, **changes: Any) -> Path:
    """Write bands (bands, rows, columns) at the position of the DTM."""
    crs, west, north = changes.pop("crs", MARS), changes.pop("west", EAST_M), changes.pop("north", NORTH_M)
    edits = {key: changes.pop(key) for key in ("scales", "offsets", "colorinterp") if key in changes}
    colours = changes.pop("colours", None)
    count, rows, columns = bands.shape
    profile = {
        "driver": "GTiff", "count": count, "height": rows, "width": columns, "dtype": bands.dtype,
        "crs": CRS.from_string(crs), "transform": Affine(pixel_m, 0.0, west, 0.0, -pixel_m, north),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile, **changes) as file:
        file.write(bands)
        for key, value in edits.items():
            setattr(file, key, value)
        if colours is not None:
            file.write_colormap(1, colours)
    return path


def make_source(
    folder: Path, bands: np.ndarray | None = None, dtm: dict[str, Any] | None = None, **changes: Any
) -> Any:
    """Write a DTM and an orthoimage; `changes` are those of the image."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    heights = (np.sin(x / 9.0) + np.cos(y / 7.0) - 4450.0).astype(np.float32)
    limits = {key: changes.pop(key) for key in ("max_ortho_hole_fraction", "use_ortho") if key in changes}
    image = BRIGHTNESS[None].astype(np.float32) if bands is None else bands
    return RealTerrain(
        dtm=write(folder / "dtm.tif", heights[None], 1.0, nodata=-32767.0, **(dtm or {})),
        ortho=write(folder / "ortho.tif", image, 0.5, **changes),
        border_m=5.0, roughen=False, **limits,
    )  # fmt: skip


def log_brightness(source: RealTerrain) -> np.ndarray:
    check_source(source)
    values = embed(source, 128, 1.0).log_brightness
    assert values is not None
    return values


@pytest.fixture
def expected(tmp_path: Path) -> np.ndarray:
    """Logarithm of the relative brightness of the image as numbers in one band."""
    (tmp_path / "expected").mkdir()
    return log_brightness(make_source(tmp_path / "expected"))


@pytest.mark.parametrize(
    ("shift", "problem"),
    [
        ({"west": EAST_M + COLUMNS}, r"at 100.0% of the DTM's posts \(100.0% are outside the image\); allowed: up to"),
        ({"north": NORTH_M + 5000.0}, r"at 100.0% of the DTM's posts \(100.0% are outside the image\); allowed: up to"),
        ({"west": EAST_M + 0.5 * COLUMNS}, r"at 50.0% of the DTM's posts \(50.0% are outside the image\)"),
        ({"north": NORTH_M - 0.25 * ROWS}, "at 25.0% of the DTM's posts"),
    ],
)
def test_image_outside_the_dtm_is_rejected(tmp_path: Path, shift: dict[str, Any], problem: str) -> None:
    source = make_source(tmp_path, **shift)
    with pytest.raises(TerrainFileError, match=problem) as error_info:
        check_source(source)
    assert "ortho.tif: the orthoimage has no brightness" in str(error_info.value)
    check_source(source.model_copy(update={"use_ortho": False}))


def test_uncovered_part_is_counted_and_keeps_the_synthetic_albedo(tmp_path: Path) -> None:
    source = make_source(tmp_path, west=EAST_M + 0.5 * COLUMNS, max_ortho_hole_fraction=0.6)
    check_source(source)
    embedding = embed(source, 128, 1.0)
    # Half of the posts, with 2 x 2 pixels each.
    assert embedding.extent.ortho_holes == 4 * ROWS * COLUMNS // 2
    albedo_maps = [
        synthesise(
            TerrainParameters(samples=128, spacing_m=1.0, craters_per_km2=0.0, outer_scale_m=60.0, source=item),
            np.random.default_rng(1),
        )
        for item in (source, source.model_copy(update={"use_ortho": False}))
    ]
    x, y = np.meshgrid(embedding.extent.west_m + np.arange(COLUMNS - 1.0), [embedding.extent.south_m + 0.5 * ROWS])
    with_image, without_image = (surface.albedo(x, y)[0] for surface in albedo_maps)
    ratio = with_image / without_image
    # The surface normalises the mean albedo of the terrain, so that both differ by a factor outside the image.
    np.testing.assert_allclose(ratio[:38], ratio[0], rtol=1e-5)
    assert np.std(ratio[46:70]) > 0.05


@pytest.mark.parametrize("pixels", [(0, 0), (2, 4)])
def test_larger_image_has_no_holes(tmp_path: Path, expected: np.ndarray, pixels: tuple[int, int]) -> None:
    north, west = pixels
    image = np.pad(BRIGHTNESS, ((north, 0), (west, 8)), mode="edge")[None].astype(np.float32)
    source = make_source(tmp_path, image, west=EAST_M - 0.5 * west, north=NORTH_M + 0.5 * north)
    actual = log_brightness(source)
    assert embed(source, 128, 1.0).extent.ortho_holes == 0
    # The mean of the whole image differs.
    np.testing.assert_allclose(actual - actual.mean(), expected - expected.mean(), atol=1e-4)


TURNS = [
    (MARS, EAST_M, NORTH_M, FULL_TURN_M),
    (f"+proj=eqc +lat_ts=-60 +lon_0=180 +R={RADIUS_M} +units=m", 1000.0, -3_556_000.0, 0.5 * FULL_TURN_M),
    (f"+proj=merc +lon_0=0 +R={RADIUS_M} +units=m", -EAST_M, 500.0, FULL_TURN_M),
    (f"+proj=eqc +lon_0=0 +R={RADIUS_M} +units=m", 0.5 * FULL_TURN_M - 0.5 * COLUMNS, 500.0, FULL_TURN_M),
]


@pytest.mark.parametrize("turns", [-1, 2])
@pytest.mark.parametrize(("crs", "west", "north", "turn_m"), TURNS)
def test_longitudes_of_image_and_dtm_can_differ_by_full_turns(
    tmp_path: Path, expected: np.ndarray, crs: str, west: float, north: float, turn_m: float, turns: int
) -> None:
    """Longitudes from 0 to 360 deg against -180 to 180 deg; the last DTM crosses the edge of the map at 180 deg."""
    position: dict[str, Any] = {"crs": crs, "north": north}
    source = make_source(tmp_path, dtm={**position, "west": west}, **position, west=west + turns * turn_m)
    np.testing.assert_allclose(log_brightness(source), expected, atol=1e-5)
    reverse = make_source(tmp_path, dtm={**position, "west": west + turns * turn_m}, **position, west=west)
    np.testing.assert_allclose(log_brightness(reverse), expected, atol=1e-5)


@pytest.mark.parametrize("projection", ["stere +lat_0=90", "tmerc +lon_0=137", "lcc +lat_1=45 +lat_0=45 +lon_0=10"])
def test_only_cylindrical_projections_have_full_turns(projection: str) -> None:
    assert full_turn(CRS.from_string(f"+proj={projection} +R={RADIUS_M} +units=m"), 1000.0, 2000.0) is None


def test_image_of_an_archive_is_checked(tmp_path: Path) -> None:
    """An image of a quarter of the DTM in the archive, and an image with a map position next to it."""
    path = tmp_path / "dtm.npz"
    np.savez(path, dem=np.zeros((60, 80)), dem_gsd=1.0, ortho=BRIGHTNESS[:60, :80], ortho_gsd=0.5)
    with pytest.raises(TerrainFileError, match=r"dtm.npz: the orthoimage has no brightness at 75.0%"):
        check_source(RealTerrain(dtm=path))
    np.savez(path, dem=np.zeros((60, 80)), dem_gsd=1.0)
    ortho = write(tmp_path / "ortho.tif", BRIGHTNESS[None].astype(np.uint8), 0.5)
    with pytest.raises(TerrainFileError, match=r"ortho.tif: .*dtm.npz has no map position: store the image in it"):
        check_source(RealTerrain(dtm=path, ortho=ortho))


@pytest.mark.parametrize("columns", [60, 160])
def test_missing_pixels_are_limited(tmp_path: Path, columns: int) -> None:
    """60 of 160 columns are black, as after reprojection to the extent of the DTM; or the whole image is black."""
    image = BRIGHTNESS[None].astype(np.uint8)
    image[:, :, :columns] = 0
    problem = rf"has no brightness at {columns / 1.6:.1f}% of the DTM's posts \(0.0% are outside the image\)"
    with pytest.raises(TerrainFileError, match=problem):
        check_source(make_source(tmp_path, image))


@pytest.mark.parametrize(
    ("dtype", "scale", "offset"),
    [("uint8", 2, 0), ("uint8", 1, -10), ("int16", 0.01, 70), ("uint16", 0.005, 10), ("uint16", -0.01, 130)],
)
def test_scale_and_offset_apply(tmp_path: Path, expected: np.ndarray, dtype: str, scale: float, offset: float) -> None:
    stored = np.rint((BRIGHTNESS * (2.0 if scale == 2.0 else 1.0) - offset) / scale)[None]
    source = make_source(tmp_path, stored.astype(dtype), scales=(scale,), offsets=(offset,))
    # All stored values are integers. With the scale 2, the brightness is doubled, which its mean removes.
    np.testing.assert_allclose(log_brightness(source), expected, atol=1e-4)


@pytest.mark.parametrize(("dtype", "lowest"), [("uint16", 0), ("int16", -32768)])
def test_lowest_scaled_integer_is_missing(tmp_path: Path, dtype: str, lowest: int) -> None:
    """Without nodata value, it is missing even if its scaled value is positive; with a nodata value it is valid."""
    stored = (BRIGHTNESS * 100).astype(dtype)[None]
    stored[:, :, :6] = lowest
    values: dict[str, Any] = {"scales": (0.01,), "offsets": (400.0,)}
    assert embed(make_source(tmp_path, stored, **values), 128, 1.0).extent.ortho_holes == 6 * 2 * ROWS
    assert embed(make_source(tmp_path, stored, nodata=32767, **values), 128, 1.0).extent.ortho_holes == 0


@pytest.mark.parametrize("transparent", [False, True])
def test_palette_is_applied(tmp_path: Path, expected: np.ndarray, transparent: bool) -> None:
    """The indices are in another order than the grey levels; one index can be transparent."""
    order = np.random.default_rng(2).permutation(256)
    index_of_grey = np.argsort(order)
    indices = index_of_grey[BRIGHTNESS].astype(np.uint8)[None]
    colours = {int(k): (int(grey), int(grey), int(grey), 255) for k, grey in enumerate(order)}
    if transparent:
        indices[:, :, :6] = index_of_grey[0]
        colours[int(index_of_grey[0])] = (90, 90, 90, 255)
    nodata = int(index_of_grey[0]) if transparent else None
    source = make_source(tmp_path, indices, photometric="palette", colours=colours, nodata=nodata)
    if transparent:  # a GeoTIFF has no opacity in its palette: the transparent index is the nodata value
        assert embed(source, 128, 1.0).extent.ortho_holes == 6 * 2 * ROWS
    else:
        np.testing.assert_allclose(log_brightness(source), expected, atol=1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("alpha", [False, True])
def test_colours_become_luminance(tmp_path: Path, dtype: str, alpha: bool) -> None:
    """Ground that is bright in red in the west, and in blue in the east: 0.299 R + 0.587 G + 0.114 B."""
    east = np.arange(2 * COLUMNS) >= COLUMNS
    red, green, blue = (np.broadcast_to(np.where(east, *p), BRIGHTNESS.shape) for p in ((10, 200), (20, 30), (250, 5)))
    bands = [red, green, blue]
    names = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
    if alpha:
        opacity = np.full(BRIGHTNESS.shape, 255)
        opacity[:4] = 0
        bands, names = [*bands, opacity], [*names, ColorInterp.alpha]
    source = make_source(tmp_path, np.array(bands).astype(dtype), colorinterp=names)
    check_source(source)
    _, ortho = read_rasters(source)
    luminances = 0.299 * 200 + 0.587 * 30 + 0.114 * 5, 0.299 * 10 + 0.587 * 20 + 0.114 * 250
    np.testing.assert_allclose(ortho.values[0, [0, -1]], luminances)
    assert np.count_nonzero(np.isnan(ortho.values)) == (4 * 2 * COLUMNS if alpha else 0)


def test_opacity_before_the_brightness_is_not_brightness(tmp_path: Path) -> None:
    opacity, brightness = np.full(BRIGHTNESS.shape, 255), np.full(BRIGHTNESS.shape, 90)
    opacity[:4] = 0
    bands = np.array([opacity, brightness]).astype(np.uint8)
    source = make_source(tmp_path, bands, colorinterp=[ColorInterp.alpha, ColorInterp.gray])
    check_source(source)
    _, ortho = read_rasters(source)
    assert set(ortho.values[4:-4].ravel()) == {90.0}


@pytest.mark.parametrize(
    ("bands", "changes", "problem"),
    [
        (np.ones((3, 120, 160), dtype=np.uint16), {}, r"has 3 bands \(gray, undefined, undefined\); allowed: one"),
        (np.ones((2, 120, 160), dtype=np.uint8), {}, r"has 2 bands \(gray, undefined\)"),
        (np.ones((1, 120, 160), dtype=np.complex64), {}, "contains values of type complex64; allowed: real numbers"),
        (np.ones((1, 120, 160), dtype=np.uint8), {"scales": (0.0,)}, "band 1 has scale 0 and offset 0; allowed: fin"),
        (np.ones((1, 120, 160), dtype=np.uint8), {"offsets": (np.inf,)}, "band 1 has scale 1 and offset inf"),
    ],
)
def test_invalid_bands_are_rejected(tmp_path: Path, bands: np.ndarray, changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(TerrainFileError, match=f"ortho.tif: {problem}"):
        check_source(make_source(tmp_path, bands, **changes))


def test_colours_are_no_heights(tmp_path: Path) -> None:
    source = make_source(tmp_path)
    write(source.dtm, np.ones((3, ROWS, COLUMNS), dtype=np.uint16), 1.0, photometric="RGB")
    with pytest.raises(TerrainFileError, match=r"dtm.tif: contains colours, as in an image; allowed: heights in m"):
        check_source(source)
