"""Kernel that traces the ray of each pixel to the ground or to an object's triangle.

OpenGL draws a mesh of the ground and the triangles of the objects into pinhole views. Each ray reads four neighbouring
samples of its view: the depth of the mesh gives a first guess of the distance, which is refined on the exact surface,
and the triangle numbers select the triangles that are tested.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.ground import MAX_NEWTON_RATE, intersect_grazing_ray
from marsyard.sim.render.kernels.hierarchy import Hierarchy, TriangleHit, nearer_hit, nearest_hit
from marsyard.sim.render.kernels.strips import (
    ROW,
    STRIP,
    CellBuffers,
    Matrix,
    allocate_cells,
    fetch_levels,
    rotate,
    spline,
    unpack_matrix,
)
from marsyard.sim.render.kernels.structs import Array32, Ground, GroundLevel, Hits, Ints, Longs, Pose, Ray, Rays, Views
from marsyard.sim.terrain.kernels import Array, Level

#: Minimum sine of the angle between ray and horizontal with which the length of a pixel's footprint is computed.
MIN_INCIDENCE_SINE = 0.01
#: Maximum footprint, in samples, of a ray that is traced on the finest level of the terrain.
MAX_FINE_FOOTPRINT = 8.0
#: Sine of the angle between ray and horizontal below which the ray may hit crests that the mesh does not resolve.
MAX_GRAZING_SINE = 0.4
#: Maximum number of Newton steps, and the maximum relative change of the first guess.
MAX_STEPS, MAX_CHANGE = 8, 0.05
#: Tolerance of barycentric weights, so that no ray passes between two neighbouring triangles.
SLACK = 1e-9
#: Rows of a strip's buffer: origins and directions in world axes; positions in a view (first in samples, then as
#: fractions between four samples), and components along the view's axis; the depths at these four samples.
X0, Y0, Z0, DX, DY, DZ, U, V, FORWARD, UPPER_LEFT, UPPER_RIGHT, LOWER_LEFT, LOWER_RIGHT = (ROW * n for n in range(13))
#: First guess of the distance, and length of the pixel's footprint there. During the search for the ground: distance,
#: initial distance, positions, samples per metre, and whether the search continues.
GUESS, FOOTPRINT, DISTANCE, START, X, Y, SCALE, ACTIVE = (ROW * n for n in range(13, 21))
ROWS = 21


class _Strip(NamedTuple):
    """Buffers of a strip of rays.

    - work: rows of numbers, `ROW` apart
    - row, column: the upper left of the four samples around each ray in its view
    - any_id: bitwise OR of the triangle numbers (from 1) of these samples; 0 if no sample shows a triangle
    - level: terrain level of each ray
    - refined: indices of the rays that Newton's method refines
    """

    work: Array
    row: Longs
    column: Longs
    any_id: Ints
    level: Longs
    refined: Longs


@njit(cache=True, inline="always")
def _nearest_depth(depth: Array32, ids: Ints, any_id: int, view: int, i: int, j: int, fu: float, fv: float) -> float:
    """Depth of the nearest ground sample among the four samples around a position; 0 if there is none.

    `any_id` is 0 if none of the four samples shows a triangle.
    """
    nearest = 0.0
    min_offset = math.inf
    for di in range(2):
        for dj in range(2):
            value = depth[view, i + di, j + dj]
            offset = abs(fv - di) + abs(fu - dj)
            if value > 0.0 and offset < min_offset and (any_id == 0 or ids[view, i + di, j + dj] == 0):
                min_offset, nearest = offset, value
    return nearest


@njit(cache=True, error_model="numpy", inline="always")
def _hit_object(ids: Ints, view: int, i: int, j: int, tree: Hierarchy, ray: Ray, farthest: float) -> TriangleHit:
    """Intersect a ray with the triangles in the four samples around it; return the nearest hit.

    If the ray misses all of these triangles, it is near an outline, or triangles are smaller than samples. Then the
    hierarchy is searched for a triangle nearer than `farthest`.
    """
    best = TriangleHit(math.inf, -1, 0.0, 0.0)
    last = 0
    for k in range(4):
        identifier = ids[view, i + k // 2, j + k % 2]
        if identifier <= 0 or identifier == last:
            continue
        last = identifier
        best = nearer_hit(best, tree[0], identifier - 1, ray, SLACK)
    if last > 0 and best.triangle < 0:
        best = nearest_hit(tree, ray, farthest)
    return best


@njit(cache=True, inline="always")
def _ray(work: Array, k: int) -> Ray:
    """Return a strip's k-th ray."""
    return Ray(work[X0 + k], work[Y0 + k], work[Z0 + k], work[DX + k], work[DY + k], work[DZ + k])


