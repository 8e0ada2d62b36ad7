"""Scale and grid convergence of a map projection, from positions that PROJ computes."""

from dataclasses import dataclass
from typing import Any

import numpy as np

#: Distance from a pole, in cells, below which the direction of true north is undefined.
_POLE_CELLS = 2.0


@dataclass(frozen=True)
class MapScale:
    """Scale of a map projection at a point.

    - min_ratio, max_ratio: extreme ratios of map lengths to ground lengths over all directions: the singular
      values of the projection's derivative (Snyder 1987, Map Projections: A Working Manual, section 4)
    - grid_north_deg: grid convergence: azimuth of the columns' upward direction, clockwise from true north, -180 to
      180; None at a pole
    """

    min_ratio: float
    max_ratio: float
    grid_north_deg: float | None


class NoInverseError(Exception):
    """PROJ cannot compute the ground position of a point of a map projection."""


def map_scale(file: Any) -> MapScale | None:
    """Compute the scale of a rasterio dataset's projection at its centre; None if its terms are unknown.

    Raises NoInverseError for a projection without inverse.
    """
    from rasterio._err import CPLE_BaseError  # GDAL's errors, which are no RasterioError
    from rasterio.crs import CRS
    from rasterio.errors import RasterioError
    from rasterio.warp import transform

    cell = file.transform
    x, y = cell.c + 0.5 * file.width * cell.a, cell.f + 0.5 * file.height * cell.e
    # central differences of positions in body-fixed axes, which have no singularity at the poles; the step is large
    # compared with rounding and small compared with the curvature of the projection
    step = max(abs(cell.a), 1.0)
    xs, ys = [x - step, x + step, x, x], [y, y, y - step, y + step]  # west, east, south, north
    try:
        terms, (_, unit_m) = file.crs.to_dict(), file.crs.linear_units_factor
        body = {name: terms[name] for name in ("a", "b", "R", "ellps", "datum", "rf") if name in terms}
        body_fixed = CRS.from_dict({"proj": "geocent", **body, "units": "m", "no_defs": True})
        west, east, south, north = np.array(transform(file.crs, body_fixed, xs, ys, [0.0] * 4), dtype=np.float64).T
    except (RasterioError, ValueError):
        return None
    except CPLE_BaseError as error:
        raise NoInverseError(str(error)) from error
    # derivatives of the ground position with respect to the map's x and y
    length = 2.0 * step * unit_m
    tangent_x, tangent_y = (east - west) / length, (north - south) / length
    # the eigenvalues of the Gram matrix are the squared extreme ratios
    gram = np.array([[tangent_x @ tangent_x, tangent_x @ tangent_y], [tangent_x @ tangent_y, tangent_y @ tangent_y]])
    if not np.all(np.isfinite(gram)) or np.linalg.det(gram) <= 0.0:
        return None
    min_ground_ratio, max_ground_ratio = np.sqrt(np.linalg.eigvalsh(gram)).tolist()
    azimuth_deg = None
    axis_distance_m = float(np.hypot(*(0.25 * (west + east + south + north))[:2]))
    if axis_distance_m >= _POLE_CELLS * abs(cell.a) * unit_m:
        normal = np.cross(tangent_x, tangent_y)
        normal = normal / np.linalg.norm(normal)
        true_east = np.cross([0.0, 0.0, 1.0], normal)
        true_north = np.cross(normal, true_east)
        azimuth_deg = float(np.degrees(np.arctan2(tangent_y @ true_east, tangent_y @ true_north)))
    return MapScale(1.0 / max_ground_ratio, 1.0 / min_ground_ratio, azimuth_deg)
