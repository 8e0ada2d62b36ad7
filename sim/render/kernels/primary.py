"""Compiled kernel of the picture: what each pixel's ray meets."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.ground import CLOSING, first_ground
from marsyard.sim.render.kernels.hierarchy import Hierarchy, nearest_hit
from marsyard.sim.render.kernels.strips import (
    ROW,
    STRIP,
    Matrix,
    Near,
    fetch_levels,
    no_cells,
    numbers,
    spline,
    times,
)
from marsyard.sim.render.kernels.structs import (
    Array32,
    Ground,
    GroundLevel,
    Hits,
    Ints,
    Longs,
    Pose,
    Ray,
    Rays,
    Views,
)
from marsyard.sim.render.kernels.triangles import TriangleHit, nearer_hit
from marsyard.sim.terrain.kernels import Array, Level

#: Sine of the flattest angle at which a pixel's footprint on the ground is still drawn out in full.
FLATTEST = 0.01
#: Samples of the terrain up to which a footprint is met by the terrain itself, not by a smoothed level of it.
FINE_UNTIL = 8.0
#: Sine of the angle below which a ray may pass over crests that the mesh does not hold.
GRAZING = 0.4
#: Most steps of Newton's method, and the share of the first guess that they may change it by.
STEPS, FARTHEST = 8, 0.05
#: Slack of a triangle's edge, as a share: so that no ray slips between two triangles.
SLACK = 1e-9
#: Rows of what is kept of a strip of rays: origins and directions in world axes; where in a view's picture they point
#: (first counted in samples, then as shares between four of them), and how far forward; the depths of these four.
X0, Y0, Z0, DX, DY, DZ, U, V, FORWARD, UPPER_LEFT, UPPER_RIGHT, LOWER_LEFT, LOWER_RIGHT = (ROW * n for n in range(13))
#: The first guess of each ray's distance, and the pixel's footprint along the line of sight there; then, while the
#: ground is sought, the distance, where the search began, places, samples to the metre, and whether it goes on.
GUESS, STRETCHED, MET, START, X, Y, SCALE, GOING = (ROW * n for n in range(13, 21))
ROWS = 21


class _Strip(NamedTuple):
    """What is kept of a strip of rays: the rows above; the upper left of the four samples around each ray's place in
    its view, and their triangles' numbers combined; the level on which it meets the ground; which rays are refined.
    """

    work: Array
    row: Longs
    column: Longs
    shown: Ints
    level: Longs
    refined: Longs


@njit(cache=True, inline="always")
def _nearest_depth(depth: Array32, ids: Ints, shown: int, face: int, i: int, j: int, fu: float, fv: float) -> float:
    """Depth of the nearest sample of ground among the four around a place between samples; 0 where there is none.

    `shown` is 0 where none of them shows a triangle.
    """
    nearest = 0.0
    least = math.inf
    for di in range(2):
        for dj in range(2):
            value = depth[face, i + di, j + dj]
            far = abs(fv - di) + abs(fu - dj)
            if value > 0.0 and far < least and (shown == 0 or ids[face, i + di, j + dj] == 0):
                least = far
                nearest = value
    return nearest


@njit(cache=True, error_model="numpy", inline="always")
def _meet_object(ids: Ints, face: int, i: int, j: int, tree: Hierarchy, ray: Ray, farthest: float) -> TriangleHit:
    """The nearest triangle that a ray meets among those that the four samples around it show.

    Where the samples show triangles and the ray meets none of them, it passes by an outline, or triangles are smaller
    than samples: then the hierarchy is searched for one nearer than `farthest`.
    """
    best = TriangleHit(math.inf, -1, 0.0, 0.0)
    last = 0
    for k in range(4):
        one = ids[face, i + k // 2, j + k % 2]
        if one <= 0 or one == last:
            continue
        last = one
        best = nearer_hit(best, tree[0], one - 1, ray, SLACK)
    if last > 0 and best.triangle < 0:
        best = nearest_hit(tree, ray, farthest)
    return best


@njit(cache=True, inline="always")
def _ray(work: Array, k: int) -> Ray:
    """A strip's k-th ray."""
    return Ray(work[X0 + k], work[Y0 + k], work[Z0 + k], work[DX + k], work[DY + k], work[DZ + k])