# "contract" allows fused multiplications: they round differently, but always the same way on one processor.


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _rotate_rays(
    rotation: Matrix, centre: tuple[float, float, float], origins: Array32, directions: Array32, width: int, work: Array
) -> None:
    """Rotate the rays of a strip to world axes."""
    for k in range(min(width, STRIP)):
        work[DX + k], work[DY + k], work[DZ + k] = rotate(
            rotation, directions[3 * k], directions[3 * k + 1], directions[3 * k + 2]
        )
        x, y, z = rotate(rotation, origins[3 * k], origins[3 * k + 1], origins[3 * k + 2])
        work[X0 + k] = centre[0] + x
        work[Y0 + k] = centre[1] + y
        work[Z0 + k] = centre[2] + z


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _project(
    view: Matrix, focal: float, centre: float, directions: Array32, u: Array, v: Array, forward: Array
) -> None:
    """Project rays into a view: outputs are positions `u` and `v`, and components along the view's axis."""
    for k in range(min(u.size, STRIP)):
        x, y, z = rotate(view, directions[3 * k], directions[3 * k + 1], directions[3 * k + 2])
        u[k] = focal * x / z + centre
        v[k] = focal * y / z + centre
        forward[k] = z


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _interpolate_guesses(pixel_angles: Array32, width: int, work: Array) -> None:
    """Interpolate first guesses of distance, and footprints, from four samples; 0 if their depth is discontinuous.

    Inverse depth is interpolated, because the inverse depth of a plane is linear in the image.
    """
    for k in range(min(width, STRIP)):
        upper_left, upper_right = work[UPPER_LEFT + k], work[UPPER_RIGHT + k]
        lower_left, lower_right = work[LOWER_LEFT + k], work[LOWER_RIGHT + k]
        fu, fv = work[U + k], work[V + k]
        smallest = min(min(upper_left, upper_right), min(lower_left, lower_right))
        largest = max(max(upper_left, upper_right), max(lower_left, lower_right))
        above = (1.0 - fu) / upper_left + fu / upper_right
        below = (1.0 - fu) / lower_left + fu / lower_right
        depth = 1.0 / ((1.0 - fv) * above + fv * below)
        t = depth / work[FORWARD + k] if smallest > 0.0 and largest < 1.1 * smallest else 0.0
        work[GUESS + k] = t
        work[FOOTPRINT + k] = t * pixel_angles[k] / max(-work[DZ + k], MIN_INCIDENCE_SINE)


@njit(cache=True, error_model="numpy")
def _take_newton_step(buffers: CellBuffers, width: int, work: Array) -> None:
    """Take a Newton step for the active rays; `ACTIVE` becomes 0 for rays that have converged or failed."""
    for k in range(min(width, STRIP)):
        height, slope_x, slope_y, _albedo = spline(buffers[0], buffers[1], k)
        t, start, scale, dz = work[DISTANCE + k], work[START + k], work[SCALE + k], work[DZ + k]
        dx, dy = work[DX + k], work[DY + k]
        clearance = work[Z0 + k] + t * dz - height
        rate = dz - slope_x * scale * dx - slope_y * scale * dy
        step = clearance / rate
        has_failed = rate > MAX_NEWTON_RATE or abs(t - step - start) > MAX_CHANGE * start
        # after a shorter horizontal step the error is below 1e-6 of the distance: curvature is at most 1 / spacing
        is_far = step * step * (dx * dx + dy * dy) >= 2e-6 * start / scale
        is_active = work[ACTIVE + k] > 0.0
        work[DISTANCE + k] = (start if has_failed else t - step) if is_active else t
        work[ACTIVE + k] = 1.0 if is_active and is_far and not has_failed else 0.0


