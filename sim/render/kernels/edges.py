"""Compiled kernels of pixels that hold an edge: which they are, the rays in them, and what these meet."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.ground import cross_ground, way_in, way_out
from marsyard.sim.render.kernels.hierarchy import Hierarchy, list_in_beam, nearest_hit
from marsyard.sim.render.kernels.structs import (
    Array32,
    Flags,
    Ground,
    GroundLevel,
    Hits,
    Ints,
    Longs,
    Pose,
    Ray,
    Rays,
    world_ray,
)
from marsyard.sim.render.kernels.triangles import TriangleHit, nearer_hit
from marsyard.sim.terrain.kernels import Array

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
    differs: Flags,
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
def mark_edges(radiance: Array32, distance: Array, body: Ints, marked: Flags) -> None:
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
def split_rays(rays: Array32, size: tuple[int, int], pixels: Longs, side: int, unit: bool, out: Array32) -> None:
    """Vectors at side x side places within each of some pixels, from those at all pixels' middles.

    The places are a square grid turned so that no two share a row or a column: an edge along either is found to a
    part in side**2.

    Parameters
    ----------
    rays
        A vector for each pixel, shape (rows * columns, 3).
    size
        Rows and columns of the picture.
    pixels, side
        Numbers of the pixels, and places along each side of one.
    unit
        Whether the vectors are made unit vectors.
    out
        Output, shape (pixels * side**2, 3).
    """
    rows, columns = size
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


# Fused multiplications round differently, but the same way every time on the same processor: below, "contract".


@njit(cache=True, fastmath={"contract"})
def _gather_neighbours(
    hits: Hits, pixel: int, columns: int, ranges: Array, levels: Longs
) -> tuple[int, bool, bool, float]:
    """Places where a pixel and the eight around it meet the ground, in order of range, and the level of each.

    Returns how many, whether one of the pixels sees the sky, whether one sees an object, and the greatest range.
    """
    row = pixel // columns
    column = pixel - row * columns
    count = 0
    sky = False
    objects = False
    farthest = 0.0
    for i in range(max(row - 1, 0), min(row + 2, hits.distance.size // columns)):
        for j in range(max(column - 1, 0), min(column + 2, columns)):
            n = i * columns + j
            distance = hits.distance[n]
            if distance == math.inf:
                sky = True
                continue
            farthest = max(farthest, distance)
            if hits.triangle[n] >= 0:
                objects = True
                continue
            position = count
            while position > 0 and ranges[position - 1] > distance:
                ranges[position] = ranges[position - 1]
                levels[position] = levels[position - 1]
                position -= 1
            ranges[position] = distance
            levels[position] = hits.level[n]
            count += 1
    return count, sky, objects, farthest


@njit(cache=True, fastmath={"contract"})
def _middle_ray(pose: Pose, rays: Rays, first: int, last: int, origin: Array32, direction: Array32) -> Ray:
    """The ray through a pixel's middle, which lies between its first ray and its last; room for it in body axes."""
    for axis in range(3):
        origin[0, axis] = 0.5 * (rays.origins[first, axis] + rays.origins[last, axis])
        direction[0, axis] = 0.5 * (rays.directions[first, axis] + rays.directions[last, axis])
    middle: Ray = world_ray(pose, Rays(origin, direction, rays.pixel_angles), 0)
    return middle


@njit(cache=True, fastmath={"contract"})
def trace_subpixel_rays(
    ground: Ground, pose: Pose, tree: Hierarchy, columns: int, pixels: Longs, rays: Rays, seen: Hits, hits: Hits
) -> None:
    """Trace the rays within some pixels, among what these pixels and the eight around each see.

    Triangles are sought among those that a beam around the pixel may meet, and the ground where a pixel around has met
    it, on the level on which it did, so that neighbouring pixels show one ground.

    Parameters
    ----------
    ground, pose, tree
        As for `trace_primary_rays`.
    columns, pixels
        Columns of the picture, and numbers of the pixels.
    rays
        As many of each pixel, one pixel after the other.
    seen
        What the picture's pixels meet.
    hits
        Output: what the rays meet.
    """
    fields, ceilings, _top_level, spacing, extent = ground
    share = rays.directions.shape[0] // max(pixels.size, 1)
    ranges = np.empty(9)
    levels = np.empty(9, dtype=np.int64)
    listed = np.empty(MOST_LISTED, dtype=np.int64)
    origin, direction = np.empty((1, 3), dtype=np.float32), np.empty((1, 3), dtype=np.float32)
    for k in range(pixels.size):
        pixel = pixels[k]
        count, sky, objects, farthest = _gather_neighbours(seen, pixel, columns, ranges, levels)
        in_list = -1
        first, last = k * share, (k + 1) * share
        if objects:
            middle = _middle_ray(pose, rays, first, last - 1, origin, direction)
            spread = BEAM_PX * rays.pixel_angles[first]
            in_list = list_in_beam(tree, middle, spread, math.inf if sky else BEYOND * farthest, listed)
        for n in range(first, last):
            ray = world_ray(pose, rays, n)
            hit = TriangleHit(math.inf, -1, 0.0, 0.0)
            for m in range(in_list):
                hit = nearer_hit(hit, tree[0], listed[m], ray, 0.0)
            t = math.inf
            level = 0
            end = math.inf
            c = 0
            while c < count and t == math.inf:
                # places met on one level are one stretch; it begins where the stretch before has ended
                level = levels[c]
                start = max(min(AHEAD * ranges[c], end), way_in(extent, ray))
                # ground behind an object is hidden
                if start >= hit.distance:
                    break
                while c + 1 < count and levels[c + 1] == level:
                    c += 1
                end = (TO_HORIZON if sky and c + 1 == count else BEYOND) * ranges[c]
                end = min(end, way_out(extent, ray))
                m = max(level, 0)
                ground_level = GroundLevel(fields[m], ceilings[m], 1.0 / spacing / (1 << m))
                t = cross_ground(ground_level, ray, start, min(end, hit.distance))
                c += 1
            if in_list < 0 and objects:
                hit = nearest_hit(tree, ray, t)
            if not hit.distance < t:
                hit = TriangleHit(t, -1, 0.0, 0.0)
            if hit.distance == math.inf and not sky:
                if count > 0:
                    # grazes the ground without dipping below it
                    hit = TriangleHit(ranges[count - 1], -1, 0.0, 0.0)
                else:
                    # a sliver of ground that no pixel around sees
                    level = int(seen.level[pixel])
                    triangle: Any = np.int64(seen.triangle[pixel])
                    second, third = 0.0, 0.0
                    if triangle >= 0:
                        second, third = float(seen.weights[pixel, 0]), float(seen.weights[pixel, 1])
                    hit = TriangleHit(seen.distance[pixel], triangle, second, third)
            hits.distance[n] = hit.distance
            hits.triangle[n] = hit.triangle
            hits.level[n] = level
            if hit.triangle >= 0:
                hits.weights[n, 0] = hit.second
                hits.weights[n, 1] = hit.third
