"""What a case of visual target tracking keeps, read for figures: its stops and its way, see
`marsyard.scenarios.rover.score`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from marsyard.reports.presentation import numbers, plane, shaped

#: Numbers that stops may have.
_STOPS = range(1, 1000)


@dataclass(frozen=True)
class StopPictures:
    """A stop: its subframes, and what was looked for and found in them, full-frame (u, v) pixels.

    Attributes
    ----------
    number
        From 1.
    state
        The tracker's, in words.
    left, right
        Counts of the subframes.
    corners
        Of their upper left pixels, shape (2, 2).
    window
        Upper left pixel, columns and rows of the search window in the left frame; NaN without one.
    found
        In the left and the right frame, shape (2, 2); NaN where nothing was.
    point
        True projection of the designated point in the left frame.
    figures
        Numbers of the update by name; NaN where there are none.
    """

    number: int
    state: str
    left: Float[np.ndarray, "_ _"]
    right: Float[np.ndarray, "_ _"] | None
    corners: Float[np.ndarray, "2 2"]
    window: Float[np.ndarray, "4"]
    found: Float[np.ndarray, "2 2"]
    point: Float[np.ndarray, "2"]
    figures: Mapping[str, float]

    @property
    def is_found(self) -> bool:
        """Whether the target was reported."""
        return bool(np.isfinite(self.found[0]).all())

    def figure(self, name: str) -> float:
        """One of the update's numbers; NaN where it has none of this name."""
        return self.figures.get(name, float("nan"))


@dataclass(frozen=True)
class Way:
    """A run seen from above, world metres (east, north).

    Attributes
    ----------
    path
        The rover's origin along its way, shape (points, 2).
    stops, believed
        Where it stood at each stop, and where it believed to stand, shape (stops, 2).
    heading
        Where it looked at each stop, radians clockwise from north; NaN where that is not kept.
    target
        The designated point.
    estimates
        The target as estimated at each stop, in the world as the rover believed; NaN where not found.
    rocks
        East, north and diameter, the target's first, shape (rocks, 3).
    """

    path: Float[np.ndarray, "points 2"]
    stops: Float[np.ndarray, "stops 2"]
    believed: Float[np.ndarray, "stops 2"]
    heading: Float[np.ndarray, "stops"]
    target: Float[np.ndarray, "2"]
    estimates: Float[np.ndarray, "stops 2"]
    rocks: Float[np.ndarray, "rocks 3"]


def is_vtt_case(products: Mapping[str, Any]) -> bool:
    """Whether products hold a stop's picture and a template's size, as those of a tracking case do."""
    return plane(products.get("stop_1_left")) is not None and template_px(products) is not None


def template_px(products: Mapping[str, Any]) -> float | None:
    """Side of the template; None where the products do not tell it."""
    side = numbers(products.get("template_px"))
    return float(side) if side is not None and side.ndim == 0 and np.isfinite(side) else None


def stops_of(products: Mapping[str, Any]) -> list[StopPictures]:
    """The stops in order, up to the first whose left subframe is missing."""
    found: list[StopPictures] = []
    states = products.get("states")
    for number in _STOPS:
        left = plane(products.get(f"stop_{number}_left"))
        if left is None:
            return found
        state = states[number - 1] if isinstance(states, list) and number <= len(states) else ""
        found.append(
            StopPictures(
                number=number,
                state=str(state).replace("_", " ").lower(),
                left=left,
                right=plane(products.get(f"stop_{number}_right")),
                corners=_shaped(products.get(f"stop_{number}_corners"), 2, 2),
                window=_shaped(products.get(f"stop_{number}_window"), 4),
                found=_shaped(products.get(f"stop_{number}_found"), 2, 2),
                point=_shaped(products.get(f"stop_{number}_point"), 2),
                figures=_figures(products.get("figures"), number - 1),
            )
        )
    return found


def way_of(products: Mapping[str, Any]) -> Way | None:
    """The run seen from above; None where the products do not hold it."""
    target = numbers(products.get("target_m"))
    stops, believed = _places(products.get("rover_true_m")), _places(products.get("rover_believed_m"))
    estimates = _places(products.get("target_believed_m"))
    if target is None or target.shape != (3,) or not stops.size:
        return None
    if not stops.shape == estimates.shape == believed.shape:
        return None
    path, rocks = _places(products.get("path_true_m")), shaped(products.get("rocks_m"), None, 3)
    rocks = np.empty((0, 3)) if rocks is None else rocks
    heading = np.radians(_shaped(products.get("heading_deg"), len(stops)))
    return Way(path if path.size else stops, stops, believed, heading, target[:2], estimates, rocks)


def _figures(table: object, place: int) -> dict[str, float]:
    if not isinstance(table, Mapping):
        return {}
    arrays = {str(name): numbers(values) for name, values in table.items()}
    return {name: float(a[place]) for name, a in arrays.items() if a is not None and a.ndim == 1 and place < a.size}


def _shaped(value: object, *shape: int) -> Float[np.ndarray, "..."]:
    """A product of this shape; NaN where it is not of it."""
    values = shaped(value, *shape)
    return np.full(shape, np.nan) if values is None else values


def _places(value: object) -> Float[np.ndarray, "n 2"]:
    """East and north of world positions; none where the product is something else."""
    values = next((one for width in (2, 3) if (one := shaped(value, None, width)) is not None), np.empty((0, 2)))
    return np.asarray(values[:, :2])
