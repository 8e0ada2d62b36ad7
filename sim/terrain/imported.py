"""Digital terrain models (DTM) from files, embedded in periodic synthetic terrain."""

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
Coordinates = Float64[np.ndarray, "n"]
GridPatch = Float32[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "rows columns"]


class TerrainFileError(ValueError):
    """A terrain file cannot be used; the message contains the file, the reason and the allowed values."""


class RealTerrain(Parameters):
    """A digital terrain model (DTM) from a file; it replaces the synthetic ground inside its borders.

    The file is a GeoTIFF (rows from north to south, projected, metres; needs the extra `geo`) or an ``.npz`` with
    ``dem`` (heights, m, row 0 in the north) and ``dem_gsd`` (m), and optionally ``ortho``, ``ortho_gsd`` and
    ``ortho_valid``. Its centre is the centre of the periodic terrain. Azimuths, including the sun's, are relative to
    grid north (y axis), which differs from true north away from the projection's central meridian.

    Missing heights are interpolated, up to a fraction `max_hole_fraction`. Filled samples are excluded from statistics.
    """

    dtm: Annotated[Path, Field(description="GeoTIFF or .npz with the heights")]
    ortho: Annotated[Path | None, Field(description="GeoTIFF with the orthoimage; an .npz can contain it")] = None
    use_ortho: Annotated[bool, Field(description="whether the orthoimage determines the albedo")] = True
    ortho_east_m: Annotated[float, Field(description="eastward offset of the orthoimage from the DTM, m")] = 0.0
    ortho_north_m: Annotated[float, Field(description="northward offset of the orthoimage from the DTM, m")] = 0.0
    border_m: Annotated[float, Field(gt=0.0, description="width of the blending zone inside the DTM, m")] = 20.0
    max_hole_fraction: Annotated[float, Field(ge=0.0, lt=1.0, description="maximum fraction without height")] = 0.05
    roughen: Annotated[bool, Field(description="add fractal detail finer than twice the DTM's posting")] = True

    def input_files(self) -> tuple[str, ...]:
        """Return the paths of the DTM's files."""
        return tuple(str(path) for path in (self.dtm, self.ortho) if path is not None)


@dataclass(frozen=True)
class Raster:
    """A grid of values, row 0 in the south, NaN where missing.

    - posting_m: distance between the grid points (posts)
    - west_m, south_m: position of post (0, 0)
    """

    values: Grid
    posting_m: float
    west_m: float
    south_m: float


def read_rasters(source: RealTerrain) -> tuple[Raster, Raster | None]:
    """Read heights, and brightness if an orthoimage is used. Raises TerrainFileError."""
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
    """Raise TerrainFileError if more heights are missing (not finite) than the source allows."""
    fraction = float(np.mean(~np.isfinite(heights)))
    if fraction == 1.0:
        raise TerrainFileError(f"{source.dtm}: has no valid height at all")
    if fraction > source.max_hole_fraction:
        raise TerrainFileError(
            f"{source.dtm}: {fraction:.1%} of its posts have no height; allowed: up to {source.max_hole_fraction:.1%}. "
            "Clip the file to a part without holes (rio clip --bounds), or increase max_hole_fraction "
            "(marsyard terrain stats and render: --max-holes) to fill the holes by interpolation"
        )


def _read_npz(path: Path) -> tuple[Raster, Raster | None]:
    with np.load(path, allow_pickle=False) as file:
        missing = [key for key in ("dem", "dem_gsd") if key not in file]
        if missing:
            allowed = "dem, dem_gsd, ortho, ortho_gsd, ortho_valid"
            raise TerrainFileError(f"{path} does not contain {', '.join(missing)}; allowed: {allowed}")
        heights = _create_raster(file["dem"], float(file["dem_gsd"]), path)
        if "ortho" not in file:
            return heights, None
        brightness = np.asarray(file["ortho"], dtype=np.float64)
        if "ortho_valid" in file:
            brightness = np.where(file["ortho_valid"], brightness, np.nan)
        return heights, _create_raster(brightness, float(file["ortho_gsd"]), path)


