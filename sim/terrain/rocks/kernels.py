"""Compiled kernels of the rocks: placement without overlap, wind tails, and assembly of their triangles."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Power of a uniform number that selects the larger rock of a fragment from those sorted by size, minimum ratio of the
#: radii, and mean distance of a fragment from the larger rock's outline, in radii of that rock (assumed).
PARENT_POWER, MIN_PARENT, SPREAD = 2.5, 3.0, 0.6
FRAGMENT_TRIES = 200  #: Number of tries after which a fragment is placed like any other disc.
Array = NDArray[np.float64]
Ints = NDArray[np.int32]


class Placements(NamedTuple):
    """Rocks to assemble, one row each: number of the unit shape, position, scale, yaw (rad), and unit vector up."""

    shape: Ints
    position: Array
    scale: Array
    yaw: Array
    up: Array


class DiscGrid(NamedTuple):
    """Discs on a periodic square, with a linked list of the discs that touch each cell of a grid.

    - discs: rows (x, y, radius)
    - first_entry: first entry of each cell's list, shape (side, side), rows along y; -1 at the end of a list
    - next_entry, disc_of_entry: next entry of the list, and number of the disc, of each entry
    - period, cell: side of the square and of a cell, metres
    """

    discs: Array
    first_entry: Ints
    next_entry: Ints
    disc_of_entry: Ints
    period: float
    cell: float


@njit(cache=True, inline="always")
def _touched_cells(grid: DiscGrid, centre: float, radius: float) -> tuple[int, int]:
    """Return the first cell along one axis that a disc touches, not within the period, and the number of cells."""
    side = grid.first_entry.shape[0]
    first = int((centre - radius) / grid.cell + side)
    return first, min(int((centre + radius) / grid.cell + side) - first + 1, side)


@njit(cache=True)
def _is_free(grid: DiscGrid, x: float, y: float, radius: float) -> bool:
    """Return whether a disc overlaps no listed disc."""
    side, period = grid.first_entry.shape[0], grid.period
    first_row, rows = _touched_cells(grid, y, radius)
    first_column, columns = _touched_cells(grid, x, radius)
    for i in range(first_row, first_row + rows):
        for j in range(first_column, first_column + columns):
            entry = grid.first_entry[i % side, j % side]
            while entry >= 0:
                other = grid.discs[grid.disc_of_entry[entry]]
                dx, dy = abs(other[0] - x), abs(other[1] - y)
                dx, dy = min(dx, period - dx), min(dy, period - dy)
                min_distance = other[2] + radius
                if dx * dx + dy * dy < min_distance * min_distance:
                    return False
                entry = grid.next_entry[entry]
    return True


@njit(cache=True)
def _list_disc(grid: DiscGrid, disc: int, entries: int) -> int:
    """List a disc in the cells that it touches, after `entries` existing entries; return their new number."""
    side = grid.first_entry.shape[0]
    x, y, radius = grid.discs[disc]
    first_row, rows = _touched_cells(grid, y, radius)
    first_column, columns = _touched_cells(grid, x, radius)
    for i in range(first_row, first_row + rows):
        for j in range(first_column, first_column + columns):
            grid.disc_of_entry[entries], grid.next_entry[entries] = disc, grid.first_entry[i % side, j % side]
            grid.first_entry[i % side, j % side] = entries
            entries += 1
    return entries


@njit(cache=True)
def place_discs(
    radii: Array,
    occupied: Array,
    density: NDArray[np.float32],
    period: float,
    cell_m: float,
    max_tries: int,
    fragments: float,
    rng: np.random.Generator,
) -> Array:
    """Draw positions (x, y) of discs without overlap on a periodic square, with probability proportional to `density`.

    Discs are placed in order, the largest first, each at the first of its random positions that is free (rejection
    sampling). `occupied` has rows (x, y, radius) of existing discs; `density` covers the square, rows along y. A disc
    without a free position after `max_tries` gets NaN. `cell_m` is the approximate side of the cells of the search. The
    fraction `fragments` of the discs lies next to a larger disc that was placed before, at a distance with an
    exponential distribution, if it finds a position there in `FRAGMENT_TRIES` tries.
    """
    rows, max_density = density.shape[0], density.max()
    side = max(int(period / cell_m), 1)
    cell = period / side
    max_entries = 0
    for radius in np.concatenate((radii, occupied[:, 2])):
        max_entries += min(int(2.0 * radius / cell) + 2, side) ** 2
    grid = DiscGrid(
        np.empty((occupied.shape[0] + radii.size, 3)),
        np.full((side, side), -1, dtype=np.int32),
        np.empty(max_entries, dtype=np.int32),
        np.empty(max_entries, dtype=np.int32),
        period,
        cell,
    )
    discs, entries = occupied.shape[0], 0
    grid.discs[:discs] = occupied
    for disc in range(discs):
        grid.discs[disc, 0], grid.discs[disc, 1] = occupied[disc, 0] % period, occupied[disc, 1] % period
        entries = _list_disc(grid, disc, entries)
    positions = np.full((radii.size, 2), np.nan)
    for n in range(radii.size):
        first = occupied.shape[0]
        is_fragment = (
            fragments > 0.0
            and rng.random() < fragments
            and n > 0
            # the discs are ordered by size: the first one is the largest
            and grid.discs[first, 2] > MIN_PARENT * radii[n]
        )
        for attempt in range(max_tries):
            x, y = rng.random() * period, rng.random() * period
            i, j = int(y / period * rows) % rows, int(x / period * rows) % rows
            if is_fragment and attempt < FRAGMENT_TRIES:
                parent = first + int(rng.random() ** PARENT_POWER * n)
                if grid.discs[parent, 2] <= MIN_PARENT * radii[n]:
                    continue
                angle = 2.0 * math.pi * rng.random()
                away = radii[n] + grid.discs[parent, 2] * (1.0 - SPREAD * math.log(1.0 - rng.random()))
                x = (grid.discs[parent, 0] + away * math.cos(angle)) % period
                y = (grid.discs[parent, 1] + away * math.sin(angle)) % period
            elif rows > 1 and rng.random() * max_density > density[i, j]:
                continue
            if _is_free(grid, x, y, radii[n]):
                positions[n, 0], positions[n, 1] = x, y
                grid.discs[discs, 0], grid.discs[discs, 1], grid.discs[discs, 2] = x, y, radii[n]
                entries = _list_disc(grid, discs, entries)
                discs += 1
                break
    return positions


@njit(cache=True)
def stamp_tails(
    samples: NDArray[np.float32], spacing: float, tails: Array, downwind_x: float, downwind_y: float, log_albedo: float
) -> None:
    """Raise ridges in the lee of rocks, and dig moats on the other side.

    `samples` are heights and albedos on a periodic square, changed in place. `tails` has rows (x, y, half width,
    distance of the tip, height, depth of the moat). `log_albedo` is the natural logarithm of the albedo of a ridge
    divided by that of the ground. The ridge rises from the centre of the rock to its edge. Its width and height are
    largest there, and decrease linearly to its tip. Its cross section at the offset t is
    ``(1 - (t / half width)**2)**2``. The maximum slope is 1.54 times the height divided by the half width: the maximum
    of ``4 t (1 - t**2)`` at ``t = 1 / sqrt(3)``. A moat has the same cross section, from 0.5 to 1.8 half widths from
    the centre, and is in proportion to the cosine of the azimuth from the wind.
    """
    # the side is a power of two: `& mask` returns the index in the periodic square
    mask = samples.shape[0] - 1
    for n in range(tails.shape[0]):
        x, y, half_width, tip, height, moat = tails[n]
        margin = 1.8 * half_width
        x_end, y_end = x + tip * downwind_x, y + tip * downwind_y
        for i in range(
            math.floor((min(y, y_end) - margin) / spacing), math.ceil((max(y, y_end) + margin) / spacing) + 1
        ):
            for j in range(
                math.floor((min(x, x_end) - margin) / spacing), math.ceil((max(x, x_end) + margin) / spacing) + 1
            ):
                dx, dy = j * spacing - x, i * spacing - y
                along, across = dx * downwind_x + dy * downwind_y, dy * downwind_x - dx * downwind_y
                if along < 0.0:
                    distance = math.hypot(along, across)
                    t = (distance / half_width - 1.15) / 0.65
                    if abs(t) < 1.0:
                        samples[i & mask, j & mask, 0] += moat * (1.0 - t * t) ** 2 * along / distance
                    continue
                if along >= tip:
                    continue
                if along < half_width:
                    rise = along / half_width
                    taper, amplitude = 1.0, rise * rise * (3.0 - 2.0 * rise)
                else:
                    taper = (tip - along) / (tip - half_width)
                    amplitude = taper
                t = across / (half_width * taper)
                if abs(t) >= 1.0:
                    continue
                shape = amplitude * (1.0 - t * t) ** 2
                samples[i & mask, j & mask, 0] += height * shape
                samples[i & mask, j & mask, 1] *= math.exp(log_albedo * shape)


@njit(cache=True)
def assemble(rocks: Placements, unit_vertices: Array, unit_normals: Array) -> tuple[Array, Array]:
    """Compute vertices and normals of rocks in world axes, one rock after the other.

    Each rock's unit shape is stretched by `scale`, rotated by `yaw` about its own vertical, then from the vertical to
    `up` by the shortest rotation, and moved to `position`.
    """
    shape, position, scale, yaw, up = rocks
    vertices_per_rock = unit_vertices.shape[1]
    vertices, normals = np.empty((shape.size * vertices_per_rock, 3)), np.empty((shape.size * vertices_per_rock, 3))
    for n in range(shape.size):
        unit = shape[n]
        c, s = math.cos(yaw[n]), math.sin(yaw[n])
        ux, uy, uz = up[n, 0], up[n, 1], up[n, 2]
        # rotation from z to up about the axis z x up
        f = 1.0 / (1.0 + uz)
        r00, r01, r11 = 1.0 - ux * ux * f, -ux * uy * f, 1.0 - uy * uy * f
        sx, sy, sz = scale[n, 0], scale[n, 1], scale[n, 2]
        for v in range(vertices_per_rock):
            a = unit_vertices[unit, v, 0] * sx
            b = unit_vertices[unit, v, 1] * sy
            z = unit_vertices[unit, v, 2] * sz
            x, y = c * a - s * b, s * a + c * b
            row = n * vertices_per_rock + v
            vertices[row, 0] = position[n, 0] + r00 * x + r01 * y + ux * z
            vertices[row, 1] = position[n, 1] + r01 * x + r11 * y + uy * z
            vertices[row, 2] = position[n, 2] - ux * x - uy * y + uz * z
            # normals are stretched by the inverse of the scale
            a = unit_normals[unit, v, 0] / sx
            b = unit_normals[unit, v, 1] / sy
            z = unit_normals[unit, v, 2] / sz
            length = 1.0 / math.sqrt(a * a + b * b + z * z)
            x = (c * a - s * b) * length
            y = (s * a + c * b) * length
            z *= length
            normals[row, 0] = r00 * x + r01 * y + ux * z
            normals[row, 1] = r01 * x + r11 * y + uy * z
            normals[row, 2] = -ux * x - uy * y + uz * z
    return vertices, normals
