"""Kernels of adaptive antialiasing: select pixels at edges, and trace several rays within each of these pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.ground import (
    MAX_NEWTON_RATE,
    Clearance,
    clearance_at,
    entry_distance,
    exit_distance,
    intersect_ground,
)
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
    Ray,
    Rays,
    world_ray,
)
from marsyard.sim.terrain.kernels import Array

#: Minimum relative contrast of an edge between two objects: four times the noise at a signal-to-noise ratio of 100.
MIN_EDGE_CONTRAST = 0.04
#: Minimum relative contrast of a shadow edge; texture rarely has this contrast.
MIN_SHADOW_CONTRAST = 0.25
#: An occlusion is a jump of the range by at least this fraction, and of the inverse range by at least this multiple of
#: the changes between the neighbouring pixels.
MIN_RANGE_JUMP, MIN_JUMP_RATIO = 0.02, 3.0
#: Limits of the search for the ground, relative to the range of a neighbouring pixel.
SEARCH_START, SEARCH_END = 0.95, 1.05
#: Far limit next to the sky, where range grows without bound from pixel to pixel.
HORIZON_SEARCH_END = 5.0
#: Maximum number of Newton steps from a neighbouring pixel's range on smooth ground.
MAX_NEWTON_STEPS = 3
#: Maximum number of triangles listed for a pixel's beam; with more triangles, each ray traverses the hierarchy.
MAX_LISTED = 96
#: Half a pixel's diagonal, in pixels, with a margin because pixels are not exactly square.
BEAM_RADIUS_PX = 0.8


@njit(cache=True, inline="always")
def _is_range_jump(range0: float, range1: float, range2: float, range3: float) -> bool:
    """Return whether the range jumps between the second and the third of four pixels in a line.

    The inverse range of a plane is linear in the image, so it has no jump.
    """
    if not abs(range2 - range1) > MIN_RANGE_JUMP * max(range1, range2):
        return False
    q0, q1, q2, q3 = 1.0 / range0, 1.0 / range1, 1.0 / range2, 1.0 / range3
    step = abs(q2 - q1)
    return bool(step > MIN_JUMP_RATIO * max(abs(q1 - q0), abs(q3 - q2)))


@njit(cache=True)
def _find_candidates(
    line: Array32, next_line: Array32, t: Array, next_t: Array, body: Ints, next_body: Ints, is_candidate: Flags
) -> None:
    """Mark the pixels of a line that may have an edge towards their neighbour in the next line: a fast preselection.

    `line` and `next_line` are radiances, `t` and `next_t` distances, `is_candidate` is the output.
    """
    for j in range(next_line.size):
        first, second = line[j], next_line[j]
        brighter = first if first > second else second
        change = abs(second - first)
        farther = t[j] if t[j] > next_t[j] else next_t[j]
        has_jump = abs(next_t[j] - t[j]) > MIN_RANGE_JUMP * farther
        has_cause = (body[j] != next_body[j]) | (change > np.float32(MIN_SHADOW_CONTRAST) * brighter) | has_jump
        is_candidate[j] = (change >= np.float32(MIN_EDGE_CONTRAST) * brighter) & has_cause


@njit(cache=True)
def mark_edges(radiance: Array32, distance: Array, body: Ints, edge_mask: Flags) -> None:
    """Mark the pixels on both sides of each visible edge of an object, a terrain occlusion or a shadow.

    `edge_mask` is the output; all its values must be False before the call.
    """
    rows, columns = radiance.shape
    is_candidate = np.empty(columns, dtype=np.bool_)
    for i in range(rows):
        # the neighbour to the right (0) and the neighbour below (1)
        for below in range(2):
            i2 = i + below
            if i2 >= rows:
                continue
            column_count = columns - 1 + below
            shift = 1 - below
            t, next_t = distance[i], distance[i2, shift:]
            _find_candidates(radiance[i], radiance[i2, shift:], t, next_t, body[i], body[i2, shift:], is_candidate)
            for j in range(column_count):
                if not is_candidate[j]:
                    continue
                j2 = j + shift
                first, second = radiance[i, j], radiance[i2, j2]
                is_edge = body[i, j] != body[i2, j2] or abs(second - first) > MIN_SHADOW_CONTRAST * max(first, second)
                if not is_edge:
                    i0, j0 = max(i - below, 0), max(j - 1 + below, 0)
                    i3, j3 = min(i2 + below, rows - 1), min(j2 + 1 - below, columns - 1)
                    is_edge = _is_range_jump(distance[i0, j0], distance[i, j], distance[i2, j2], distance[i3, j3])
                if is_edge:
                    edge_mask[i, j], edge_mask[i2, j2] = True, True


@njit(cache=True)
def split_rays(rays: Array32, size: tuple[int, int], pixels: Longs, side: int, normalize: bool, out: Array32) -> None:
    """Interpolate vectors at side x side positions within each of these pixels, from those at all pixels' centres.

    The positions are a rotated square grid: no two positions are in the same row or column, so a horizontal or vertical
    edge is resolved to 1 / side**2. `size` is rows and columns; `normalize` makes unit vectors; `out` is the output.
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
        column_scale = 1.0 / max(right - left, 1)
        row_scale = 1.0 / max((below - above) // columns, 1)
        for k in range(side):
            for m in range(side):
                u = (k + (m + 0.5) / side) / side - 0.5
                v = (m + (side - 1 - k + 0.5) / side) / side - 0.5
                square = 0.0
                for axis in range(3):
                    value = (
                        rays[pixel, axis]
                        + u * column_scale * (rays[right, axis] - rays[left, axis])
                        + v * row_scale * (rays[below, axis] - rays[above, axis])
                    )
                    out[number, axis] = value
                    square += value * value
                if normalize:
                    for axis in range(3):
                        out[number, axis] /= math.sqrt(square)
                number += 1


# "contract" allows fused multiplications: they round differently, but always the same way on one processor.


@njit(cache=True, fastmath={"contract"})
def _gather_neighbours(
    hits: Hits, pixel: int, columns: int, ranges: Array, levels: Longs
) -> tuple[int, bool, bool, float]:
    """Sort the ground ranges of a 3 x 3 neighbourhood of pixels, with their terrain levels, in increasing order.

    `ranges` and `levels` are outputs. Returns the number of ground pixels, whether a pixel shows the sky, whether a
    pixel shows an object, and the maximum range.
    """
    row = pixel // columns
    column = pixel - row * columns
    count, has_sky, has_objects, farthest = 0, False, False, 0.0
    for i in range(max(row - 1, 0), min(row + 2, hits.distance.size // columns)):
        for j in range(max(column - 1, 0), min(column + 2, columns)):
            n = i * columns + j
            distance = hits.distance[n]
            if distance == math.inf:
                has_sky = True
                continue
            farthest = max(farthest, distance)
            if hits.triangle[n] >= 0:
                has_objects = True
                continue
            position = count
            while position > 0 and ranges[position - 1] > distance:
                ranges[position] = ranges[position - 1]
                levels[position] = levels[position - 1]
                position -= 1
            ranges[position] = distance
            levels[position] = hits.level[n]
            count += 1
    return count, has_sky, has_objects, farthest


@njit(cache=True, inline="always")
def _is_smooth_ground(ranges: Array, levels: Longs) -> bool:
    """Return whether nine sorted ranges of the ground on one terrain level have no jump."""
    is_smooth = levels[0] >= 0 and ranges[8] - ranges[0] < MIN_RANGE_JUMP * ranges[8]
    for index in range(1, 9):
        is_smooth &= levels[index] == levels[0]
    return bool(is_smooth)


@njit(cache=True, fastmath={"contract"})
def _refine_on_smooth_ground(level: GroundLevel, ray: Ray, guess: float) -> float:
    """Distance of the intersection with the ground by Newton's method; infinite if it does not converge."""
    t = guess
    for _ in range(MAX_NEWTON_STEPS):
        clearance: Clearance = clearance_at(level.field, level.per_metre, ray, t)
        if clearance.rate > MAX_NEWTON_RATE:
            break
        step = clearance.height / clearance.rate
        t -= step
        if abs(t - guess) > MIN_RANGE_JUMP * guess:
            break
        # after a shorter horizontal step the error is below 1e-6 of the distance: curvature is at most 1 / spacing
        if step * step * (ray.dx * ray.dx + ray.dy * ray.dy) < 2e-6 * guess / level.per_metre:
            return t
    return math.inf


@njit(cache=True, fastmath={"contract"})
def trace_subpixel_rays(
    ground: Ground, pose: Pose, tree: Hierarchy, columns: int, pixels: Longs, rays: Rays, primary: Hits, hits: Hits
) -> None:
    """Trace the subpixel rays of these pixels, with the hits of each pixel's 3 x 3 neighbourhood as first guesses.

    Only triangles inside a beam around the pixel are tested. The ground is searched near the ranges of the neighbouring
    pixels, on their terrain levels, so that the ground is continuous. On smooth ground without objects, Newton's method
    replaces this search. `rays` contains the same number of rays for each pixel, in order; `primary` are the hits of
    all pixels; `hits` is the output.
    """
    fields, ceilings, _top_level, spacing, extent = ground
    rays_per_pixel = rays.directions.shape[0] // max(pixels.size, 1)
    ranges = np.empty(9)
    levels = np.empty(9, dtype=np.int64)
    beam_triangles = np.empty(MAX_LISTED, dtype=np.int64)
    origin, direction = np.empty((1, 3), dtype=np.float32), np.empty((1, 3), dtype=np.float32)
    for k in range(pixels.size):
        pixel = pixels[k]
        count, has_sky, has_objects, farthest = _gather_neighbours(primary, pixel, columns, ranges, levels)
        beam_count = -1
        is_smooth = count == 9 and _is_smooth_ground(ranges, levels)
        first, last = k * rays_per_pixel, (k + 1) * rays_per_pixel
        if has_objects:
            # the ray through the pixel's centre is the mean of the first and the last subpixel ray
            for axis in range(3):
                origin[0, axis] = 0.5 * (rays.origins[first, axis] + rays.origins[last - 1, axis])
                direction[0, axis] = 0.5 * (rays.directions[first, axis] + rays.directions[last - 1, axis])
            centre_ray = world_ray(pose, Rays(origin, direction, rays.pixel_angles), 0)
            half_angle = BEAM_RADIUS_PX * rays.pixel_angles[first]
            max_range = math.inf if has_sky else SEARCH_END * farthest
            beam_count = list_in_beam(tree, centre_ray, half_angle, max_range, beam_triangles)
        for n in range(first, last):
            ray = world_ray(pose, rays, n)
            hit = TriangleHit(math.inf, -1, 0.0, 0.0)
            for m in range(beam_count):
                hit = nearer_hit(hit, tree[0], beam_triangles[m], ray, 0.0)
            t = math.inf
            level = 0
            end = math.inf
            index = 0
            if is_smooth:
                level = levels[0]
                ground_level = GroundLevel(fields[level], ceilings[level], 1.0 / spacing / (1 << level))
                t = _refine_on_smooth_ground(ground_level, ray, primary.distance[pixel])
            while index < count and t == math.inf:
                # consecutive ranges on one level form one interval, which starts at the end of the previous interval
                level = levels[index]
                start = max(min(SEARCH_START * ranges[index], end), entry_distance(extent, ray))
                # ground behind an object is hidden
                if start >= hit.distance:
                    break
                while index + 1 < count and levels[index + 1] == level:
                    index += 1
                end = (HORIZON_SEARCH_END if has_sky and index + 1 == count else SEARCH_END) * ranges[index]
                end = min(end, exit_distance(extent, ray))
                m = max(level, 0)
                ground_level = GroundLevel(fields[m], ceilings[m], 1.0 / spacing / (1 << m))
                t = intersect_ground(ground_level, ray, start, min(end, hit.distance))
                index += 1
            if beam_count < 0 and has_objects:
                hit = nearest_hit(tree, ray, t)
            if not hit.distance < t:
                hit = TriangleHit(t, -1, 0.0, 0.0)
            if hit.distance == math.inf and not has_sky:
                if count > 0:
                    # the ray grazes the ground without an intersection
                    hit = TriangleHit(ranges[count - 1], -1, 0.0, 0.0)
                else:
                    # no pixel of the neighbourhood shows ground: use the pixel's primary hit
                    level = int(primary.level[pixel])
                    triangle: Any = np.int64(primary.triangle[pixel])
                    second, third = 0.0, 0.0
                    if triangle >= 0:
                        second, third = float(primary.weights[pixel, 0]), float(primary.weights[pixel, 1])
                    hit = TriangleHit(primary.distance[pixel], triangle, second, third)
            hits.distance[n] = hit.distance
            hits.triangle[n] = hit.triangle
            hits.level[n] = level
            if hit.triangle >= 0:
                hits.weights[n, 0] = hit.second
                hits.weights[n, 1] = hit.third