def _create_raster(values: Any, posting_m: float, path: Path) -> Raster:
    """Create a raster from rows in north-to-south order, with the outer corner of the north-western cell at (0, 0)."""
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
        raise TerrainFileError(f"{path} is in degrees ({crs}); project it to metres with rio warp --dst-crs")
    if transform.b or transform.d or abs(transform.a + transform.e) > 1e-6 * abs(transform.a):
        raise TerrainFileError(f"{path} has rotated or oblong cells; square cells, north up, are needed")
    factor = 1.0 if crs is None else float(crs.linear_units_factor[1])
    posting = float(transform.a) * factor
    raster = _create_raster(values, posting, path)
    return Raster(raster.values, posting, transform.c * factor + raster.west_m, transform.f * factor + raster.south_m)


def fill_holes(values: Grid) -> tuple[Grid, int]:
    """Interpolate missing values; return the values, and the number of missing values.

    The first guess of a missing value is the nearest valid value; then Laplace's equation is solved by relaxation.
    """
    missing: Mask = np.isnan(values)
    holes = int(missing.sum())
    if holes == 0:
        return values, 0
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    filled = values[tuple(nearest)]
    for _ in range(_HOLE_ITERATIONS):
        padded = np.pad(filled, 1, mode="edge")
        neighbour_mean = 0.25 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
        filled[missing] = neighbour_mean[missing]
    return filled, holes


DEFORMATION_SIDE = 128  #: Cells along a side of the grid on which the synthetic terrain is deformed to meet the DTM.
#: Iterations of the relaxation in holes, and of that on each grid outside the DTM.
_HOLE_ITERATIONS, _BORDER_ITERATIONS = 200, 60
MIN_RELATIVE_BRIGHTNESS = 0.2  #: Lower limit of an orthoimage's brightness divided by its mean.
MAX_SIDE = 8192  #: Maximum number of samples along a side of a terrain.
ORTHO_EDGE_MARGIN_PX = 3  #: Width of the margin around missing pixels where resampling has mixed values with black.


@dataclass(frozen=True)
class RealExtent:
    """Borders of the DTM in terrain coordinates, and the number of missing values in its files.

    - holes, hole_fraction: number of posts without a height, and their fraction of all posts
    - ortho_holes: number of pixels without a brightness
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
class EmbeddedDtm:
    """A DTM resampled on the grid of the terrain.

    - rows, columns: the part of the grid that the DTM covers
    - height: control values of the B-spline through the DTM's interpolated heights
    - log_brightness: natural logarithm of brightness divided by its mean
    - weight: blending weight, 1 inside, decreasing to 0 at the border
    - has_data: whether the DTM has a height at the post nearest to each sample
    """

    rows: slice
    columns: slice
    height: GridPatch
    log_brightness: GridPatch | None
    weight: GridPatch
    has_data: Mask
    extent: RealExtent

    def real_samples(self, side: int) -> Bool[np.ndarray, "side side"]:
        """Return a mask of the terrain's samples at posts with a height; statistics use only these samples."""
        return self._create_mask(side, self.has_data)

    def filled_samples(self, side: int) -> Bool[np.ndarray, "side side"]:
        """Return a mask of the terrain's samples in filled holes of the DTM."""
        return self._create_mask(side, ~self.has_data)

    def _create_mask(self, side: int, dtm_mask: Mask) -> Bool[np.ndarray, "side side"]:
        mask = np.zeros((side, side), dtype=np.bool_)
        mask[self.rows, self.columns] = dtm_mask
        return mask