@njit(cache=True)
def _refine_on_ground(
    levels: tuple[Level, ...],
    inverse_spacing: float,
    level_of: Longs,
    active: Longs,
    count: int,
    width: int,
    work: Array,
    buffers: CellBuffers,
) -> None:
    """Intersect the active rays of a strip with the ground by Newton's method, starting from `DISTANCE`.

    If the method fails, the first guess remains. All rays take a step together, so that the loop vectorises. `active`
    contains the indices of the `count` active rays and is overwritten. `buffers` are those of `allocate_cells`.
    """
    for k in range(width):
        work[START + k] = work[DISTANCE + k]
        work[ACTIVE + k] = 0.0
    for m in range(count):
        work[ACTIVE + active[m]] = 1.0
        work[SCALE + active[m]] = inverse_spacing / (1 << level_of[active[m]])
    for _ in range(MAX_STEPS):
        if count == 0:
            break
        for k in range(min(width, STRIP)):
            work[X + k] = work[X0 + k] + work[DISTANCE + k] * work[DX + k]
            work[Y + k] = work[Y0 + k] + work[DISTANCE + k] * work[DY + k]
        fetch_levels(levels, inverse_spacing, level_of, active, count, work[X : X + ROW], work[Y : Y + ROW], buffers)
        _take_newton_step(buffers, width, work)
        remaining = 0
        for m in range(count):
            k = active[m]
            active[remaining] = k
            remaining += work[ACTIVE + k] > 0.0
        count = remaining


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _sample_views(views: Views, directions: Array32, first: int, width: int, strip: _Strip) -> None:
    """Project the rays of a strip into their views, and read the four samples around each ray."""
    depth, ids, view_of_pixel = views.depth, views.numbers, views.view_of_pixel
    work, row, column, any_id = strip.work, strip.row, strip.column, strip.any_id
    side = depth.shape[1]
    objects = ids.shape[1] > 0
    start = 0
    while start < width:
        # pixels of one view are contiguous
        view = view_of_pixel[first + start]
        end = start + 1
        while end < width and view_of_pixel[first + end] == view:
            end += 1
        _project(
            unpack_matrix(views.view_from_body[view]),
            views.focal[view],
            side / 2.0 - 0.5,
            directions[3 * start : 3 * end],
            work[U + start : U + end],
            work[V + start : V + end],
            work[FORWARD + start : FORWARD + end],
        )
        start = end
    for k in range(width):
        view = view_of_pixel[first + k]
        u, v = work[U + k], work[V + k]
        i = min(max(math.floor(v), 0), side - 2)
        j = min(max(math.floor(u), 0), side - 2)
        row[k], column[k] = i, j
        work[U + k], work[V + k] = u - j, v - i
        work[UPPER_LEFT + k], work[UPPER_RIGHT + k] = depth[view, i, j], depth[view, i, j + 1]
        work[LOWER_LEFT + k], work[LOWER_RIGHT + k] = depth[view, i + 1, j], depth[view, i + 1, j + 1]
        if objects:
            any_id[k] = ids[view, i, j] | ids[view, i, j + 1] | ids[view, i + 1, j] | ids[view, i + 1, j + 1]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _select_levels(
    spacing: float, top_level: int, views: Views, pixel_angles: Array32, first: int, width: int, strip: _Strip
) -> None:
    """Select the terrain level of each ray of a strip by the size of its pixel's footprint on the ground.

    `GUESS` and `DISTANCE` become the distance at which the ray hits the mesh. Where four samples gave no guess, it is
    that of the nearest ground sample; `DISTANCE` is infinite if there is none.
    """
    depth, ids, view_of_pixel = views.depth, views.numbers, views.view_of_pixel
    work, row, column, any_id, level_of = strip.work, strip.row, strip.column, strip.any_id, strip.level
    for k in range(width):
        if any_id[k] != 0 or work[GUESS + k] == 0.0:
            view = view_of_pixel[first + k]
            nearest = _nearest_depth(depth, ids, any_id[k], view, row[k], column[k], work[U + k], work[V + k])
            work[GUESS + k] = nearest / work[FORWARD + k]
            work[FOOTPRINT + k] = work[GUESS + k] * pixel_angles[k] / max(-work[DZ + k], MIN_INCIDENCE_SINE)
        level_of[k] = 0
        if work[GUESS + k] == 0.0:
            # a guess that differs from the distance: this ray is not refined
            work[GUESS + k] = -1.0
            work[DISTANCE + k] = math.inf
            continue
        # a coarser level if the pixel's footprint covers many samples
        if work[FOOTPRINT + k] > MAX_FINE_FOOTPRINT * spacing:
            level_of[k] = min(int(math.log2(work[FOOTPRINT + k] / (MAX_FINE_FOOTPRINT * spacing))) + 1, top_level)
        work[DISTANCE + k] = work[GUESS + k]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _write_hits(views: Views, tree: Hierarchy, first: int, width: int, strip: _Strip, hits: Hits) -> None:
    """Write the hits of a strip's rays: the ground, or a triangle in front of it."""
    ids, view_of_pixel = views.numbers, views.view_of_pixel
    work, row, column, any_id, level_of, _refined = strip
    distance, triangle, weights, level = hits
    for k in range(width):
        n = first + k
        t = work[DISTANCE + k]
        # a distance equal to the first guess is that of the mesh: level -1 (see `Hits`)
        on_terrain = level_of[k] == 0 and t != work[GUESS + k]
        level[n] = 0 if on_terrain else (level_of[k] if level_of[k] > 0 else -1)
        distance[n] = t
        triangle[n] = -1
        if any_id[k] != 0:
            hit = _hit_object(ids, view_of_pixel[n], row[k], column[k], tree, _ray(work, k), t)
            if hit.triangle >= 0 and hit.distance < t:
                distance[n], triangle[n] = hit.distance, hit.triangle
                weights[n, 0], weights[n, 1] = hit.second, hit.third


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def trace_primary_rays(ground: Ground, views: Views, pose: Pose, rays: Rays, tree: Hierarchy, hits: Hits) -> None:
    """Trace the ray of every pixel from first guesses in `views` to the ground or a triangle; `hits` is the output."""
    rotation = unpack_matrix(pose.rotation)
    centre = (pose.position[0], pose.position[1], pose.position[2])
    origins, directions = rays.origins.reshape(-1), rays.directions.reshape(-1)
    levels, ceilings, top_level, spacing, extent = ground
    buffers = allocate_cells()
    work, pixels = np.empty(ROWS * ROW), rays.directions.shape[0]
    index_buffers = np.empty((4, STRIP), dtype=np.int64)
    level_of, refined = index_buffers[2], index_buffers[3]
    strip = _Strip(work, index_buffers[0], index_buffers[1], np.zeros(STRIP, dtype=np.int32), level_of, refined)
    for first in range(0, pixels, STRIP):
        width = min(STRIP, pixels - first)
        vectors = slice(3 * first, 3 * (first + width))
        angles = rays.pixel_angles[first : first + width]
        _rotate_rays(rotation, centre, origins[vectors], directions[vectors], width, work)
        _sample_views(views, directions[vectors], first, width, strip)
        _interpolate_guesses(angles, width, work)
        _select_levels(spacing, top_level, views, angles, first, width, strip)
        count = 0
        for k in range(width):
            if work[DZ + k] > -MAX_GRAZING_SINE and work[DISTANCE + k] < math.inf:
                # first intersection of a grazing ray with the ground
                n = level_of[k]
                level = GroundLevel(levels[n], ceilings[n], 1.0 / spacing / (1 << n))
                work[DISTANCE + k] = intersect_grazing_ray(level, extent, _ray(work, k), work[GUESS + k])
            # Newton's method refines the rays without this intersection
            refined[count] = k
            count += work[DISTANCE + k] == work[GUESS + k]
        _refine_on_ground(levels, 1.0 / spacing, level_of, refined, count, width, work, buffers)
        _write_hits(views, tree, first, width, strip, hits)
