"""Terrain models (DTM) from files, embedded in a periodic synthetic surround."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float32, Float64
from pydantic import Field
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, spline_filter

from marsyard.sim.parameters import Parameters
from marsyard.sim.terrain.landforms.ground import Ground, refine

Grid = Float64[np.ndarray, "rows columns"]
Line = Float64[np.ndarray, "n"]
Part = Float32[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "rows columns"]


class TerrainFileError(ValueError):
    """A terrain file cannot be used; the message says which, why, and what is allowed."""


class RealTerrain(Parameters):
    """A digital terrain model (DTM) from a file, that replaces the fractal ground within its borders.

    The file is a GeoTIFF (rows from north to south, projected, metres; needs the extra `geo`) or an ``.npz`` with
    ``dem`` (heights, m, row 0 in the north) and ``dem_gsd`` (m), and optionally ``ortho``, ``ortho_gsd`` and
    ``ortho_valid``. Its middle lies at the middle of the periodic terrain, whose y axis is the grid's north: azimuths,
    the sun's too, count from there, which is not true north off a projection's central meridian.

    Posts without height are filled smoothly, up to `max_hole_fraction` of them; ground that is filled is not real.
    """

    dtm: Annotated[Path, Field(description="GeoTIFF or .npz with the heights")]
    ortho: Annotated[Path | None, Field(description="GeoTIFF with the picture; an .npz has its own")] = None
    use_ortho: Annotated[bool, Field(description="whether brightness is taken from the picture")] = True
    ortho_east_m: Annotated[float, Field(description="how far east of the DTM the picture lies, m")] = 0.0
    ortho_north_m: Annotated[float, Field(description="how far north of the DTM the picture lies, m")] = 0.0
    border_m: Annotated[float, Field(gt=0.0, description="width of the seam to the surround, in the DTM, m")] = 20.0
    max_hole_fraction: Annotated[float, Field(ge=0.0, lt=1.0, description="maximum fraction without height")] = 0.05
    roughen: Annotated[bool, Field(description="add fractal detail finer than twice the DTM's posting")] = True

    def input_files(self) -> tuple[str, ...]:
        """Paths of the files that the terrain is made from."""
        return tuple(str(path) for path in (self.dtm, self.ortho) if path is not None)


@dataclass(frozen=True)
class Raster:
    """A grid of values, row 0 in the south, NaN where missing; cell (0, 0) is centred at `west_m`, `south_m`."""

    values: Grid
    posting_m: float
    west_m: float
    south_m: float


def read_rasters(source: RealTerrain) -> tuple[Raster, Raster | None]:
    """Read heights, and brightness where there is an image that shall be used. Raises TerrainFileError."""
    if not source.dtm.exists():
        raise TerrainFileError(f"terrain file {source.dtm} does not exist")
    heights, ortho = _read_npz(source.dtm) if source.dtm.suffix == ".npz" else (_read_geotiff(source.dtm), None)
    if source.ortho is not None:
        if not source.ortho.exists():
            raise TerrainFileError(f"ortho image {source.ortho} does not exist")
        ortho = _read_geotiff(source.ortho)
    check_holes(source, heights.values)
    return heights, ortho if source.use_ortho else None


def check_holes(source: RealTerrain, heights: Grid) -> None:
    """Raise TerrainFileError where more heights are missing (not finite) than the source allows."""
    fraction = float(np.mean(~np.isfinite(heights)))
    if fraction == 1.0:
        raise TerrainFileError(f"{source.dtm}: has no valid height at all")
    if fraction > source.max_hole_fraction:
        raise TerrainFileError(
            f"{source.dtm}: {fraction:.1%} of its posts have no height; allowed: up to {source.max_hole_fraction:.1%}. "
            "Cut out a part without holes (rio clip --bounds), or allow them to be filled smoothly by "
            "max_hole_fraction (marsyard terrain stats and render: --max-holes)"
        )


def _read_npz(path: Path) -> tuple[Raster, Raster | None]:
    with np.load(path, allow_pickle=False) as file:
        missing = [key for key in ("dem", "dem_gsd") if key not in file]
        if missing:
            allowed = "dem, dem_gsd, ortho, ortho_gsd, ortho_valid"
            raise TerrainFileError(f"{path} lacks {', '.join(missing)}; allowed: {allowed}")
        heights = _from_north(file["dem"], float(file["dem_gsd"]), path)
        if "ortho" not in file:
            return heights, None
        brightness = np.asarray(file["ortho"], dtype=np.float64)
        if "ortho_valid" in file:
            brightness = np.where(file["ortho_valid"], brightness, np.nan)
        return heights, _from_north(brightness, float(file["ortho_gsd"]), path)


def _from_north(values: Any, posting_m: float, path: Path) -> Raster:
    """A raster from rows that run from north to south; the origin is the outer corner of the north-western cell."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or min(array.shape) < 4:
        raise TerrainFileError(f"{path} has a grid of shape {array.shape}; at least 4 x 4 values are needed")
    array = np.where(np.isfinite(array), array, np.nan)
    return Raster(array[::-1].copy(), posting_m, 0.5 * posting_m, (0.5 - array.shape[0]) * posting_m)


