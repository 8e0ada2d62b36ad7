"""Real terrain embedded in a periodic synthetic surround."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import binary_dilation, gaussian_filter, spline_filter

from marsyard.sim.terrain.imported import Raster, RealTerrain, TerrainFileError, filled, read_rasters
from marsyard.sim.terrain.landforms.ground import Ground, finer

#: Side of the grid on which the surround is bent to meet the real terrain.
BENDING_SIDE = 128
#: Samples along a side of the largest terrain.
LARGEST_SIDE = 8192
#: Pixels beside missing ones that resampling has mixed with black.
TORN_EDGE_PX = 3


@dataclass(frozen=True)
class RealExtent:
    """Where the real part of a terrain lies, and what was wrong with its file.

    Attributes
    ----------
    west_m, south_m, east_m, north_m
        Borders of the DTM in terrain coordinates. Within `border_m` of them it blends into its surround.
    posting_m
        Distance between the DTM's posts.
    holes, ortho_holes
        Posts without a height, and pixels without a brightness; they are filled from around.
    hole_fraction
        Posts without a height over all posts of the DTM.
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
    """A real terrain on the grid of the terrain that surrounds it.

    Attributes
    ----------
    rows, columns
        The part of the grid that it covers.
    height
        Control values there: the B-spline passes through the DTM's interpolated heights.
    tone
        Natural logarithm of brightness over its mean, or None.
    weight
        1 inside, falling to 0 at the border.
    real
        Whether the DTM has a height at the post next to each sample; elsewhere a hole is filled.
    extent
        Where that is.
    """

    rows: slice
    columns: slice
    height: Float32[np.ndarray, "rows columns"]
    tone: Float32[np.ndarray, "rows columns"] | None
    weight: Float32[np.ndarray, "rows columns"]
    real: Bool[np.ndarray, "rows columns"]
    extent: RealExtent

    def real_samples(self, side: int) -> Bool[np.ndarray, "side side"]:
        """Which samples of the whole terrain lie on posts with a height: what its statistics are computed from."""
        samples = np.zeros((side, side), dtype=np.bool_)
        samples[self.rows, self.columns] = self.real
        return samples

    def filled_samples(self, side: int) -> Bool[np.ndarray, "side side"]:
        """Which samples of the whole terrain lie in a hole of the DTM, which is filled."""
        samples = np.zeros((side, side), dtype=np.bool_)
        samples[self.rows, self.columns] = ~self.real
        return samples


def embed(source: RealTerrain, side: int, spacing_m: float) -> Embedded:
    """The file's terrain resampled for the middle of a grid of this side and spacing. Raises TerrainFileError."""
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
    heights, holes = filled(raster.values)
    # on the grid, so that posts fall on samples where the postings allow it
    west, south = (round(0.5 * (period - span) / spacing_m) * spacing_m for span in (width, length))
    i = np.arange(int(np.ceil(south / spacing_m)), int(np.floor((south + length) / spacing_m)) + 1)
    j = np.arange(int(np.ceil(west / spacing_m)), int(np.floor((west + width) / spacing_m)) + 1)
    y, x = i * spacing_m, j * spacing_m
    posts_y, posts_x = south + raster.posting_m * np.arange(rows), west + raster.posting_m * np.arange(columns)
    level = heights - heights.mean()
    # cubic between the DTM's posts, then control values of the B-spline through what that gives on our grid
    ours = RectBivariateSpline(posts_y, posts_x, level, kx=3, ky=3)(y, x)
    control = spline_filter(ours, order=3, mode="mirror", output=np.float64).astype(np.float32)
    inward_y, inward_x = np.minimum(y - south, south + length - y), np.minimum(x - west, west + width - x)
    share = np.clip(np.minimum(inward_y[:, None], inward_x[None, :]) / source.border_m, 0.0, 1.0)
    weight = (share * share * (3.0 - 2.0 * share)).astype(np.float32)
    tone, ortho_holes = None, 0
    if ortho is not None:
        tone, ortho_holes = _tone(source, raster, ortho, x - west, y - south)
    extent = RealExtent(
        west, south, west + width, south + length, raster.posting_m, holes, ortho_holes, holes / heights.size
    )
    rows_of, columns_of = (
        np.clip(np.rint(along / raster.posting_m).astype(int), 0, count - 1)
        for along, count in ((y - south, rows), (x - west, columns))
    )
    real = np.isfinite(raster.values)[np.ix_(rows_of, columns_of)]
    return Embedded(slice(i[0], i[-1] + 1), slice(j[0], j[-1] + 1), control, tone, weight, real, extent)


