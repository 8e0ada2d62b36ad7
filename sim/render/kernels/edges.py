"""Kernels of pixels at edges: their selection, the rays in them, and the hits of these."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.ground import cross_ground, entry_distance, exit_distance
from marsyard.sim.render.kernels.hierarchy import Hierarchy, TriangleHit, list_in_beam, nearer_hit, nearest_hit
from marsyard.sim.render.kernels.structs import (
    Array32,
    Flags,
    Ground,
    GroundLevel,
    Hits,
    Ints,
    Longs,
    Pose,
    Rays,
    world_ray,
)
from marsyard.sim.terrain.kernels import Array

#: Relative difference of brightness from which an edge between two objects matters: four times the noise at SNR 100:1.
EDGE_CONTRAST = 0.04
#: Relative difference of brightness from which there is an edge of a shadow; texture seldom reaches it.
LIGHT_CONTRAST = 0.25
#: Jump in inverse range, relative, and as a multiple of the change next to it, from which one surface occludes another.
JUMP, STEEPER = 0.02, 3.0
#: Limits of the search for the ground, relative to the range of a neighbouring pixel.
AHEAD, BEYOND = 0.95, 1.05
#: The same next to the sky, where range grows without bound from pixel to pixel.
TO_HORIZON = 5.0
#: Largest number of triangles listed for a pixel's beam; with more, each ray traverses the hierarchy.
MAX_LISTED = 96
#: Half a pixel's diagonal, in pixels, and a margin, as pixels are not quite square.
BEAM_PX = 0.8


@njit(cache=True, inline="always")
def _jumps(before: float, here: float, there: float, after: float) -> bool:
    """Whether range jumps between the middle two of four distances along a line, where a plane's would not.

    A plane's inverse range is linear over the picture.
    """
    if not abs(there - here) > JUMP * max(here, there):
        return False
    q0, q1, q2, q3 = 1.0 / before, 1.0 / here, 1.0 / there, 1.0 / after
    step = abs(q2 - q1)
    return bool(step > STEEPER * max(abs(q1 - q0), abs(q3 - q2)))


@njit(cache=True)
def _differ(
    line: Array32, next_line: Array32, far: Array, next_far: Array, body: Ints, next_body: Ints, differs: Flags
) -> None:
    """Test a necessary condition of an edge between neighbouring pixels of two lines; few meet it."""
    for j in range(next_line.size):
        here, there = line[j], next_line[j]
        brighter = here if here > there else there
        change = abs(there - here)
        farther = far[j] if far[j] > next_far[j] else next_far[j]
        jumps = abs(next_far[j] - far[j]) > JUMP * farther
        other = (body[j] != next_body[j]) | (change > np.float32(LIGHT_CONTRAST) * brighter) | jumps
        differs[j] = (change >= np.float32(EDGE_CONTRAST) * brighter) & other


@njit(cache=True)
def mark_edges(radiance: Array32, distance: Array, body: Ints, marked: Flags) -> None:
    """Mark the pixels on both sides of every visible edge of an object, of ground before ground, or of a shadow.

    `marked` is the output, all False before.
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
            far, next_far = distance[i], distance[i2, shift:]
            _differ(radiance[i], radiance[i2, shift:], far, next_far, body[i], body[i2, shift:], differs)
            for j in range(last):
                if not differs[j]:
                    continue
                j2 = j + shift
                here, there = radiance[i, j], radiance[i2, j2]
                edge = body[i, j] != body[i2, j2] or abs(there - here) > LIGHT_CONTRAST * max(here, there)
                if not edge:
                    i0, j0 = max(i - side, 0), max(j - 1 + side, 0)
                    i3, j3 = min(i2 + side, rows - 1), min(j2 + 1 - side, columns - 1)
                    edge = _jumps(distance[i0, j0], distance[i, j], distance[i2, j2], distance[i3, j3])
                if edge:
                    marked[i, j], marked[i2, j2] = True, True


@njit(cache=True)
def split_rays(rays: Array32, size: tuple[int, int], pixels: Longs, side: int, unit: bool, out: Array32) -> None:
    """Interpolate vectors at side x side positions within each of some pixels, from those at all pixels' centres.

    The positions are a square grid rotated so that no two share a row or a column: an edge along either is resolved to
    1 / side**2. `size` is rows and columns; `unit` normalises the vectors; `out` is the output.
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


# "contract" allows fused multiplications: they round differently, but always the same way on one processor.


@njit(cache=True, fastmath={"contract"})
def _gather_neighbours(
    hits: Hits, pixel: int, columns: int, ranges: Array, levels: Longs
) -> tuple[int, bool, bool, float]:
    """Ranges at which a pixel and the eight around it meet the ground, in increasing order, and the level of each.

    Returns their number, whether one pixel sees the sky, whether one sees an object, and the greatest range.
    """
    row = pixel // columns
    column = pixel - row * columns
    count, sky, objects, farthest = 0, False, False, 0.0
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
def trace_subpixel_rays(
    ground: Ground, pose: Pose, tree: Hierarchy, columns: int, pixels: Longs, rays: Rays, seen: Hits, hits: Hits
) -> None:
    """Trace the rays within some pixels, among what these pixels and the eight around each see.

    Triangles are tested that a beam around the pixel may meet. The ground is searched near the ranges of the pixels
    around, on their levels, so that neighbouring pixels show one ground. `rays` has equally many of each pixel in
    order; `seen` holds the hits of all pixels, `hits` is the output.
    """
    fields, ceilings, _top_level, spacing, extent = ground
    rays_per_pixel = rays.directions.shape[0] // max(pixels.size, 1)
    ranges = np.empty(9)
    levels = np.empty(9, dtype=np.int64)
    listed = np.empty(MAX_LISTED, dtype=np.int64)
    origin, direction = np.empty((1, 3), dtype=np.float32), np.empty((1, 3), dtype=np.float32)
    for k in range(pixels.size):
        pixel = pixels[k]
        count, sky, objects, farthest = _gather_neighbours(seen, pixel, columns, ranges, levels)
        in_list = -1
        first, last = k * rays_per_pixel, (k + 1) * rays_per_pixel
        if objects:
            # the ray through the pixel's centre is the mean of its first ray and its last
            for axis in range(3):
                origin[0, axis] = 0.5 * (rays.origins[first, axis] + rays.origins[last - 1, axis])
                direction[0, axis] = 0.5 * (rays.directions[first, axis] + rays.directions[last - 1, axis])
            middle = world_ray(pose, Rays(origin, direction, rays.pixel_angles), 0)
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
                # ranges on one level form one interval; it begins where the one before has ended
                level = levels[c]
                start = max(min(AHEAD * ranges[c], end), entry_distance(extent, ray))
                # ground behind an object is hidden
                if start >= hit.distance:
                    break
                while c + 1 < count and levels[c + 1] == level:
                    c += 1
                end = (TO_HORIZON if sky and c + 1 == count else BEYOND) * ranges[c]
                end = min(end, exit_distance(extent, ray))
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
                    # a sliver of ground that no neighbouring pixel sees
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