def _read_geotiff(path: Path) -> Raster:
    try:
        import rasterio
    except ImportError as error:
        raise TerrainFileError(
            f"{path}: reading GeoTIFF needs rasterio, which is not installed: pip install rasterio (extra 'geo')"
        ) from error
    with rasterio.open(path) as file:
        values = file.read(1, masked=True).astype(np.float64).filled(np.nan)
        transform, crs = file.transform, file.crs
    if crs is not None and crs.is_geographic:
        raise TerrainFileError(f"{path} is in degrees ({crs}); project it to metres first, with rio warp --dst-crs")
    if transform.b or transform.d or abs(transform.a + transform.e) > 1e-6 * abs(transform.a):
        raise TerrainFileError(f"{path} has rotated or oblong cells; square cells, north up, are needed")
    factor = 1.0 if crs is None else float(crs.linear_units_factor[1])
    posting = float(transform.a) * factor
    raster = _from_north(values, posting, path)
    return Raster(raster.values, posting, transform.c * factor + raster.west_m, transform.f * factor + raster.south_m)


def fill_holes(values: Grid) -> tuple[Grid, int]:
    """Fill holes smoothly from their rims; return the values, and how many were missing.

    Every missing value starts as its nearest valid one; then Laplace's equation is relaxed.
    """
    missing: Mask = np.isnan(values)
    holes = int(missing.sum())
    if holes == 0:
        return values, 0
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    nearest_value = values[tuple(nearest)]
    for _ in range(200):
        padded = np.pad(nearest_value, 1, mode="edge")
        around = 0.25 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
        nearest_value[missing] = around[missing]
    return nearest_value, holes


MEMBRANE_SIDE = 128  #: Side of the grid on which the surround is deformed to meet the real terrain.
MAX_SIDE = 8192  #: Largest number of samples along a side of a terrain.
TORN_EDGE_PX = 3  #: Pixels next to missing ones that resampling has mixed with black.


@dataclass(frozen=True)
class RealExtent:
    """Borders of the DTM in terrain coordinates, and the defects of its file, which are filled from around.

    Within `border_m` of the borders the DTM blends into its surround.

    - holes, hole_fraction: posts without a height, and their fraction of all posts
    - ortho_holes: pixels without a brightness
    """

    west_m: float
    south_m: float
    east_m: float
    north_m: float
    posting_m: float
    holes: int
    ortho_holes: int
    hole_fraction: float