def _tone(
    source: RealTerrain,
    raster: Raster,
    ortho: Raster,
    x: Float64[np.ndarray, "columns"],
    y: Float64[np.ndarray, "rows"],
) -> tuple[Float32[np.ndarray, "rows columns"], int]:
    """Log brightness of the picture over its mean at places relative to the DTM's south-western post.

    The picture's own shading stays in it: it is taken for albedo. Black is limited to a fifth of the mean.
    """
    missing = ~(ortho.values > 0.0)
    holes = int(missing.sum())
    if holes:
        missing = binary_dilation(missing, iterations=TORN_EDGE_PX)
    brightness, _ = filled(np.where(missing, np.nan, ortho.values))
    mean = float(brightness.mean())
    logarithm = np.log(np.maximum(brightness / mean, 0.2))
    rows, columns = logarithm.shape
    posts_x = ortho.west_m - raster.west_m - source.ortho_east_m + ortho.posting_m * np.arange(columns)
    posts_y = ortho.south_m - raster.south_m - source.ortho_north_m + ortho.posting_m * np.arange(rows)
    spline = RectBivariateSpline(posts_y, posts_x, logarithm, kx=1, ky=1)
    tone = spline(np.clip(y, posts_y[0], posts_y[-1]), np.clip(x, posts_x[0], posts_x[-1]))
    return tone.astype(np.float32), holes


def grid_for(source: RealTerrain) -> tuple[int, float]:
    """Samples and spacing of a terrain that holds the file's at its own posting, with a surround. TerrainFileError."""
    raster, _ = read_rasters(source)
    wanted = 1.5 * max(raster.values.shape)
    samples = 64
    while samples < wanted:
        samples *= 2
    if samples > LARGEST_SIDE:
        raise TerrainFileError(f"{source.dtm} has {max(raster.values.shape)} posts along a side; at most 5461 fit")
    return samples, raster.posting_m


#: Heights and tones finer than a DTM's posting.
Detail = tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]


def detail_below(ground: Ground, real: Embedded) -> Detail:
    """What the ground has of waves shorter than twice the DTM's posting, where the DTM lies.

    The remainder of a Gaussian low-pass whose amplitude is a half at that wavelength.
    """
    sigma = real.extent.posting_m * np.sqrt(2.0 * np.log(2.0)) / np.pi / ground.spacing_m
    height, tone = (
        (grid - gaussian_filter(grid, sigma, mode="wrap"))[real.rows, real.columns]
        for grid in (ground.height, ground.tone)
    )
    return height, tone


def lay_in(ground: Ground, real: Embedded, detail: Detail | None) -> None:
    """Puts the real terrain into its place, in place. The surround is bent to meet it at the border, smoothly."""
    height = real.height if detail is None else real.height + detail[0]
    _bend(ground, real)
    area = ground.height[real.rows, real.columns]
    area += real.weight * (height - area)
    if real.tone is not None:
        tone = real.tone if detail is None else real.tone + detail[1]
        area = ground.tone[real.rows, real.columns]
        area += real.weight * (tone - area)


def _bend(ground: Ground, real: Embedded) -> None:
    """Adds a membrane: the difference of the two along the real terrain's border, continued outwards.

    Laplace's equation on a coarse periodic grid, by successively finer relaxation.
    """
    step = max(ground.side // BENDING_SIDE, 1)
    known = np.zeros((ground.side, ground.side), dtype=bool)
    known[real.rows, real.columns] = real.weight > 0.0
    difference = np.zeros((ground.side, ground.side), dtype=np.float32)
    difference[real.rows, real.columns] = real.height - ground.height[real.rows, real.columns]
    membrane = _membrane(difference[::step, ::step].astype(np.float64), known[::step, ::step])
    np.add(ground.height, finer(membrane.astype(np.float32), ground.side), out=ground.height)


def _membrane(
    values: Float64[np.ndarray, "side side"], known: Bool[np.ndarray, "side side"]
) -> Float64[np.ndarray, "side side"]:
    """Values continued where they are not known: the mean of the neighbours, on a periodic grid."""
    if known.shape[0] > 8 and known[::2, ::2].any():
        start = np.repeat(np.repeat(_membrane(values[::2, ::2], known[::2, ::2]), 2, axis=0), 2, axis=1)
    else:
        start = np.full(values.shape, float(values[known].mean()))
    for _ in range(60):
        around = np.roll(start, 1, 0) + np.roll(start, -1, 0) + np.roll(start, 1, 1) + np.roll(start, -1, 1)
        start = np.where(known, values, 0.25 * around)
    return start