# Fused multiplications round differently, but the same way every time on the same processor: below, "contract".


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _aim(
    rotation: Matrix, centre: tuple[float, float, float], origins: Array32, directions: Array32, width: int, work: Array
) -> None:
    """Rays of a strip in world axes."""
    for k in range(min(width, STRIP)):
        work[DX + k], work[DY + k], work[DZ + k] = times(
            rotation, directions[3 * k], directions[3 * k + 1], directions[3 * k + 2]
        )
        x, y, z = times(rotation, origins[3 * k], origins[3 * k + 1], origins[3 * k + 2])
        work[X0 + k] = centre[0] + x
        work[Y0 + k] = centre[1] + y
        work[Z0 + k] = centre[2] + z


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _project(
    view: Matrix, focal: float, middle: float, directions: Array32, u: Array, v: Array, forward: Array
) -> None:
    """Where rays meet a view's picture, and how far they go forward."""
    for k in range(min(u.size, STRIP)):
        x, y, z = times(view, directions[3 * k], directions[3 * k + 1], directions[3 * k + 2])
        u[k] = focal * x / z + middle
        v[k] = focal * y / z + middle
        forward[k] = z


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _guess(pixel_angles: Array32, width: int, work: Array) -> None:
    """First guesses from four samples of one stretch of ground each, and footprints there; 0 where it is not one.

    Inverse depth, linear over a plane's picture, is interpolated.
    """
    for k in range(min(width, STRIP)):
        a, b, c, d = work[UPPER_LEFT + k], work[UPPER_RIGHT + k], work[LOWER_LEFT + k], work[LOWER_RIGHT + k]
        fu, fv = work[U + k], work[V + k]
        smallest = min(min(a, b), min(c, d))
        largest = max(max(a, b), max(c, d))
        above = (1.0 - fu) / a + fu / b
        below = (1.0 - fu) / c + fu / d
        seen = 1.0 / ((1.0 - fv) * above + fv * below)
        t = seen / work[FORWARD + k] if smallest > 0.0 and largest < 1.1 * smallest else 0.0
        work[GUESS + k] = t
        work[STRETCHED + k] = t * pixel_angles[k] / max(-work[DZ + k], FLATTEST)


@njit(cache=True, error_model="numpy")
def _reach_out(width: int, work: Array) -> None:
    """Where rays are at their distances."""
    for k in range(min(width, STRIP)):
        work[X + k] = work[X0 + k] + work[MET + k] * work[DX + k]
        work[Y + k] = work[Y0 + k] + work[MET + k] * work[DY + k]


@njit(cache=True, error_model="numpy")
def _step(near: Near, width: int, work: Array) -> None:
    """One step of Newton's method for the rays that are followed; `GOING` marks those that continue, 1 or 0."""
    for k in range(min(width, STRIP)):
        height, slope_x, slope_y, _albedo = spline(near[0], near[1], k)
        t, start, scale, dz = work[MET + k], work[START + k], work[SCALE + k], work[DZ + k]
        miss = work[Z0 + k] + t * dz - height
        closing = dz - slope_x * scale * work[DX + k] - slope_y * scale * work[DY + k]
        step = miss / closing
        failed = closing > CLOSING or abs(t - step - start) > FARTHEST * start
        # A step that short leaves, by the surface's greatest curvature of about one over its spacing, less than
        # 1e-6 of the distance.
        far = step * step >= 2e-6 * start / scale
        going = work[GOING + k] > 0.0
        work[MET + k] = (start if failed else t - step) if going else t
        work[GOING + k] = 1.0 if going and far and not failed else 0.0


