"""Boxes in figures of cases, for the tests of their positions."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure


@dataclass(frozen=True)
class DrawnBox:
    """Outline of a rectangle in a figure, pixels (u, v)."""

    corner: Float[np.ndarray, "2"]
    size: Float[np.ndarray, "2"]
    is_dashed: bool

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """Centre of the rectangle."""
        return self.corner + 0.5 * self.size


def find_boxes(drawn: Figure | Axes, colour: str) -> list[DrawnBox]:
    """Find the rectangles of a colour: closed lines through five points."""
    lines = [line for axes in (drawn.axes if isinstance(drawn, Figure) else [drawn]) for line in axes.lines]
    boxes = []
    for line in lines:
        points = np.column_stack(line.get_data())
        if to_rgba(line.get_color()) == to_rgba(colour) and len(points) == 5 and (points[0] == points[-1]).all():
            boxes.append(DrawnBox(points.min(axis=0), np.ptp(points, axis=0), line.get_linestyle() != "-"))
    return boxes
