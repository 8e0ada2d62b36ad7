"""Compiled shapes of bedrock: cracks, polygonal slabs and exposed strata."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import Array, Grid


class NearestCells(NamedTuple):
    """The Voronoi cells next to a position; lengths are in units of the squares of the points' grid.

    - row, column: of the nearest point; second_row, second_column: of the second nearest one
    - offset_x, offset_y: of the nearest point from the position
    - border: distance of the position from the border of both cells
    """

    row: int
    column: int
    second_row: int
    second_column: int
    offset_x: float
    offset_y: float
    border: float


@njit(cache=True, error_model="numpy")
def _find_cells(positions: Array, x: float, y: float) -> NearestCells:
    """Find the Voronoi cells next to x, y; `positions` are those of `add_cracks`."""
    row, column = int(y), int(x)
    # squared distances, and numbers k of the points: those of the 3 x 3 squares around the position
    nearest2, second2, nearest, second = math.inf, math.inf, 0, 0
    for k in range(9):
        dx, dy = positions[row + k // 3, column + k % 3, 0] - x, positions[row + k // 3, column + k % 3, 1] - y
        distance2 = dx * dx + dy * dy
        is_nearest, is_second = distance2 < nearest2, distance2 < second2
        second, second2 = (nearest, nearest2) if is_nearest else ((k, distance2) if is_second else (second, second2))
        nearest, nearest2 = (k, distance2) if is_nearest else (nearest, nearest2)
    nearest_row, nearest_column = row + nearest // 3, column + nearest % 3
    second_row, second_column = row + second // 3, column + second % 3
    nearest_x, nearest_y = positions[nearest_row, nearest_column, 0] - x, positions[nearest_row, nearest_column, 1] - y
    second_x, second_y = positions[second_row, second_column, 0] - x, positions[second_row, second_column, 1] - y
    separation = math.sqrt((second_x - nearest_x) ** 2 + (second_y - nearest_y) ** 2)
    border = 0.5 * (second2 - nearest2) / max(separation, 1e-6)
    return NearestCells(nearest_row, nearest_column, second_row, second_column, nearest_x, nearest_y, border)


@njit(cache=True)
def add_cracks(
    height: Grid,
    log_albedo: Grid,
    spacing: float,
    positions: Array,
    cell: float,
    width: float,
    depth: float,
    contrast: float,
) -> None:
    """Add polygonal cracks along the borders of Voronoi cells, with one point in each square of a periodic grid.

    - positions: of the points, in units of the squares, with a margin of one square: shape (count + 2, count + 2, 2)
    - cell: side of a square, metres
    - width, depth: half width over which a crack fades, and depth at its middle, metres
    - contrast: change of the logarithm of albedo at the middle of a crack
    """
    for i in range(height.shape[0]):
        for j in range(height.shape[0]):
            border = _find_cells(positions, j * spacing / cell, i * spacing / cell).border * cell
            if border < width:
                strength = 1.0 - border / width
                height[i, j] -= depth * strength
                log_albedo[i, j] += contrast * strength


#: Columns of a slab: height at its point, metres; slopes along x and y; logarithm of albedo; random number from 0 to 1.
#: The numbers of two slabs give the width of the joint between them.
HEIGHT, SLOPE_X, SLOPE_Y, LOG_ALBEDO, NUMBER = range(5)
#: Depth of a slab's edge below its middle, in depths of joints, and width of the fall, in cells; increase of the width
#: of joints at the boundary of the bedrock (assumed).
DOME, DOME_EDGE, LOOSENESS = 0.15, 0.25, 1.5


class Slabs(NamedTuple):
    """Slabs of one generation of joints: Voronoi cells with one point in each square of a periodic grid.

    - positions: of the points, as in `add_cracks`
    - slabs: columns `HEIGHT` to `NUMBER` of each cell; margin as that of the positions, shape (count + 2, count + 2, 5)
    - cell: side of a square, metres
    - joint, depth: mean half width of a joint, and its depth below the slabs, metres
    - rise: bound of the rise of a tilted slab from its point, metres
    """

    positions: Array
    slabs: Array
    cell: float
    joint: float
    depth: float
    rise: float


@njit(cache=True, error_model="numpy")
def _cut_slab(
    generation: Slabs, x: float, y: float, spacing: float, opening: float
) -> tuple[float, float, float, float]:
    """Compute height, logarithm of albedo and number of the slab at x, y (metres), and the fraction that is joint.

    A slab is domed: it falls towards its edge as a parabola. The joint around it has a level floor, and a half width of
    0 to 3 times the mean, narrow ones more often; narrow ones are also shallow, so that slabs of several cells are
    common. `opening` is a factor of this width. The fraction is the mean over a sample.
    """
    positions, slabs, cell, joint, depth, rise = generation
    count = positions.shape[0] - 2
    # bends of joints lead less than a period out of the grid
    x, y = x / cell, y / cell
    x += count if x < 0.0 else (-count if x >= count else 0.0)
    y += count if y < 0.0 else (-count if y >= count else 0.0)
    near = _find_cells(positions, x, y)
    own, other = slabs[near.row, near.column], slabs[near.second_row, near.second_column]
    # uniform from 0 to 1, and equal on both sides of the joint
    number = own[NUMBER] + other[NUMBER]
    number -= 1.0 if number >= 1.0 else 0.0
    half_width, border = 3.0 * number * number * joint * opening, near.border * cell
    inside = min(border + 0.5 * spacing, half_width) - max(border - 0.5 * spacing, -half_width)
    filled = max(inside / spacing, 0.0)
    from_edge = 1.0 - near.border / DOME_EDGE
    dome = DOME * depth * from_edge * from_edge if from_edge > 0.0 else 0.0
    tilt = -cell * (own[SLOPE_X] * near.offset_x + own[SLOPE_Y] * near.offset_y)
    cut = max(min(1.5 * number, 1.0) * depth * filled, dome)
    return own[HEIGHT] + min(max(tilt, -rise), rise) - cut, own[LOG_ALBEDO], own[NUMBER], filled


@njit(cache=True, error_model="numpy")
def add_slabs(
    height: Grid,
    log_albedo: Grid,
    spacing: float,
    fields: NDArray[np.float32],
    coarse: Slabs,
    fine: Slabs,
    fractured: float,
    edge: float,
) -> None:
    """Add the slabs of two generations of joints where they rise above the sand.

    Towards the boundary of the bedrock, joints are wider and more slabs are divided: the boundary is loose fragments.

    - fields: on a coarser grid of the same extent, shape (rows, rows, 4): mean height of the bedrock above the sand,
      metres; logarithm of albedo of sand between slabs; displacements of the joints along x and y, metres
    - fractured: fraction of the slabs of the coarse generation that are divided by the fine one
    - edge: height above the sand over which the albedo changes from that of sand to that of a slab, metres
    """
    rows = fields.shape[0]
    step = height.shape[0] // rows
    max_fine = 2.0 * fine.rise
    max_slab = 2.0 * coarse.rise + max_fine
    for row in range(rows):
        for column in range(rows):
            next_row, next_column = (row + 1) % rows, (column + 1) % rows
            a, b = fields[row, column], fields[row, next_column]
            c, d = fields[next_row, column], fields[next_row, next_column]
            if max(a[0], b[0], c[0], d[0]) + max_slab <= 0.0:
                continue
            for i in range(step):
                v = i / step
                for j in range(step):
                    u = j / step
                    wa, wb, wc, wd = (1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v
                    bedrock = wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0]
                    if bedrock + max_slab <= 0.0:
                        continue
                    sand = wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1]
                    x = (column * step + j) * spacing + wa * a[2] + wb * b[2] + wc * c[2] + wd * d[2]
                    y = (row * step + i) * spacing + wa * a[3] + wb * b[3] + wc * c[3] + wd * d[3]
                    loose = min(max(1.0 - 2.0 * bedrock / max_slab, 0.0), 1.0)
                    opening = 1.0 + LOOSENESS * loose
                    top, contrast, number, filled = _cut_slab(coarse, x, y, spacing, opening)
                    top += bedrock
                    exposed = 0.0
                    if number < fractured + (1.0 - fractured) * loose and filled < 1.0 and top + max_fine > 0.0:
                        fine_top, fine_contrast, _, fine_filled = _cut_slab(fine, x, y, spacing, opening)
                        top += fine_top
                        contrast += fine_contrast
                        filled = max(filled, fine_filled)
                    if top > 0.0:
                        rise = min(top / edge, 1.0)
                        exposed = rise * rise * (3.0 - 2.0 * rise) * (1.0 - filled)
                        height[row * step + i, column * step + j] += top
                    sand *= (1.0 - exposed) * min((bedrock + max_slab) / max_slab, 1.0)
                    log_albedo[row * step + i, column * step + j] += exposed * contrast + sand


@njit(cache=True)
def expose_strata(height: Grid, log_albedo: Grid, lowest: float, step: float, strata: Array) -> None:
    """Replace heights, and add to the logarithm of albedo, by linear interpolation in a table.

    Row k of `strata` contains the new height and the change of the logarithm of albedo of ground at the height
    ``lowest + k step``; the table covers all heights.
    """
    last = strata.shape[0] - 2
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            position = (height[i, j] - lowest) / step
            k = min(int(position), last)
            fraction = position - k
            height[i, j] = strata[k, 0] + fraction * (strata[k + 1, 0] - strata[k, 0])
            log_albedo[i, j] += strata[k, 1] + fraction * (strata[k + 1, 1] - strata[k, 1])