def embed(source: RealTerrain, side: int, spacing_m: float) -> EmbeddedDtm:
    """Resample the DTM at the centre of a terrain grid of `side` x `side` samples. Raises TerrainFileError."""
    raster, ortho = read_rasters(source)
    period = side * spacing_m
    rows, columns = raster.values.shape
    width, length = (columns - 1) * raster.posting_m, (rows - 1) * raster.posting_m
    if max(width, length) > period - 2.0 * spacing_m:
        raise TerrainFileError(
            f"{source.dtm} covers {width:g} m x {length:g} m; the terrain's period is {period:g} m: "
            "increase terrain.samples or terrain.spacing_m"
        )
    if min(width, length) <= 2.0 * source.border_m:
        raise TerrainFileError(
            f"{source.dtm} covers {width:g} m x {length:g} m; "
            f"it must be wider than twice the border ({source.border_m:g} m)"
        )
    heights, holes = fill_holes(raster.values)
    # align the DTM with the grid: posts coincide with samples if the posting is a multiple of the spacing
    west, south = (round(0.5 * (period - span) / spacing_m) * spacing_m for span in (width, length))
    i = np.arange(int(np.ceil(south / spacing_m)), int(np.floor((south + length) / spacing_m)) + 1)
    j = np.arange(int(np.ceil(west / spacing_m)), int(np.floor((west + width) / spacing_m)) + 1)
    y, x = i * spacing_m, j * spacing_m
    posts_y, posts_x = south + raster.posting_m * np.arange(rows), west + raster.posting_m * np.arange(columns)
    # cubic interpolation between the DTM's posts, then control values of the B-spline through these heights
    resampled = RectBivariateSpline(posts_y, posts_x, heights - heights.mean(), kx=3, ky=3)(y, x)
    control = spline_filter(resampled, order=3, mode="mirror", output=np.float64).astype(np.float32)
    margin_y, margin_x = np.minimum(y - south, south + length - y), np.minimum(x - west, west + width - x)
    fraction = np.clip(np.minimum(margin_y[:, None], margin_x[None, :]) / source.border_m, 0.0, 1.0)
    weight = (fraction * fraction * (3.0 - 2.0 * fraction)).astype(np.float32)
    log_brightness, ortho_holes = (
        (None, 0) if ortho is None else _resample_log_brightness(source, raster, ortho, x - west, y - south)
    )
    borders = (west, south, west + width, south + length)
    extent = RealExtent(*borders, raster.posting_m, holes, ortho_holes, holes / heights.size)
    nearest = (
        np.clip(np.rint(offset / raster.posting_m).astype(int), 0, count - 1)
        for offset, count in ((y - south, rows), (x - west, columns))
    )
    has_data = np.isfinite(raster.values)[np.ix_(*nearest)]
    return EmbeddedDtm(
        slice(i[0], i[-1] + 1), slice(j[0], j[-1] + 1), control, log_brightness, weight, has_data, extent
    )


def _resample_log_brightness(
    source: RealTerrain, raster: Raster, ortho: Raster, x: Coordinates, y: Coordinates
) -> tuple[GridPatch, int]:
    """Resample the logarithm of the orthoimage's brightness divided by its mean; count missing pixels.

    Positions are relative to the DTM's south-western post, metres. Shading in the image is not removed: it becomes part
    of the albedo. Values below `MIN_RELATIVE_BRIGHTNESS` are clipped.
    """
    missing = ~(ortho.values > 0.0)
    holes = int(missing.sum())
    if holes:
        missing = binary_dilation(missing, iterations=ORTHO_EDGE_MARGIN_PX)
    brightness, _ = fill_holes(np.where(missing, np.nan, ortho.values))
    logarithm = np.log(np.maximum(brightness / float(brightness.mean()), MIN_RELATIVE_BRIGHTNESS))
    rows, columns = logarithm.shape
    posts_x = ortho.west_m - raster.west_m - source.ortho_east_m + ortho.posting_m * np.arange(columns)
    posts_y = ortho.south_m - raster.south_m - source.ortho_north_m + ortho.posting_m * np.arange(rows)
    spline = RectBivariateSpline(posts_y, posts_x, logarithm, kx=1, ky=1)
    log_brightness = spline(np.clip(y, posts_y[0], posts_y[-1]), np.clip(x, posts_x[0], posts_x[-1]))
    return log_brightness.astype(np.float32), holes


