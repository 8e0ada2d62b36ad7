"""Rectification of images to the grid of a coarse map: onto a horizontal plane, or onto the map's elevation."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at, map_pixels, sample_averages, sample_raster
from marsyard.algorithms.localisation.posed_image import PosedImage, binning_factor
from marsyard.sim.camera import CameraModel

#: Spacing of the points that are projected with the full camera model, coarse pixels; a fisheye of 90 deg deviates from
#: bilinear interpolation between them by less than a tenth of an image pixel.
_NODE_STEP = 4
#: Size of a binned image pixel at the nadir before rounding, coarse pixels. The factor is rounded to a power of two;
#: the binned pixel has 0.5 to 1 coarse pixels, unless the image is coarser. `sample_averages` interpolates the image
#: at points half a coarse pixel apart. These points omit no image pixel if it has at least 0.5 coarse pixels. Image
#: pixels above 1 coarse pixel would lose detail of the coarse map.
_BINNED_PIXEL = 0.7


@dataclass(frozen=True)
class RectifiedImage:
    """An image resampled to the pixels of a map's grid, assuming the horizontal position of the estimated pose.

    - values: resampled signal
    - valid: pixels inside the image's frame and the off-nadir limit
    - corner: map pixel (column, row) of the first pixel; the pixels lie exactly on the map's grid
    """

    values: Float32[np.ndarray, "rows columns"]
    valid: Bool[np.ndarray, "rows columns"]
    corner: tuple[int, int]


@dataclass(frozen=True)
class GroundView:
    """An image binned to about the coarse map's pixel, and its camera relative to the ground.

    - image: binned image
    - camera: camera model in the world frame, at the estimated horizontal position; its height is that above the plane
      z = 0, which has the elevation of the ground below the lander
    """

    image: PosedImage
    camera: CameraModel


def view_ground(image: PosedImage, height_above_ground_m: float, pixel_m: float) -> GroundView:
    """Place an image above a horizontal plane at the measured height of the body's origin above the ground."""
    position = np.array([*image.position_m[:2], height_above_ground_m])
    level = replace(image, position_m=position)
    binned = level.bin(binning_factor(level, height_above_ground_m, _BINNED_PIXEL * pixel_m))
    return GroundView(binned, binned.world_camera)


def rectify_to_plane(view: GroundView, grid: MapProduct, max_off_nadir_rad: float) -> RectifiedImage:
    """Resample the whole image to the grid of a map, assuming level ground."""
    height = float(view.camera.c[2])
    radius = height * np.tan(max_off_nadir_rad)
    low, high = map_pixels(grid, view.camera.c[:2] - radius), map_pixels(grid, view.camera.c[:2] + radius)
    corner = np.floor(low).astype(np.int64)
    nodes = (np.ceil(high).astype(np.int64) - corner) // _NODE_STEP + 2
    columns, rows = corner[0] + _NODE_STEP * np.arange(nodes[0]), corner[1] + _NODE_STEP * np.arange(nodes[1])
    ground = np.zeros((len(rows), len(columns), 3))
    ground[..., 0], ground[..., 1] = (
        grid.origin_m[0] + grid.pixel_m * columns,
        (grid.origin_m[1] + grid.pixel_m * rows)[:, np.newaxis],
    )
    pixels, visible = view.camera.project(ground)
    off_nadir = np.hypot(*np.moveaxis(ground[..., :2] - view.camera.c[:2], -1, 0))
    usable = visible & view.camera.in_frame(pixels) & (off_nadir <= radius)
    size = (_NODE_STEP * (len(columns) - 1), _NODE_STEP * (len(rows) - 1))
    positions = np.arange(size[0]) / _NODE_STEP, np.arange(size[1]) / _NODE_STEP
    node_positions = np.stack(np.meshgrid(*positions), axis=-1)
    # image pixels (u, v) of all grid pixels, interpolated between the nodes
    fine = np.stack([sample_raster(pixels[..., k].astype(np.float32), node_positions) for k in (0, 1)], axis=-1)
    # a pixel is valid if all nodes around it are
    valid = sample_raster(usable.astype(np.float32), node_positions) > 0.999
    fine = np.where(valid[..., np.newaxis], fine, 0.0).astype(np.float32)
    values = sample_averages(view.image.radiance, fine[np.newaxis])[0]
    return RectifiedImage(values, valid, (int(corner[0]), int(corner[1])))


def rectify_patches(
    view: GroundView, grid: MapProduct, corners: Float[np.ndarray, "n 2"], side: int, offset_m: Vector2
) -> tuple[Float32[np.ndarray, "n side side"], Bool[np.ndarray, "n"]]:
    """Resample squares of the map's grid from the image, at the map's elevation and the position plus `offset_m`.

    Also returns whether all pixels lie inside the image and the map.

    - corners: map pixels (column, row) of the squares' first pixels
    """
    steps = np.arange(side, dtype=np.float64)
    pixels = corners[:, np.newaxis, np.newaxis, :] + np.stack(np.meshgrid(steps, steps), axis=-1)
    grid_rows = pixels.reshape(len(corners) * side, side, 2)
    ground = np.empty((*grid_rows.shape[:2], 3))
    # the camera is at the estimated position: the ground moves by the negative offset instead
    ground[..., :2] = grid.origin_m + grid.pixel_m * grid_rows - offset_m
    below = elevation_at(grid, view.image.position_m[:2] + offset_m)
    ground[..., 2] = sample_raster(grid.elevation_m, grid_rows) - below
    image_pixels, visible = view.camera.project(ground)
    last = np.array([grid.appearance.shape[1] - 1, grid.appearance.shape[0] - 1])
    inside = visible & view.camera.in_frame(image_pixels) & np.all((grid_rows >= 0) & (grid_rows <= last), axis=-1)
    image_pixels = np.where(visible[..., np.newaxis], image_pixels, 0.0)
    values = sample_averages(view.image.radiance, image_pixels.reshape(len(corners), side, side, 2))
    return values, np.asarray(inside.reshape(len(corners), -1).all(axis=1))
