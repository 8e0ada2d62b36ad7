"""Distances and dilation of masks."""

import cv2
import numpy as np

from marsyard.algorithms.arrays import Mask, Raster


def grassfire(mask: Mask) -> Raster:
    """Grassfire transform (Blum 1973): distance of every cell to the nearest true cell of a mask, in cells.

    Infinite if no cell is true.
    """
    if not np.any(mask):
        return np.full(mask.shape, np.inf)
    distances = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distances.astype(np.float64))


def dilate(mask: Mask, radius_cells: float) -> Mask:
    """Dilate a mask by a disc: a cell becomes true within `radius_cells` of a true cell."""
    return np.asarray(mask | (grassfire(mask) <= radius_cells))
