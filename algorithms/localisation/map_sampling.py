"""Sampling of the map: coordinates, interpolation, averages, binning, and intersection of rays with its elevation."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.localisation.interface import MapProduct

#: Iterations of the intersection of rays with the elevation.
_ITERATIONS = 5


def map_pixels(map_product: MapProduct, points: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape 2"]:
    """Map pixels (column, row) of horizontal world points (x, y), metres."""
    return np.asarray((points - map_product.origin_m) / map_product.pixel_m)


def sample_raster(
    raster: Float32[np.ndarray, "rows columns"], pixels: Float[np.ndarray, "n m 2"]
) -> Float32[np.ndarray, "n m"]:
    """Interpolate a raster bilinearly at pixels (column, row); outside, the border values continue.

    OpenCV rounds coordinates to 1/32 pixel. The rounding has zero mean, so that it does not shift a patch.
    """
    columns, rows = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
    return np.asarray(cv2.remap(raster, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def sample_averages(
    raster: Float32[np.ndarray, "rows columns"], pixels: Float[np.ndarray, "patches n m 2"]
) -> Float32[np.ndarray, "patches n m"]:
    """Average a raster over the cells of grids of positions (column, row): four samples in each cell.

    The cell of a grid position extends halfway to its neighbours. Four bilinear samples average over cells of up to
    about three raster pixels without gaps.
    """
    patches, rows, columns = pixels.shape[:3]
    along_rows, along_columns = np.gradient(pixels, axis=1), np.gradient(pixels, axis=2)
    total = np.zeros((patches * rows, columns), np.float32)
    for row_sign in (-0.25, 0.25):
        for column_sign in (-0.25, 0.25):
            shifted = pixels + row_sign * along_rows + column_sign * along_columns
            total += sample_raster(raster, shifted.reshape(patches * rows, columns, 2))
    return np.asarray((0.25 * total).reshape(patches, rows, columns))


def bin_map(map_product: MapProduct, factor: int) -> MapProduct:
    """Average blocks of `factor` x `factor` map pixels; incomplete blocks at the upper ends are left out."""
    rows, columns = (extent // factor for extent in map_product.appearance.shape)

    def average(raster: Float32[np.ndarray, "_ _"]) -> Float32[np.ndarray, "_ _"]:
        cropped = np.ascontiguousarray(raster[: rows * factor, : columns * factor])
        return np.asarray(cv2.resize(cropped, (columns, rows), interpolation=cv2.INTER_AREA))

    return replace(
        map_product,
        appearance=average(map_product.appearance),
        elevation_m=average(map_product.elevation_m),
        origin_m=map_product.origin_m + 0.5 * (factor - 1) * map_product.pixel_m,
        pixel_m=factor * map_product.pixel_m,
    )


def inside_map(map_product: MapProduct, points: Float[np.ndarray, "*shape 2"]) -> Bool[np.ndarray, "*shape"]:
    """Whether horizontal world points lie inside the map, between the centres of its outermost pixels."""
    rows, columns = map_product.appearance.shape
    pixels = map_pixels(map_product, points)
    return np.asarray(np.all((pixels >= 0.0) & (pixels <= np.array([columns - 1.0, rows - 1.0])), axis=-1))


def elevation_at(map_product: MapProduct, point: Vector2) -> float:
    """Elevation of the map at a horizontal world point (x, y); outside, that of the nearest point of the map."""
    pixels = map_pixels(map_product, point).reshape(1, 1, 2)
    return float(sample_raster(map_product.elevation_m, pixels)[0, 0])


def intersect_elevation(
    map_product: MapProduct,
    origins: Float[np.ndarray, "n m 3"],
    directions: Float[np.ndarray, "n m 3"],
    start_m: Float[np.ndarray, "n 1"],
) -> Float[np.ndarray, "n m 2"]:
    """Intersect rays with the map's elevation by fixed-point iteration over the elevation; return (x, y), metres.

    The error shrinks in each iteration by the slope of the ground times the tangent of the off-nadir angle.

    - start_m: elevation at which the iteration starts
    """
    slopes = directions[..., :2] / directions[..., 2:]
    offsets = origins[..., :2] - origins[..., 2:] * slopes
    elevation: Float[np.ndarray, "n m"] = np.broadcast_to(start_m, directions.shape[:2])
    for _ in range(_ITERATIONS):
        points = offsets + elevation[..., np.newaxis] * slopes
        elevation = sample_raster(map_product.elevation_m, map_pixels(map_product, points))
    return np.asarray(offsets + elevation[..., np.newaxis] * slopes)
