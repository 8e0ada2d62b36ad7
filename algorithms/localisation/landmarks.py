"""Landmarks: points of the map with contrast in all directions, and their selection for one image."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from marsyard.algorithms.arrays import Points2, Points3, Raster, Vector
from marsyard.algorithms.image.interest import harris_interest, structure_tensor
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.sim.camera import CameraModel

#: Minimum number of cells in the image's footprint per selected landmark; determines the level of the cells.
_CANDIDATES_PER_LANDMARK = 6
#: Largest level of a landmark: the cells are doubled at most this many times.
_MAX_LEVEL = 6


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of a map, at most one in each cell of a grid.

    - points_m: positions in the world frame; the elevation is the map's
    - interest: Harris interest divided by the map's mean, per map pixel
    - levels: number of times that the cells can be doubled in side so that the landmark is still the best of its cell
    - cell_m: side of the cells of level 0
    """

    points_m: Points3
    interest: Vector
    levels: Int[np.ndarray, "n"]
    cell_m: float


def select_landmarks(map_product: MapProduct, options: LvsOptions) -> Landmarks:
    """Select the pixel with the highest Harris interest in each cell of the map; computed once per map.

    Cells without contrast, and pixels closer to the border than a template's side, have no landmark.
    """
    interest = harris_interest(*structure_tensor(map_product.appearance, options.landmark_support_px))
    interest = interest / max(float(np.abs(map_product.appearance.mean())), np.finfo(np.float32).tiny)
    border = options.template_px
    interest[:border] = interest[-border:] = 0.0
    interest[:, :border] = interest[:, -border:] = 0.0
    rows, columns, values = _best_of_cells(interest, options.landmark_spacing_px)
    accepted = values >= options.min_interest
    rows, columns, values = rows[accepted], columns[accepted], values[accepted]
    points = np.empty((len(values), 3))
    points[:, 0] = map_product.origin_m[0] + columns * map_product.pixel_m
    points[:, 1] = map_product.origin_m[1] + rows * map_product.pixel_m
    points[:, 2] = map_product.elevation_m[rows, columns]
    levels = _compute_levels(rows, columns, values, options.landmark_spacing_px)
    return Landmarks(points, values.astype(np.float64), levels, options.landmark_spacing_px * map_product.pixel_m)


def _best_of_cells(interest: Raster, side: int) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Vector]:
    """Rows, columns and values of the maxima of square cells; an incomplete cell at the border is left out."""
    cell_rows, cell_columns = interest.shape[0] // side, interest.shape[1] // side
    blocks = interest[: cell_rows * side, : cell_columns * side].reshape(cell_rows, side, cell_columns, side)
    cells = np.ascontiguousarray(blocks.swapaxes(1, 2)).reshape(cell_rows * cell_columns, side * side)
    best = cells.argmax(axis=1)
    index = np.arange(len(cells))
    rows = index // cell_columns * side + best // side
    columns = index % cell_columns * side + best % side
    return rows, columns, cells[index, best]


def _compute_levels(
    rows: Int[np.ndarray, "n"], columns: Int[np.ndarray, "n"], values: Vector, side: int
) -> Int[np.ndarray, "n"]:
    """Compute `Landmarks.levels`: at each level, the best landmark of each doubled cell remains."""
    levels = np.zeros(len(values), dtype=np.int64)
    remaining = np.argsort(-values, kind="stable")
    for level in range(1, _MAX_LEVEL + 1):
        # one integer per cell, from the cell's row and column
        cells = (rows[remaining] // (side << level)) * (1 << 32) + columns[remaining] // (side << level)
        remaining = remaining[np.sort(np.unique(cells, return_index=True)[1])]
        levels[remaining] = level
    return levels


def visible_landmarks(
    landmarks: Landmarks,
    image: PosedImage,
    camera: CameraModel,
    ground_m: float,
    border_px: int,
    count: int,
    max_off_nadir_rad: float,
) -> tuple[Int[np.ndarray, "k"], Points2]:
    """Indices and predicted pixels of at most `count` landmarks in the image, evenly spread over it.

    The best landmark of each cell of a square grid over the image is selected; the grid has at least `count` cells.

    - camera: camera model of the image in the world frame
    - ground_m: elevation of the ground below the camera
    - border_px: minimum distance from the image's border
    """
    height = max(float(camera.c[2]) - ground_m, 1.0)
    half_angle = min(image.camera.pixel_angle_rad * 0.5 * max(camera.size), max_off_nadir_rad)
    area = (2.0 * height * np.tan(half_angle)) ** 2
    level = int(np.floor(0.5 * np.log2(max(area / (_CANDIDATES_PER_LANDMARK * count * landmarks.cell_m**2), 1.0))))
    offsets = landmarks.points_m - camera.c
    distances = np.hypot(offsets[:, 0], offsets[:, 1])
    near = (distances <= -offsets[:, 2] * np.tan(max_off_nadir_rad)) & (landmarks.levels >= level)
    candidates = np.flatnonzero(near)
    pixels, visible = camera.project(landmarks.points_m[candidates])
    in_frame = visible & np.all((pixels >= border_px) & (pixels <= np.array(camera.size) - 1 - border_px), axis=1)
    candidates, pixels = candidates[in_frame], pixels[in_frame]
    order = np.argsort(-landmarks.interest[candidates], kind="stable")
    candidates, pixels = candidates[order], pixels[order]
    # the frame's cells are made smaller until enough of them are occupied
    side = int(np.ceil(np.sqrt(count)))
    first = np.arange(0)
    for cells_per_side in range(side, 2 * side):
        cells = np.floor(pixels / (np.array(camera.size) / cells_per_side)).astype(np.int64)
        first = np.unique(cells[:, 1] * cells_per_side + cells[:, 0], return_index=True)[1]
        if len(first) >= count or len(first) == len(candidates):
            break
    selected = np.sort(first)
    if len(selected) > count:
        selected = selected[np.linspace(0, len(selected) - 1, count).astype(np.int64)]
    return candidates[selected], pixels[selected]
