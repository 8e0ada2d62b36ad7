"""Compiled kernels of pixels that hold an edge: which they are, the rays in them, and what these meet."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.ground import Array32, Extent, cross_ground, way_in, way_out, world_ray
from marsyard.sim.render.kernels.hierarchy import Hierarchy, in_beam, nearest_hit
from marsyard.sim.render.kernels.intersection import hit_triangle
from marsyard.sim.render.kernels.sight import Ints
from marsyard.sim.terrain.kernels import Array, Level

Longs = NDArray[np.int64]
#: Difference of brightness, as a share of the brighter, from which an edge between two things matters: four times
#: the noise of a picture of SNR 100:1.
EDGE_CONTRAST = 0.04
#: Difference of brightness from which there is an edge of light: a shadow's. Texture seldom makes as much.
LIGHT_CONTRAST = 0.25
#: Jump in inverse range, as a share of it, and as a multiple of the change beside it, from which something stands
#: before something else.
JUMP, STEEPER = 0.02, 3.0
#: Where the ground is sought, as shares of the range at which a pixel beside has met it.
AHEAD, BEYOND = 0.95, 1.05
#: The same beside the sky, where range grows without bound from pixel to pixel.
TO_HORIZON = 5.0
#: Triangles that a pixel's beam may list; where there are more, every ray walks through the hierarchy by itself.
MOST_LISTED = 96
#: Half a pixel's diagonal, in pixels, and a little more, for pixels are not quite square.
BEAM_PX = 0.8


@njit(cache=True, inline="always")
def _jumps(before: float, here: float, there: float, after: float) -> bool:
    """Whether range jumps between the middle two of four distances along a line, where a plane's would not.

    A plane's inverse range is linear over the picture.
    """
    if not abs(there - here) > JUMP * max(here, there):
        return False
    q0 = 1.0 / before
    q1 = 1.0 / here
    q2 = 1.0 / there
    q3 = 1.0 / after
    step = abs(q2 - q1)
    return bool(step > STEEPER * max(abs(q1 - q0), abs(q3 - q2)))


@njit(cache=True)
def _differ(
    line: Array32,
    beside: Array32,
    far: Array,
    far_beside: Array,
    body: Ints,
    body_beside: Ints,
    differs: NDArray[np.bool_],
) -> None:
    """Whether pixels of a line differ enough for an edge from those beside them, in all that one needs; few do."""
    for j in range(beside.size):
        here, there = line[j], beside[j]
        brighter = here if here > there else there
        change = abs(there - here)
        farther = far[j] if far[j] > far_beside[j] else far_beside[j]
        jumps = abs(far_beside[j] - far[j]) > JUMP * farther
        other = (body[j] != body_beside[j]) | (change > np.float32(LIGHT_CONTRAST) * brighter) | jumps
        differs[j] = (change >= np.float32(EDGE_CONTRAST) * brighter) & other


@njit(cache=True)
def mark_edges(radiance: Array32, distance: Array, body: Ints, marked: NDArray[np.bool_]) -> None:
    """Marks the pixels to both sides of every visible edge: of a thing, of ground before ground, of a shadow.

    Parameters
    ----------
    radiance, distance, body
        A picture and its truth, shape (rows, columns).
    marked
        Output of that shape, all False before.
    """
    rows, columns = radiance.shape
    differs = np.empty(columns, dtype=np.bool_)
    for i in range(rows):
        for side in range(2):
            i2 = i + side
            if i2 >= rows:
                continue
            last = columns - 1 + side
            shift = 1 - side
            _differ(
                radiance[i],
                radiance[i2, shift:],
                distance[i],
                distance[i2, shift:],
                body[i],
                body[i2, shift:],
                differs,
            )
            for j in range(last):
                if not differs[j]:
                    continue
                j2 = j + shift
                here = radiance[i, j]
                there = radiance[i2, j2]
                edge = body[i, j] != body[i2, j2] or abs(there - here) > LIGHT_CONTRAST * max(here, there)
                if not edge:
                    i0 = max(i - side, 0)
                    j0 = max(j - 1 + side, 0)
                    i3 = min(i2 + side, rows - 1)
                    j3 = min(j2 + 1 - side, columns - 1)
                    edge = _jumps(distance[i0, j0], distance[i, j], distance[i2, j2], distance[i3, j3])
                if edge:
                    marked[i, j] = True
                    marked[i2, j2] = True


@njit(cache=True)
def split_rays(rays: Array32, rows: int, columns: int, pixels: Longs, side: int, unit: bool, out: Array32) -> None:
    """Vectors at side x side places within each of some pixels, from those at all pixels' middles.

    The places are a square grid turned so that no two share a row or a column: an edge along either is found to a
    part in side**2.

    Parameters
    ----------
    rays
        A vector for each pixel, shape (rows * columns, 3).
    rows, columns
        Size of the picture.
    pixels, side
        Numbers of the pixels, and places along each side of one.
    unit
        Whether the vectors are made unit vectors.
    out
        Output, shape (pixels * side**2, 3).
    """
    number = 0
    for pixel in pixels:
        i = pixel // columns
        j = pixel - i * columns
        left = pixel - (1 if j > 0 else 0)
        right = pixel + (1 if j < columns - 1 else 0)
        above = pixel - (columns if i > 0 else 0)
        below = pixel + (columns if i < rows - 1 else 0)
        across = 1.0 / max(right - left, 1)
        down = 1.0 / max((below - above) // columns, 1)
        for k in range(side):
            for m in range(side):
                u = (k + (m + 0.5) / side) / side - 0.5
                v = (m + (side - 1 - k + 0.5) / side) / side - 0.5
                square = 0.0
                for axis in range(3):
                    value = (
                        rays[pixel, axis]
                        + u * across * (rays[right, axis] - rays[left, axis])
                        + v * down * (rays[below, axis] - rays[above, axis])
                    )
                    out[number, axis] = value
                    square += value * value
                if unit:
                    for axis in range(3):
                        out[number, axis] /= math.sqrt(square)
                number += 1


@njit(cache=True)
def _nearest_listed(
    tree: Hierarchy,
    listed: Longs,
    count: int,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, int, float, float]:
    """As `nearest_hit`, among some triangles."""
    best = math.inf
    best_triangle = -1
    best_second = 0.0
    best_third = 0.0
    for k in range(count):
        t, second, third = hit_triangle(tree[0], listed[k], x, y, z, dx, dy, dz)
        if 0.0 < t < best and second >= 0.0 and third >= 0.0 and second + third <= 1.0:
            best = t
            best_triangle = listed[k]
            best_second = second
            best_third = third
    return best, best_triangle, best_second, best_third


# Fused multiplications round differently, but the same way every time on the same processor.
@njit(cache=True, fastmath={"contract"})
def look_closely(
    levels: tuple[Level, ...],
    ceilings: tuple[Array32, ...],
    spacing: float,
    extent: Extent,
    tree: Hierarchy,
    world_from_body: Array,
    position: Array,
    columns: int,
    pixels: Longs,
    share: int,
    origins: Array32,
    directions: Array32,
    pixel_angles: Array32,
    distance: Array,
    triangle_of_pixel: Ints,
    level_of_pixel: NDArray[np.int8],
    weights: Array32,
    near: Array,
    triangle_of_ray: Ints,
    weights_of_ray: Array32,
    level_of_ray: NDArray[np.int8],
) -> None:
    """What every ray within some pixels meets, among what these pixels and the eight around each see.

    Triangles are sought among those that a beam around the pixel may meet, and the ground where a pixel around has met
    it, on the level on which it did, so that neighbouring pixels show one ground.

    Parameters
    ----------
    levels, ceilings, spacing, extent, world_from_body, position
        As for `look`.
    tree
        Triangles that stand on the ground, and their hierarchy.
    columns
        Columns of the picture.
    pixels, share
        Numbers of the pixels, and how many rays each has.
    origins, directions, pixel_angles
        The rays in body axes, shape (pixels * share, 3), and the angle that the pixel of each takes.
    distance, triangle_of_pixel, level_of_pixel, weights
        What the picture's pixels meet, from `look`.
    near, triangle_of_ray, weights_of_ray, level_of_ray
        The same of the rays: outputs.
    """
    inverse_spacing = 1.0 / spacing
    rows = distance.size // columns
    ranges = np.empty(9)
    found = np.empty(9, dtype=np.int8)
    listed = np.empty(MOST_LISTED, dtype=np.int64)
    middle_origin = np.empty((1, 3))
    middle_direction = np.empty((1, 3))
    for k in range(pixels.size):
        pixel = pixels[k]
        row = pixel // columns
        column = pixel - row * columns
        count = 0
        sky = False
        things = False
        farthest = 0.0
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                n = i * columns + j
                if distance[n] < math.inf:
                    farthest = max(farthest, distance[n])
                if distance[n] == math.inf:
                    sky = True
                elif triangle_of_pixel[n] >= 0:
                    things = True
                else:
                    # kept in order of range
                    place = count
                    while place > 0 and ranges[place - 1] > distance[n]:
                        ranges[place] = ranges[place - 1]
                        found[place] = found[place - 1]
                        place -= 1
                    ranges[place] = distance[n]
                    found[place] = level_of_pixel[n]
                    count += 1
        in_list = -1
        if things:
            # the pixel's middle lies between its first ray and its last
            a = k * share
            b = a + share - 1
            for axis in range(3):
                middle_origin[0, axis] = 0.5 * (origins[a, axis] + origins[b, axis])
                middle_direction[0, axis] = 0.5 * (directions[a, axis] + directions[b, axis])
            x0, y0, z0, dx, dy, dz = world_ray(world_from_body, position, middle_origin, middle_direction, 0)
            in_list = in_beam(
                tree,
                x0,
                y0,
                z0,
                dx,
                dy,
                dz,
                BEAM_PX * pixel_angles[a],
                math.inf if sky else BEYOND * farthest,
                listed,
            )
        for n in range(k * share, (k + 1) * share):
            x0, y0, z0, dx, dy, dz = world_ray(world_from_body, position, origins, directions, n)
            t_thing = math.inf
            triangle = -1
            second = 0.0
            third = 0.0
            if in_list >= 0:
                t_thing, triangle, second, third = _nearest_listed(tree, listed, in_list, x0, y0, z0, dx, dy, dz)
            t = math.inf
            level = 0
            end = math.inf
            c = 0
            while c < count and t == math.inf:
                # places met on one level are one stretch; it begins where the stretch before has ended
                level = found[c]
                start = max(min(AHEAD * ranges[c], end), way_in(extent, z0, dz))
                # ground behind a thing is not looked for
                if start >= t_thing:
                    break
                while c + 1 < count and found[c + 1] == level:
                    c += 1
                end = (TO_HORIZON if sky and c + 1 == count else BEYOND) * ranges[c]
                end = min(end, way_out(extent, x0, y0, dx, dy))
                smooth = max(level, 0)
                scale = inverse_spacing / (1 << smooth)
                last = min(end, t_thing)
                t = cross_ground(levels[smooth], ceilings[smooth], scale, x0, y0, z0, dx, dy, dz, start, last)
                c += 1
            if in_list < 0 and things:
                t_thing, triangle, second, third = nearest_hit(tree, x0, y0, z0, dx, dy, dz, t)
            if t_thing < t:
                t = t_thing
            else:
                triangle = -1
            if t == math.inf and count > 0 and not sky:
                # grazes the ground without dipping below it
                t = ranges[count - 1]
            elif t == math.inf and not sky:
                # a sliver of ground that no pixel around sees
                t = distance[pixel]
                triangle = triangle_of_pixel[pixel]
                level = level_of_pixel[pixel]
                if triangle >= 0:
                    second = weights[pixel, 0]
                    third = weights[pixel, 1]
            near[n] = t
            triangle_of_ray[n] = triangle
            level_of_ray[n] = level
            if triangle >= 0:
                weights_of_ray[n, 0] = second
                weights_of_ray[n, 1] = third
