"""Nadir image of a terrain (`marsyard terrain stats --image`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from marsyard.sim.terrain import Surface
    from marsyard.sim.terrain.imported import EmbeddedDtm

#: Nadir image: maximum side length, pixels; colours (blue, green, red) of filled holes and of the outline of a DTM.
MAX_SIDE_PX = 2048
HOLE_COLOUR, OUTLINE_COLOUR = (40, 40, 220), (0, 200, 255)


def write_terrain_image(path: Path, surface: Surface, dtm: EmbeddedDtm | None) -> None:
    """Write a shaded nadir image of a terrain as PNG, grid north up; mark a DTM's outline and filled holes.

    Raises ValueError if the file exists or cannot be written.
    """
    import cv2
    import numpy as np

    from marsyard.sim.terrain.statistics import CONTRAST_SUN_ELEVATION_DEG, render_nadir_image

    if path.suffix.lower() != ".png":
        raise ValueError(f"--image {path}: the file name must end in .png")
    if path.exists():
        raise ValueError(f"--image {path}: exists; choose another name")
    side = len(surface.levels[0])
    level = max(int(np.ceil(np.log2(side / MAX_SIDE_PX))), 0)
    # light from the north-west, as usual for shaded relief
    shaded = render_nadir_image(surface, level, np.radians(315.0), np.radians(CONTRAST_SUN_ELEVATION_DEG))
    # scale the brightness; the brightest 0.2 % of the pixels are saturated
    grey = np.clip(255.0 * shaded / np.percentile(shaded, 99.8), 0.0, 255.0).astype(np.uint8)
    image = np.repeat(grey[..., None], 3, axis=2)
    if dtm is not None:
        step = 2**level
        holes = dtm.filled_samples(side)[::step, ::step]
        image[holes] = (0.4 * image[holes] + 0.6 * np.array(HOLE_COLOUR)).astype(np.uint8)
        south_west = dtm.columns.start // step, dtm.rows.start // step
        north_east = dtm.columns.stop // step, dtm.rows.stop // step
        cv2.rectangle(image, south_west, north_east, OUTLINE_COLOUR, 1)
    try:
        is_written = cv2.imwrite(str(path), image[::-1])
    except cv2.error as error:
        raise ValueError(f"--image {path}: cannot be written ({error})") from error
    if not is_written:
        raise ValueError(f"--image {path}: cannot be written")