@njit(cache=True)
def _meet_ground(
    levels: tuple[Level, ...],
    inverse_spacing: float,
    level_of: Longs,
    going: Longs,
    count: int,
    width: int,
    work: Array,
    near: Near,
) -> None:
    """Brings some rays of a strip from a first guess onto the ground by Newton's method; it stays where that fails.

    All rays take a step before any takes the next, so that the processor works on several at once.

    Parameters
    ----------
    levels, inverse_spacing
        The surface's pyramid, and samples of its level 0 to the metre.
    level_of
        The level on which each ray meets the ground.
    going, count
        Numbers of the rays that are followed, and how many; overwritten.
    width, work
        The strip, first guesses in `MET`; changed to where rays meet the ground.
    near
        Room for control values.
    """
    for k in range(width):
        work[START + k] = work[MET + k]
        work[GOING + k] = 0.0
    for m in range(count):
        work[GOING + going[m]] = 1.0
        work[SCALE + going[m]] = inverse_spacing / (1 << level_of[going[m]])
    for _ in range(STEPS):
        if count == 0:
            break
        _reach_out(width, work)
        fetch_levels(levels, inverse_spacing, level_of, going, count, work[X : X + ROW], work[Y : Y + ROW], near)
        _step(near, width, work)
        left = 0
        for m in range(count):
            k = going[m]
            going[left] = k
            left += work[GOING + k] > 0.0
        count = left


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _sample_views(views: Views, directions: Array32, first: int, width: int, strip: _Strip) -> None:
    """Where the rays of a strip meet their views, and what the four samples around there hold."""
    depth, ids, view_of_pixel = views.depth, views.numbers, views.view_of_pixel
    work, row, column, shown = strip.work, strip.row, strip.column, strip.shown
    side = depth.shape[1]
    objects = ids.shape[1] > 0
    start = 0
    while start < width:
        # pixels of one view stand in a row
        face = view_of_pixel[first + start]
        end = start + 1
        while end < width and view_of_pixel[first + end] == face:
            end += 1
        _project(
            numbers(views.view_from_body[face]),
            views.focal[face],
            side / 2.0 - 0.5,
            directions[3 * start : 3 * end],
            work[U + start : U + end],
            work[V + start : V + end],
            work[FORWARD + start : FORWARD + end],
        )
        start = end
    for k in range(width):
        face = view_of_pixel[first + k]
        u, v = work[U + k], work[V + k]
        i = min(max(math.floor(v), 0), side - 2)
        j = min(max(math.floor(u), 0), side - 2)
        row[k] = i
        column[k] = j
        work[U + k] = u - j
        work[V + k] = v - i
        work[UPPER_LEFT + k] = depth[face, i, j]
        work[UPPER_RIGHT + k] = depth[face, i, j + 1]
        work[LOWER_LEFT + k] = depth[face, i + 1, j]
        work[LOWER_RIGHT + k] = depth[face, i + 1, j + 1]
        if objects:
            shown[k] = ids[face, i, j] | ids[face, i, j + 1] | ids[face, i + 1, j] | ids[face, i + 1, j + 1]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _select_levels(
    spacing: float, top_level: int, views: Views, pixel_angles: Array32, first: int, width: int, strip: _Strip
) -> bool:
    """Distance at which each ray of a strip meets the mesh, and the level of the ground there; whether any is flat."""
    depth, ids, view_of_pixel = views.depth, views.numbers, views.view_of_pixel
    work, row, column, shown, level_of = strip.work, strip.row, strip.column, strip.shown, strip.level
    flat = False
    for k in range(width):
        if shown[k] != 0 or work[GUESS + k] == 0.0:
            face = view_of_pixel[first + k]
            seen = _nearest_depth(depth, ids, shown[k], face, row[k], column[k], work[U + k], work[V + k])
            work[GUESS + k] = seen / work[FORWARD + k]
            work[STRETCHED + k] = work[GUESS + k] * pixel_angles[k] / max(-work[DZ + k], FLATTEST)
        level_of[k] = 0
        if work[GUESS + k] == 0.0:
            work[GUESS + k] = -1.0
            work[MET + k] = math.inf
            continue
        # Far away and at a flat angle a pixel covers many samples along its line of sight: it sees them smoothed.
        if work[STRETCHED + k] > FINE_UNTIL * spacing:
            level_of[k] = min(int(math.log2(work[STRETCHED + k] / (FINE_UNTIL * spacing))) + 1, top_level)
        work[MET + k] = work[GUESS + k]
        flat |= work[DZ + k] > -GRAZING
    return flat


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _trace_flat_rays(ground: Ground, width: int, strip: _Strip) -> None:
    """Bring the flat rays of a strip to the first place where they dip below the ground."""
    levels, ceilings, _top_level, spacing, extent = ground
    work, level_of = strip.work, strip.level
    for k in range(width):
        if work[DZ + k] > -GRAZING and work[MET + k] < math.inf:
            n = level_of[k]
            level = GroundLevel(levels[n], ceilings[n], 1.0 / spacing / (1 << n))
            work[MET + k] = first_ground(level, extent, _ray(work, k), work[GUESS + k])