@dataclass(frozen=True)
class Embedded:
    """A real terrain resampled on the grid of its surround.

    - rows, columns: the part of the grid that it covers
    - height: control values there: the B-spline passes through the DTM's interpolated heights
    - tone: natural logarithm of brightness over its mean
    - weight: 1 inside, falling to 0 at the border
    - real: whether the DTM has a height at the post nearest to each sample; elsewhere a hole is filled
    """

    rows: slice
    columns: slice
    height: Part
    tone: Part | None
    weight: Part
    real: Mask
    extent: RealExtent

    def real_samples(self, side: int) -> Bool[np.ndarray, "side side"]:
        """Mask of the whole terrain's samples on posts with a height: statistics are computed from these."""
        return self._mask(side, self.real)

    def filled_samples(self, side: int) -> Bool[np.ndarray, "side side"]:
        """Mask of the whole terrain's samples in filled holes of the DTM."""
        return self._mask(side, ~self.real)

    def _mask(self, side: int, part: Mask) -> Bool[np.ndarray, "side side"]:
        samples = np.zeros((side, side), dtype=np.bool_)
        samples[self.rows, self.columns] = part
        return samples


def embed(source: RealTerrain, side: int, spacing_m: float) -> Embedded:
    """Resample the file's terrain for the middle of a grid of this side and spacing. Raises TerrainFileError."""
    raster, ortho = read_rasters(source)
    period = side * spacing_m
    rows, columns = raster.values.shape
    width, length = (columns - 1) * raster.posting_m, (rows - 1) * raster.posting_m
    if max(width, length) > period - 2.0 * spacing_m:
        raise TerrainFileError(
            f"{source.dtm} covers {width:g} m x {length:g} m; the terrain repeats after {period:g} m: "
            "choose more terrain.samples or a larger terrain.spacing_m"
        )
    if min(width, length) <= 2.0 * source.border_m:
        raise TerrainFileError(
            f"{source.dtm} covers {width:g} m x {length:g} m; a border of {source.border_m:g} m leaves nothing of it"
        )
    heights, holes = fill_holes(raster.values)
    # aligned with the grid, so that posts coincide with samples where the postings allow it
    west, south = (round(0.5 * (period - span) / spacing_m) * spacing_m for span in (width, length))
    i = np.arange(int(np.ceil(south / spacing_m)), int(np.floor((south + length) / spacing_m)) + 1)
    j = np.arange(int(np.ceil(west / spacing_m)), int(np.floor((west + width) / spacing_m)) + 1)
    y, x = i * spacing_m, j * spacing_m
    posts_y, posts_x = south + raster.posting_m * np.arange(rows), west + raster.posting_m * np.arange(columns)
    # cubic between the DTM's posts, then control values of the B-spline through the interpolated heights
    resampled = RectBivariateSpline(posts_y, posts_x, heights - heights.mean(), kx=3, ky=3)(y, x)
    control = spline_filter(resampled, order=3, mode="mirror", output=np.float64).astype(np.float32)
    inward_y, inward_x = np.minimum(y - south, south + length - y), np.minimum(x - west, west + width - x)
    fraction = np.clip(np.minimum(inward_y[:, None], inward_x[None, :]) / source.border_m, 0.0, 1.0)
    weight = (fraction * fraction * (3.0 - 2.0 * fraction)).astype(np.float32)
    tone, ortho_holes = (None, 0) if ortho is None else _log_brightness(source, raster, ortho, x - west, y - south)
    borders = (west, south, west + width, south + length)
    extent = RealExtent(*borders, raster.posting_m, holes, ortho_holes, holes / heights.size)
    nearest = (
        np.clip(np.rint(offset / raster.posting_m).astype(int), 0, count - 1)
        for offset, count in ((y - south, rows), (x - west, columns))
    )
    real = np.isfinite(raster.values)[np.ix_(*nearest)]
    return Embedded(slice(i[0], i[-1] + 1), slice(j[0], j[-1] + 1), control, tone, weight, real, extent)


