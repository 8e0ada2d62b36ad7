"""Stops and path of a tracking case, read from its products."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from marsyard.reports.images import Image
from marsyard.reports.products import Products, array_of_shape, numeric_product, to_matrix

#: Valid numbers of stops.
_STOP_NUMBERS = range(1, 1000)


@dataclass(frozen=True)
class StopImages:
    """Subframes of a stop with search window and matches, full-frame (u, v) pixels; NaN where missing.

    - number: number of the stop, from 1; state: state of the tracker
    - corners: upper left pixels of the left and the right subframe
    - window_corner, window_size: upper left pixel, and columns and rows, of the search window in the left frame
    - matches: positions of the match in the left and the right frame
    - point: true projection of the designated point in the left frame
    - quantities: quantities of the update by name
    """

    number: int
    state: str
    left: Image
    right: Image | None
    corners: Float[np.ndarray, "2 2"]
    window_corner: Float[np.ndarray, "2"]
    window_size: Float[np.ndarray, "2"]
    matches: Float[np.ndarray, "2 2"]
    point: Float[np.ndarray, "2"]
    quantities: Mapping[str, float]

    @property
    def is_matched(self) -> bool:
        """Whether the tracker reported the target."""
        return bool(np.isfinite(self.matches[0]).all())

    def quantity(self, name: str) -> float:
        """Return a quantity of the update; NaN if missing."""
        return self.quantities.get(name, float("nan"))


@dataclass(frozen=True)
class RoverPath:
    """Top view of a run, world metres (east, north).

    - path: positions of the rover's origin
    - stops, estimated: true and estimated position of the rover at each stop
    - heading: heading at each stop, radians clockwise from north; NaN if unknown
    - target: the designated point
    - estimates: estimated target at each stop in the rover's estimated world frame; NaN without a match
    - rocks: east, north and diameter; the first rock is that of the target
    """

    path: Float[np.ndarray, "points 2"]
    stops: Float[np.ndarray, "stops 2"]
    estimated: Float[np.ndarray, "stops 2"]
    heading: Float[np.ndarray, "stops"]
    target: Float[np.ndarray, "2"]
    estimates: Float[np.ndarray, "stops 2"]
    rocks: Float[np.ndarray, "rocks 3"]


def is_vtt_case(products: Products) -> bool:
    """Whether products contain the image of a stop and a template's size."""
    return to_matrix(products.get("stop_1_left")) is not None and read_template_px(products) is not None


def read_template_px(products: Products) -> float | None:
    """Read the side of the template, pixels; None if unknown."""
    side = numeric_product(products.get("template_px"))
    return float(side) if side is not None and side.ndim == 0 and np.isfinite(side) else None


def read_stops(products: Products) -> list[StopImages]:
    """Read the stops in order, up to the first stop without a left subframe."""
    stops: list[StopImages] = []
    states, table = products.get("states"), products.get("figures")
    items = table.items() if isinstance(table, Mapping) else ()
    columns = {str(name): numeric_product(values) for name, values in items}
    arrays = {name: values for name, values in columns.items() if values is not None and values.ndim == 1}
    for number in _STOP_NUMBERS:
        left = to_matrix(products.get(f"stop_{number}_left"))
        if left is None:
            return stops
        state = states[number - 1] if isinstance(states, list) and number <= len(states) else ""
        prefix = f"stop_{number}_"
        window_corner, window_size = _read_or_nan(products.get(f"{prefix}window"), 4).reshape(2, 2)
        stops.append(
            StopImages(
                number=number,
                state=str(state).replace("_", " ").lower(),
                left=left,
                right=to_matrix(products.get(f"{prefix}right")),
                corners=_read_or_nan(products.get(f"{prefix}corners"), 2, 2),
                window_corner=window_corner,
                window_size=window_size,
                matches=_read_or_nan(products.get(f"{prefix}matches"), 2, 2),
                point=_read_or_nan(products.get(f"{prefix}point"), 2),
                quantities={name: float(array[number - 1]) for name, array in arrays.items() if number <= array.size},
            )
        )
    return stops


def read_rover_path(products: Products) -> RoverPath | None:
    """Read the top view of the run; None if missing."""
    target = numeric_product(products.get("target_m"))
    stops, estimated = _read_positions(products.get("rover_true_m")), _read_positions(products.get("rover_estimated_m"))
    estimates = _read_positions(products.get("target_estimated_m"))
    if target is None or target.shape != (3,) or not stops.size or len({*map(len, (stops, estimates, estimated))}) > 1:
        return None
    path, rocks = _read_positions(products.get("path_true_m")), array_of_shape(products.get("rocks_m"), None, 3)
    rocks = np.empty((0, 3)) if rocks is None else rocks
    heading = np.radians(_read_or_nan(products.get("heading_deg"), len(stops)))
    return RoverPath(path if path.size else stops, stops, estimated, heading, target[:2], estimates, rocks)


def _read_or_nan(value: object, *shape: int) -> Float[np.ndarray, "..."]:
    values = array_of_shape(value, *shape)
    return np.full(shape, np.nan) if values is None else values


def _read_positions(value: object) -> Float[np.ndarray, "n 2"]:
    """Read east and north of world positions; shape (0, 2) if the product is invalid."""
    arrays = [array for width in (2, 3) if (array := array_of_shape(value, None, width)) is not None]
    return np.asarray(arrays[0][:, :2]) if arrays else np.empty((0, 2))
