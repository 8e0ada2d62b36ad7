"""A terrain seen from straight above, as a picture: real ground grey, filled holes red, the real part outlined."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from marsyard.sim.terrain import Surface
    from marsyard.sim.terrain.embedding import Embedded

#: Longest side of a picture, pixels.
MAX_PIXELS = 2048
#: Blue, green, red.
HOLE_COLOUR, OUTLINE_COLOUR = (40, 40, 220), (0, 200, 255)


def write_terrain_picture(path: Path, surface: Surface, real: Embedded | None) -> None:
    """Write a shaded picture of a terrain, grid north up, as PNG; of an imported one the real part and its holes.

    Raises ValueError where the file exists, or cannot be written.
    """
    import cv2
    import numpy as np

    from marsyard.sim.terrain.statistics import CONTRAST_SUN_ELEVATION_DEG, nadir_picture

    if path.suffix.lower() != ".png":
        raise ValueError(f"--picture {path}: a file that ends in .png is needed")
    if path.exists():
        raise ValueError(f"--picture {path}: exists; choose another name")
    side = surface.levels[0].shape[0]
    level = max(int(np.ceil(np.log2(side / MAX_PIXELS))), 0)
    shaded = nadir_picture(surface, level, np.radians(315.0), np.radians(CONTRAST_SUN_ELEVATION_DEG))
    grey = np.clip(255.0 * shaded / np.percentile(shaded, 99.8), 0.0, 255.0).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    if real is not None:
        step = 2**level
        holes = real.filled_samples(side)[::step, ::step]
        picture[holes] = (0.4 * picture[holes] + 0.6 * np.array(HOLE_COLOUR)).astype(np.uint8)
        south_west = real.columns.start // step, real.rows.start // step
        north_east = real.columns.stop // step, real.rows.stop // step
        cv2.rectangle(picture, south_west, north_east, OUTLINE_COLOUR, 1)
    try:
        written = cv2.imwrite(str(path), picture[::-1])
    except cv2.error as fault:
        raise ValueError(f"--picture {path}: cannot be written ({fault})") from fault
    if not written:
        raise ValueError(f"--picture {path}: cannot be written")