def _log_brightness(source: RealTerrain, raster: Raster, ortho: Raster, x: Line, y: Line) -> tuple[Part, int]:
    """Log brightness of the image over its mean at positions relative to the DTM's south-western post; missing pixels.

    The image's own shading remains: it is taken for albedo. Black is limited to a fifth of the mean.
    """
    missing = ~(ortho.values > 0.0)
    holes = int(missing.sum())
    if holes:
        missing = binary_dilation(missing, iterations=TORN_EDGE_PX)
    brightness, _ = fill_holes(np.where(missing, np.nan, ortho.values))
    logarithm = np.log(np.maximum(brightness / float(brightness.mean()), 0.2))
    rows, columns = logarithm.shape
    posts_x = ortho.west_m - raster.west_m - source.ortho_east_m + ortho.posting_m * np.arange(columns)
    posts_y = ortho.south_m - raster.south_m - source.ortho_north_m + ortho.posting_m * np.arange(rows)
    spline = RectBivariateSpline(posts_y, posts_x, logarithm, kx=1, ky=1)
    tone = spline(np.clip(y, posts_y[0], posts_y[-1]), np.clip(x, posts_x[0], posts_x[-1]))
    return tone.astype(np.float32), holes


def choose_grid(source: RealTerrain) -> tuple[int, float]:
    """Choose samples and spacing of a terrain that holds the DTM at its own posting, with a surround.

    Raises TerrainFileError for a DTM that is too large.
    """
    raster, _ = read_rasters(source)
    longest = max(raster.values.shape)
    samples = max(64, 1 << int(np.ceil(np.log2(1.5 * longest))))
    if samples > MAX_SIDE:
        raise TerrainFileError(f"{source.dtm} has {longest} posts along a side; at most 5461 fit")
    return samples, raster.posting_m


#: Heights and tones finer than a DTM's posting.
Detail = tuple[Part, Part]


def detail_below_posting(ground: Ground, real: Embedded) -> Detail:
    """Extract the ground's waves shorter than twice the DTM's posting, where the DTM lies.

    The remainder of a Gaussian low-pass whose amplitude is a half at that wavelength.
    """
    sigma = real.extent.posting_m * np.sqrt(2.0 * np.log(2.0)) / np.pi / ground.spacing_m
    grids = (ground.height, ground.tone)
    height, tone = ((grid - gaussian_filter(grid, sigma, mode="wrap"))[real.rows, real.columns] for grid in grids)
    return height, tone


def blend_into_ground(ground: Ground, real: Embedded, detail: Detail | None) -> None:
    """Blend the real terrain into the ground, in place, after deforming the surround to meet it at the border.

    The deformation is a membrane: the height difference along the border, continued by Laplace's equation on a coarse
    periodic grid.
    """
    height = real.height if detail is None else real.height + detail[0]
    step = max(ground.side // MEMBRANE_SIDE, 1)
    covered = np.zeros((ground.side, ground.side), dtype=bool)
    covered[real.rows, real.columns] = real.weight > 0.0
    difference = np.zeros((ground.side, ground.side), dtype=np.float32)
    difference[real.rows, real.columns] = real.height - ground.height[real.rows, real.columns]
    membrane = _membrane(difference[::step, ::step].astype(np.float64), covered[::step, ::step])
    np.add(ground.height, refine(membrane.astype(np.float32), ground.side), out=ground.height)
    area = ground.height[real.rows, real.columns]
    area += real.weight * (height - area)
    if real.tone is not None:
        tone = real.tone if detail is None else real.tone + detail[1]
        area = ground.tone[real.rows, real.columns]
        area += real.weight * (tone - area)


def _membrane(
    values: Float64[np.ndarray, "side side"], known: Bool[np.ndarray, "side side"]
) -> Float64[np.ndarray, "side side"]:
    """Continue values where they are not known as the mean of the neighbours, by successively finer relaxation."""
    if known.shape[0] > 8 and known[::2, ::2].any():
        field = np.repeat(np.repeat(_membrane(values[::2, ::2], known[::2, ::2]), 2, axis=0), 2, axis=1)
    else:
        field = np.full(values.shape, float(values[known].mean()))
    for _ in range(60):
        around = np.roll(field, 1, 0) + np.roll(field, -1, 0) + np.roll(field, 1, 1) + np.roll(field, -1, 1)
        field = np.where(known, values, 0.25 * around)
    return field
