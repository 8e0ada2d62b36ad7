"""How a map projection distorts lengths, and where its grid's north points, in the middle of a GeoTIFF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

#: Where the meridians are closer than this many cells the direction of true north is not stated.
_POLE_CELLS = 2.0


@dataclass(frozen=True)
class MapScale:
    """A map projection in one place.

    Attributes
    ----------
    smallest, largest
        Smallest and largest length on the map over the length on the ground, of all directions; the singular values of
        the projection's derivative (Snyder 1987, Map Projections: A Working Manual, section 4). Equal to each other
        where the projection is conformal.
    grid_north_deg
        Grid convergence: azimuth of the grid's north (up the columns), clockwise from true north, degrees, -180 to 180.
        None at a pole.
    """

    smallest: float
    largest: float
    grid_north_deg: float | None


def map_scale(file: Any) -> MapScale | None:
    """The scale of a rasterio dataset's projection in its middle; None where its inverse is not known."""
    from rasterio.errors import RasterioError

    try:
        east, north, normal, radius = _derivative(file)
    except (RasterioError, ValueError):
        return None
    gram = np.array([[east @ east, east @ north], [east @ north, north @ north]])
    if not np.all(np.isfinite(gram)) or np.linalg.det(gram) <= 0.0:
        return None
    ground = np.sqrt(np.linalg.eigvalsh(gram))
    return MapScale(1.0 / float(ground[1]), 1.0 / float(ground[0]), _azimuth_deg(north, normal, radius, file))


def _derivative(
    file: Any,
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float]:
    """Metres on the ground for a metre on the map along x and along y, shape (3,), body-fixed axes.

    Central differences of body-centred positions, which have no singularity at the poles. Further the unit normal of
    the body there, and the distance from its axis, metres.
    """
    from rasterio.crs import CRS
    from rasterio.warp import transform

    terms = file.crs.to_dict()
    body = {name: terms[name] for name in ("a", "b", "R", "ellps", "datum", "rf") if name in terms}
    centred = CRS.from_dict({"proj": "geocent", **body, "units": "m", "no_defs": True})
    cell = file.transform
    x, y = cell.c + 0.5 * file.width * cell.a, cell.f + 0.5 * file.height * cell.e
    # long enough for rounding, short enough for the projection's own curvature
    step = max(abs(cell.a), 1.0)
    xs, ys = [x - step, x + step, x, x], [y, y, y - step, y + step]
    places = np.array(transform(file.crs, centred, xs, ys, [0.0] * 4), dtype=np.float64).T
    length = 2.0 * step * float(file.crs.linear_units_factor[1])
    east, north = (places[1] - places[0]) / length, (places[3] - places[2]) / length
    normal = np.cross(east, north)
    radius = float(np.hypot(*places.mean(axis=0)[:2]))
    return east, north, normal / max(float(np.linalg.norm(normal)), 1e-300), radius


def _azimuth_deg(
    along: Float64[np.ndarray, "3"], normal: Float64[np.ndarray, "3"], radius_m: float, file: Any
) -> float | None:
    """Azimuth of a direction on the ground, clockwise from true north; None at a pole."""
    if radius_m < _POLE_CELLS * abs(file.transform.a) * float(file.crs.linear_units_factor[1]):
        return None
    true_east = np.cross([0.0, 0.0, 1.0], normal)
    true_north = np.cross(normal, true_east)
    return float(np.degrees(np.arctan2(along @ true_east, along @ true_north)))