@njit(cache=True)
def _select_refined(width: int, strip: _Strip) -> int:
    """Select the rays to be refined: where a flat ray dips below the ground, it is there already."""
    work, refined = strip.work, strip.refined
    count = 0
    for k in range(width):
        refined[count] = k
        count += work[MET + k] == work[GUESS + k]
    return count


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _keep_hits(views: Views, tree: Hierarchy, first: int, width: int, strip: _Strip, hits: Hits) -> None:
    """Write what the rays of a strip meet: the ground, or a triangle before it."""
    ids, view_of_pixel = views.numbers, views.view_of_pixel
    work, row, column, shown, level_of, _refined = strip
    distance, triangle, weights, level = hits
    for k in range(width):
        n = first + k
        t = work[MET + k]
        on_terrain = level_of[k] == 0 and t != work[GUESS + k]
        level[n] = 0 if on_terrain else (level_of[k] if level_of[k] > 0 else -1)
        distance[n] = t
        triangle[n] = -1
        if shown[k] != 0:
            hit = _meet_object(ids, view_of_pixel[n], row[k], column[k], tree, _ray(work, k), t)
            if hit.triangle >= 0 and hit.distance < t:
                distance[n] = hit.distance
                triangle[n] = hit.triangle
                weights[n, 0] = hit.second
                weights[n, 1] = hit.third


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def trace_primary_rays(ground: Ground, views: Views, pose: Pose, rays: Rays, tree: Hierarchy, hits: Hits) -> None:
    """Trace every pixel's ray to what it meets.

    Parameters
    ----------
    ground, views
        The ground, and first guesses.
    pose, rays
        The camera, and each pixel's ray.
    tree
        Triangles that stand on the ground, and their hierarchy.
    hits
        Output.
    """
    rotation = numbers(pose.rotation)
    centre = (pose.position[0], pose.position[1], pose.position[2])
    origins, directions = rays.origins.reshape(-1), rays.directions.reshape(-1)
    levels, spacing = ground.levels, ground.spacing
    near = no_cells()
    strip = _Strip(
        np.empty(ROWS * ROW),
        np.empty(STRIP, dtype=np.int64),
        np.empty(STRIP, dtype=np.int64),
        np.zeros(STRIP, dtype=np.int32),
        np.empty(STRIP, dtype=np.int64),
        np.empty(STRIP, dtype=np.int64),
    )
    count = rays.directions.shape[0]
    for first in range(0, count, STRIP):
        width = min(STRIP, count - first)
        here = slice(3 * first, 3 * (first + width))
        angles = rays.pixel_angles[first : first + width]
        _aim(rotation, centre, origins[here], directions[here], width, strip.work)
        _sample_views(views, directions[here], first, width, strip)
        _guess(angles, width, strip.work)
        if _select_levels(spacing, ground.top_level, views, angles, first, width, strip):
            _trace_flat_rays(ground, width, strip)
        refined = _select_refined(width, strip)
        _meet_ground(levels, 1.0 / spacing, strip.level, strip.refined, refined, width, strip.work, near)
        _keep_hits(views, tree, first, width, strip, hits)
