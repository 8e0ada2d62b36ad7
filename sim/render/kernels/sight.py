"""Compiled kernel of the picture: what each pixel's ray meets."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.ground import CLOSING, Extent, first_ground
from marsyard.sim.render.kernels.hierarchy import Hierarchy, nearest_hit
from marsyard.sim.render.kernels.intersection import hit_triangle
from marsyard.sim.render.kernels.strips import (
    ROW,
    STRIP,
    Array32,
    Longs,
    Matrix,
    Near,
    fetch_levels,
    no_cells,
    numbers,
    spline,
    times,
)
from marsyard.sim.terrain.kernels import Array, Level

Ints = NDArray[np.int32]
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
def _meet_object(
    ids: Ints,
    face: int,
    i: int,
    j: int,
    tree: Hierarchy,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    farthest: float,
) -> tuple[float, int, float, float]:
    """The nearest triangle that a ray meets among those that the four samples around it show.

    Where the samples show triangles and the ray meets none of them, it passes by an outline, or triangles are smaller
    than samples: then the hierarchy is asked for one nearer than `farthest`.
    """
    triangles = tree[0]
    best = math.inf
    best_triangle = -1
    best_second = 0.0
    best_third = 0.0
    last = 0
    for k in range(4):
        one = ids[face, i + k // 2, j + k % 2]
        if one <= 0 or one == last:
            continue
        last = one
        t, second, third = hit_triangle(triangles, one - 1, x, y, z, dx, dy, dz)
        if 0.0 < t < best and second >= -SLACK and third >= -SLACK and second + third <= 1.0 + SLACK:
            best = t
            best_triangle = one - 1
            best_second = second
            best_third = third
    if last > 0 and best_triangle < 0:
        best, best_triangle, best_second, best_third = nearest_hit(tree, x, y, z, dx, dy, dz, farthest)
    return best, best_triangle, best_second, best_third


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
    """One step of Newton's method for the rays that are followed; `GOING` tells which go on, 1 or 0."""
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def look(
    levels: tuple[Level, ...],
    ceilings: tuple[Array32, ...],
    top_level: int,
    spacing: float,
    extent: Extent,
    depth: Array32,
    ids: Ints,
    focal: Array,
    view_from_body: Array,
    face_of_pixel: NDArray[np.uint8],
    world_from_body: Array,
    position: Array,
    origins: Array32,
    directions: Array32,
    pixel_angles: Array32,
    tree: Hierarchy,
    distance: Array,
    triangle_of_pixel: Ints,
    weights: Array32,
    level_of_pixel: NDArray[np.int8],
) -> None:
    """What every pixel's ray meets.

    Parameters
    ----------
    levels, ceilings, top_level, spacing, extent
        The surface's pyramid and its ceilings (`marsyard.sim.render.pyramid`), its coarsest level, the spacing of its
        level 0, and where the ground ends.
    depth, ids, focal, view_from_body
        Pinhole views from `position`: depth along the axis, number of the triangle plus one (0 for ground; empty where
        no triangles were drawn, for none are in view), focal lengths in samples, and rotations from body axes to the
        views' (x right, y down, z forward).
    face_of_pixel
        The view that holds each pixel.
    world_from_body, position
        Rotation matrix of the body, and world position of the centre of projection.
    origins, directions
        Each pixel's ray in body axes relative to `position`, shape (n, 3), float32; directions are unit.
    pixel_angles
        Angle that each pixel takes, radians.
    tree
        Triangles that stand on the ground, and their hierarchy.
    distance, triangle_of_pixel, weights, level_of_pixel
        Outputs: distance along the ray, infinite for the sky; the triangle met, -1 for none, and the weights of its
        second and third corner there; level of the terrain on which the ground was met, -1 where it was not met and the
        mesh's own distance stands.
    """
    side = depth.shape[1]
    middle = side / 2.0 - 0.5
    inverse_spacing = 1.0 / spacing
    things = ids.shape[1] > 0
    rotation = numbers(world_from_body)
    centre = (position[0], position[1], position[2])
    flat_origins, flat_directions = origins.reshape(-1), directions.reshape(-1)
    work = np.empty(ROWS * ROW)
    near = no_cells()
    row = np.empty(STRIP, dtype=np.int64)
    column = np.empty(STRIP, dtype=np.int64)
    shown = np.zeros(STRIP, dtype=np.int32)
    smooth = np.empty(STRIP, dtype=np.int64)
    onto = np.empty(STRIP, dtype=np.int64)
    count = directions.shape[0]
    for first in range(0, count, STRIP):
        width = min(STRIP, count - first)
        last = first + width
        _aim(rotation, centre, flat_origins[3 * first : 3 * last], flat_directions[3 * first : 3 * last], width, work)
        start = first
        while start < last:
            # pixels of one view stand in a row
            face = face_of_pixel[start]
            end = start + 1
            while end < last and face_of_pixel[end] == face:
                end += 1
            here, there = start - first, end - first
            _project(
                numbers(view_from_body[face]),
                focal[face],
                middle,
                flat_directions[3 * start : 3 * end],
                work[U + here : U + there],
                work[V + here : V + there],
                work[FORWARD + here : FORWARD + there],
            )
            start = end
        for k in range(width):
            face = face_of_pixel[first + k]
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
            if things:
                shown[k] = ids[face, i, j] | ids[face, i, j + 1] | ids[face, i + 1, j] | ids[face, i + 1, j + 1]
        _guess(pixel_angles[first:last], width, work)
        left = 0
        for k in range(width):
            n = first + k
            if shown[k] != 0 or work[GUESS + k] == 0.0:
                seen = _nearest_depth(
                    depth, ids, shown[k], face_of_pixel[n], row[k], column[k], work[U + k], work[V + k]
                )
                work[GUESS + k] = seen / work[FORWARD + k]
                work[STRETCHED + k] = work[GUESS + k] * pixel_angles[n] / max(-work[DZ + k], FLATTEST)
            smooth[k] = 0
            if work[GUESS + k] == 0.0:
                work[GUESS + k] = -1.0
                work[MET + k] = math.inf
                continue
            # Far away and at a flat angle a pixel takes in many samples along its line of sight: it sees them
            # smoothed.
            if work[STRETCHED + k] > FINE_UNTIL * spacing:
                smooth[k] = min(int(math.log2(work[STRETCHED + k] / (FINE_UNTIL * spacing))) + 1, top_level)
            work[MET + k] = work[GUESS + k]
            if work[DZ + k] > -GRAZING:
                work[MET + k] = first_ground(
                    levels[smooth[k]],
                    ceilings[smooth[k]],
                    inverse_spacing / (1 << smooth[k]),
                    extent,
                    work[X0 + k],
                    work[Y0 + k],
                    work[Z0 + k],
                    work[DX + k],
                    work[DY + k],
                    work[DZ + k],
                    work[GUESS + k],
                )
            # where a flat ray dips below the ground, it is there already
            if work[MET + k] == work[GUESS + k]:
                onto[left] = k
                left += 1
        _meet_ground(levels, inverse_spacing, smooth, onto, left, width, work, near)
        for k in range(width):
            n = first + k
            t = work[MET + k]
            on_terrain = smooth[k] == 0 and t != work[GUESS + k]
            level_of_pixel[n] = 0 if on_terrain else (smooth[k] if smooth[k] > 0 else -1)
            triangle = -1
            if shown[k] != 0:
                t_thing, triangle, second, third = _meet_object(
                    ids,
                    face_of_pixel[n],
                    row[k],
                    column[k],
                    tree,
                    work[X0 + k],
                    work[Y0 + k],
                    work[Z0 + k],
                    work[DX + k],
                    work[DY + k],
                    work[DZ + k],
                    t,
                )
                if triangle >= 0 and t_thing < t:
                    t = t_thing
                    weights[n, 0] = second
                    weights[n, 1] = third
                else:
                    triangle = -1
            distance[n] = t
            triangle_of_pixel[n] = triangle