def choose_grid(source: RealTerrain) -> tuple[int, float]:
    """Choose samples and spacing of a terrain that contains the DTM, with the DTM's posting as spacing.

    Raises TerrainFileError if the DTM is too large.
    """
    raster, _ = read_rasters(source)
    longest = max(raster.values.shape)
    # the terrain's side is the power of two that is at least 1.5 times that of the DTM
    samples = max(64, 1 << int(np.ceil(np.log2(1.5 * longest))))
    if samples > MAX_SIDE:
        # 5461 is MAX_SIDE / 1.5
        raise TerrainFileError(f"{source.dtm} has {longest} posts along a side; maximum: 5461")
    return samples, raster.posting_m


#: Height (m) and logarithm of albedo of the synthetic detail that is finer than a DTM, in the area of the DTM.
Detail = tuple[GridPatch, GridPatch]


def extract_fine_detail(ground: Ground, dtm: EmbeddedDtm) -> Detail:
    """Extract the synthetic ground's wavelengths below twice the DTM's posting, in the area of the DTM.

    This is a Gaussian high-pass filter with an amplitude of 0.5 at that wavelength.
    """
    sigma = dtm.extent.posting_m * np.sqrt(2.0 * np.log(2.0)) / np.pi / ground.spacing_m
    grids = (ground.height, ground.log_albedo)
    height, log_brightness = (
        (grid - gaussian_filter(grid, sigma, mode="wrap"))[dtm.rows, dtm.columns] for grid in grids
    )
    return height, log_brightness


def blend_into_ground(ground: Ground, dtm: EmbeddedDtm, detail: Detail | None) -> None:
    """Blend the DTM into the synthetic ground, in place.

    First the synthetic ground is deformed to meet the DTM at its border. The deformation is the height difference at
    the border, extrapolated by Laplace's equation on a coarse periodic grid.
    """
    height = dtm.height if detail is None else dtm.height + detail[0]
    step = max(ground.side // DEFORMATION_SIDE, 1)
    is_covered = np.zeros((ground.side, ground.side), dtype=bool)
    is_covered[dtm.rows, dtm.columns] = dtm.weight > 0.0
    difference = np.zeros((ground.side, ground.side), dtype=np.float32)
    difference[dtm.rows, dtm.columns] = dtm.height - ground.height[dtm.rows, dtm.columns]
    deformation = _extrapolate_smoothly(difference[::step, ::step].astype(np.float64), is_covered[::step, ::step])
    np.add(ground.height, refine(deformation.astype(np.float32), ground.side), out=ground.height)
    region = ground.height[dtm.rows, dtm.columns]
    region += dtm.weight * (height - region)
    if dtm.log_brightness is not None:
        log_brightness = dtm.log_brightness if detail is None else dtm.log_brightness + detail[1]
        region = ground.log_albedo[dtm.rows, dtm.columns]
        region += dtm.weight * (log_brightness - region)


def _extrapolate_smoothly(
    values: Float64[np.ndarray, "side side"], has_value: Bool[np.ndarray, "side side"]
) -> Float64[np.ndarray, "side side"]:
    """Extrapolate values on a periodic grid by Laplace's equation, with relaxation on successively finer grids."""
    if has_value.shape[0] > 8 and has_value[::2, ::2].any():
        coarse = _extrapolate_smoothly(values[::2, ::2], has_value[::2, ::2])
        field = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)
    else:
        field = np.full(values.shape, float(values[has_value].mean()))
    for _ in range(_BORDER_ITERATIONS):
        neighbour_sum = np.roll(field, 1, 0) + np.roll(field, -1, 0) + np.roll(field, 1, 1) + np.roll(field, -1, 1)
        field = np.where(has_value, values, 0.25 * neighbour_sum)
    return field
