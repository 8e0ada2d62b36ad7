"""Digital terrain models (DTM) from files, embedded in periodic synthetic terrain."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, spline_filter

from marsyard.sim.terrain.landforms.ground import TerrainGround, refine
from marsyard.sim.terrain.rasters import (
    Coordinates,
    Grid,
    Mask,
    Raster,
    RealTerrain,
    TerrainFileError,
    brightness_at_posts,
    ortho_origin,
    read_rasters,
)

DEFORMATION_SIDE = 128  #: Cells along a side of the grid on which the synthetic terrain is deformed to meet the DTM.
#: Iterations of the relaxation in holes, and of that on each grid outside the DTM.
_HOLE_ITERATIONS, _BORDER_ITERATIONS = 200, 60
MIN_RELATIVE_BRIGHTNESS = 0.2  #: Lower limit of an orthoimage's brightness divided by its mean.
#: Minimum and maximum number of samples along a side of a terrain; minimum ratio of its side and the DTM's in samples.
MIN_SIDE, MAX_SIDE, MIN_SIDE_RATIO = 64, 8192, 1.5
ORTHO_EDGE_MARGIN_PX = 3  #: Width of the margin around missing pixels where resampling has mixed values with black.
GridPatch = Float32[np.ndarray, "rows columns"]


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


@dataclass(frozen=True)
class RealExtent:
    """Borders of the DTM in terrain coordinates, and the number of missing values in its files.

    - holes, hole_fraction: number of posts without a height, and their fraction of all posts
    - ortho_holes: number of pixels without a brightness, and of pixels that are missing beyond the image's edges
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
    - brightness_weight: blending weight of the brightness, also 0 outside the orthoimage
    - has_data: whether the DTM has a height at the post nearest to each sample
    """

    rows: slice
    columns: slice
    height: GridPatch
    log_brightness: GridPatch | None
    weight: GridPatch
    brightness_weight: GridPatch
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
    # the sample at the centre of the terrain is then inside the border
    if min(width, length) <= spacing_m:
        raise TerrainFileError(
            f"{source.dtm} covers {width:g} m x {length:g} m; it must be wider than terrain.spacing_m, {spacing_m:g} m"
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
    weight = brightness_weight = _blending_weight(source.border_m, (x - west, width), (y - south, length))
    log_brightness, ortho_holes = None, 0
    if ortho is not None:
        log_brightness, ortho_holes = _resample_log_brightness(source, raster, ortho, x - west, y - south)
        brightness_weight = np.minimum(weight, _ortho_weight(source, raster, ortho, x - west, y - south))
    borders = (west, south, west + width, south + length)
    extent = RealExtent(*borders, raster.posting_m, holes, ortho_holes, holes / heights.size)
    nearest = (
        np.clip(np.rint(offset / raster.posting_m).astype(int), 0, count - 1)
        for offset, count in ((y - south, rows), (x - west, columns))
    )
    has_data = np.isfinite(raster.values)[np.ix_(*nearest)]
    return EmbeddedDtm(
        slice(i[0], i[-1] + 1),
        slice(j[0], j[-1] + 1),
        control,
        log_brightness,
        weight,
        brightness_weight,
        has_data,
        extent,
    )


def _blending_weight(border_m: float, x: tuple[Coordinates, float], y: tuple[Coordinates, float]) -> GridPatch:
    """Return the blending weight of a rectangle: 1 inside, smoothly decreasing to 0 along its border.

    x, y: positions relative to the rectangle's south-western corner, and the length of its side, m.
    """
    margin_x, margin_y = (np.minimum(position, side - position) for position, side in (x, y))
    fraction = np.clip(np.minimum(margin_y[:, None], margin_x[None, :]) / border_m, 0.0, 1.0)
    return np.asarray(fraction * fraction * (3.0 - 2.0 * fraction), dtype=np.float32)


def _ortho_weight(source: RealTerrain, raster: Raster, ortho: Raster, x: Coordinates, y: Coordinates) -> GridPatch:
    """Return the blending weight of the orthoimage, whose pixels are squares."""
    west_m, south_m = (start - 0.5 * ortho.posting_m for start in ortho_origin(source, raster, ortho))
    rows, columns = ortho.values.shape
    width, length = columns * ortho.posting_m, rows * ortho.posting_m
    return _blending_weight(source.border_m, (x - west_m, width), (y - south_m, length))


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
    east_m, north_m = ortho_origin(source, raster, ortho)
    posts_x, posts_y = east_m + ortho.posting_m * np.arange(columns), north_m + ortho.posting_m * np.arange(rows)
    spline = RectBivariateSpline(posts_y, posts_x, logarithm, kx=1, ky=1)
    log_brightness = spline(np.clip(y, posts_y[0], posts_y[-1]), np.clip(x, posts_x[0], posts_x[-1]))
    is_covered, _ = brightness_at_posts(source, raster, ortho)
    holes += round(float(np.count_nonzero(~is_covered)) * (raster.posting_m / ortho.posting_m) ** 2)
    return log_brightness.astype(np.float32), holes


def choose_grid(source: RealTerrain) -> tuple[int, float]:
    """Choose samples and spacing of a terrain that contains the DTM, with the DTM's posting as spacing.

    Raises TerrainFileError if the DTM is too large.
    """
    raster, _ = read_rasters(source)
    longest = max(raster.values.shape)
    # the side is a power of two
    samples = max(MIN_SIDE, 1 << int(np.ceil(np.log2(MIN_SIDE_RATIO * longest))))
    if samples > MAX_SIDE:
        allowed = int(MAX_SIDE / MIN_SIDE_RATIO)
        raise TerrainFileError(f"{source.dtm} has {longest} posts along a side; maximum: {allowed}")
    return samples, raster.posting_m


class Detail(NamedTuple):
    """Height (m) and logarithm of albedo of the synthetic detail that is finer than a DTM, in the area of the DTM."""

    height: GridPatch
    log_albedo: GridPatch


def extract_fine_detail(ground: TerrainGround, dtm: EmbeddedDtm) -> Detail:
    """Extract the synthetic ground's wavelengths below twice the DTM's posting, in the area of the DTM.

    This is a Gaussian high-pass filter with an amplitude of 0.5 at that wavelength.
    """
    sigma = dtm.extent.posting_m * np.sqrt(2.0 * np.log(2.0)) / np.pi / ground.spacing_m
    grids = (ground.height, ground.log_albedo)
    return Detail(*((grid - gaussian_filter(grid, sigma, mode="wrap"))[dtm.rows, dtm.columns] for grid in grids))


def blend_into_ground(ground: TerrainGround, dtm: EmbeddedDtm, detail: Detail | None) -> None:
    """Blend the DTM into the synthetic ground, in place.

    First the synthetic ground is deformed to meet the DTM at its border. The deformation is the height difference at
    the border, extrapolated by Laplace's equation on a coarse periodic grid.
    """
    height = dtm.height if detail is None else dtm.height + detail.height
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
        log_brightness = dtm.log_brightness if detail is None else dtm.log_brightness + detail.log_albedo
        region = ground.log_albedo[dtm.rows, dtm.columns]
        region += dtm.brightness_weight * (log_brightness - region)


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
