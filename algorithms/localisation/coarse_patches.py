"""Patches of the coarse stage: selection in rectified images, and correlation with the map at all offsets."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Raster
from marsyard.algorithms.image.interest import harris_interest, structure_tensor
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.rectification import RectifiedImage

#: Support of the structure tensor for the contrast of a patch, coarse pixels, and spacing of candidate patches.
_CONTRAST_SUPPORT_PX = 5
_PATCH_STEP_PX = 8
#: Minimum distance of two patches of an image, in sides of a patch; largest side of a patch, as a fraction of the side
#: of the image's footprint.
_PATCH_SPACING = 0.75
_FOOTPRINT_FRACTION = 0.4
#: Minimum standard deviation of a patch relative to its mean: below it, only noise and rounding remain (assumed).
_MIN_PATCH_CONTRAST = 1e-3


@dataclass(frozen=True)
class ImagePatch:
    """Patch of a rectified image: corner (column, row) on the map's grid, values, number of its image."""

    corner: tuple[int, int]
    values: Raster
    image: int

    @property
    def side(self) -> int:
        """Side, map pixels."""
        return len(self.values)


def select_patches(rectified: RectifiedImage, grid: MapProduct, number: int, options: LvsOptions) -> list[ImagePatch]:
    """Select the patches with the highest contrast, apart from each other, inside image and map."""
    extent = float(np.sqrt(np.count_nonzero(rectified.valid)))
    side = min(options.patch_px, int(_FOOTPRINT_FRACTION * extent))
    if side < options.min_patch_px:
        return []
    mean = float(rectified.values[rectified.valid].mean())
    if not mean > 0.0:
        return []
    values = np.where(rectified.valid, rectified.values - np.float32(mean), np.float32(0.0))
    interest = harris_interest(*structure_tensor(values, _CONTRAST_SUPPORT_PX))
    contrasts = cv2.boxFilter(interest.astype(np.float32), cv2.CV_32F, (side, side), anchor=(0, 0))
    filled = cv2.boxFilter(rectified.valid.astype(np.float32), cv2.CV_32F, (side, side), anchor=(0, 0)) > 0.9999
    rows = np.arange(0, values.shape[0] - side + 1, _PATCH_STEP_PX)
    columns = np.arange(0, values.shape[1] - side + 1, _PATCH_STEP_PX)
    map_columns, map_rows = columns + rectified.corner[0], rows + rectified.corner[1]
    on_map_columns = (map_columns >= 0) & (map_columns + side <= grid.appearance.shape[1])
    on_map_rows = (map_rows >= 0) & (map_rows + side <= grid.appearance.shape[0])
    lattice = np.ix_(rows, columns)
    scores = np.where(filled[lattice] & on_map_rows[:, np.newaxis] & on_map_columns, contrasts[lattice], -1.0)
    patches: list[ImagePatch] = []
    while len(patches) < options.patches_per_image and scores.max(initial=-1.0) > 0.0:
        i, j = np.unravel_index(int(np.argmax(scores)), scores.shape)
        row, column = int(rows[i]), int(columns[j])
        square = values[row : row + side, column : column + side]
        if square.std() >= _MIN_PATCH_CONTRAST * mean:
            patches.append(ImagePatch((int(map_columns[j]), int(map_rows[i])), square, number))
        near_rows = np.abs(rows - row) < _PATCH_SPACING * side
        near_columns = np.abs(columns - column) < _PATCH_SPACING * side
        scores[near_rows[:, np.newaxis] & near_columns] = -1.0
    return patches


def correlate_patch(patch: ImagePatch, appearance: Raster, radius: int) -> Float[np.ndarray, "n n"]:
    """Normalised correlation of a patch at all offsets up to `radius` (rows, columns); -1 outside map and circle."""
    column, row = patch.corner
    rows, columns = appearance.shape
    side, full = patch.side, 2 * radius + 1
    low_row, low_column = max(row - radius, 0), max(column - radius, 0)
    high_row, high_column = min(row + side + radius, rows), min(column + side + radius, columns)
    surface = np.full((full, full), -1.0, np.float32)
    window = np.ascontiguousarray(appearance[low_row:high_row, low_column:high_column], dtype=np.float32)
    template = (patch.values - patch.values.mean()).astype(np.float32)
    values = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    first_row, first_column = low_row - row + radius, low_column - column + radius
    surface[first_row : first_row + values.shape[0], first_column : first_column + values.shape[1]] = values
    steps = np.arange(-radius, radius + 1)
    surface[steps[:, np.newaxis] ** 2 + steps**2 > radius**2] = -1.0
    return np.where(np.isfinite(surface), surface, np.float32(-1.0))
