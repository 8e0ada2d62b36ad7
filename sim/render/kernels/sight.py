"""Compiled kernel of the picture: what each pixel's ray meets."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.render.kernels.ground import Array32, Bounds, first_ground, turned, world_ray
from sim.render.kernels.hierarchy import Hierarchy, nearest_hit
from sim.render.kernels.intersection import hit_triangle
from sim.terrain.kernels import Array, Level, sample

Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
#: Sine of the flattest angle at which a pixel's footprint on the ground is still drawn out in full.
FLATTEST = 0.01
#: Samples of the terrain up to which a footprint is met by the terrain itself, not by a smoothed level of it.
FINE_UNTIL = 8.0
#: Sine of the angle below which a ray may pass over crests that the mesh does not hold.
GRAZING = 0.4
#: Rays that are followed side by side: the processor works on several at once, and what is kept of them stays near it.
STRIP = 256
#: Most steps of Newton's method, the share of the first guess that they may change it by, and the shallowest closing.
STEPS, FARTHEST, CLOSING = 8, 0.05, -1e-3
#: Slack of a triangle's edge, as a share: so that no ray slips between two triangles.
SLACK = 1e-9


@njit(cache=True, inline="always")
def _ground_depth(depth: Array32, ids: Ints, shown: int, face: int, i: int, j: int, fu: float, fv: float) -> float:
    """Depth of the ground between four samples of a depth picture; 0 where none of them shows ground.

    Where all of them show one stretch of ground its inverse depth, linear over a plane's picture, is interpolated;
    across an edge the nearest sample of the ground is taken. `shown` is 0 where none of them shows a triangle.
    """
    a = depth[face, i, j]
    b = depth[face, i, j + 1]
    c = depth[face, i + 1, j]
    d = depth[face, i + 1, j + 1]
    smallest = min(min(a, b), min(c, d))
    largest = max(max(a, b), max(c, d))
    if smallest > 0.0 and largest < 1.1 * smallest and shown == 0:
        above = (1.0 - fu) / a + fu / b
        below = (1.0 - fu) / c + fu / d
        return float(1.0 / ((1.0 - fv) * above + fv * below))
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


@njit(cache=True, error_model="numpy")
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
) -> tuple[float, int, float, float]:
    """The nearest triangle that a ray meets among those that the four samples around it show.

    Where the samples show triangles and the ray meets none of them, it passes by an outline, or triangles are smaller
    than samples: then the hierarchy is asked.
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
        best, best_triangle, best_second, best_third = nearest_hit(tree, x, y, z, dx, dy, dz, math.inf)
    return best, best_triangle, best_second, best_third


@njit(cache=True, error_model="numpy")
def _meet_ground(field: Level, scale: float, ray: Array, going: Longs, count: int, met: Array) -> None:
    """Brings some rays from a first guess onto the ground, by Newton's method; the guess stays where it fails.

    All rays take a step before any takes the next, so that the processor need not finish one before it begins another,
    nor guess which ends first.

    Parameters
    ----------
    field, scale
        A level of the surface and its samples to the metre.
    ray
        Origins and directions in world axes, shape (6, rays).
    going, count
        Numbers of the rays that are followed, and how many; overwritten.
    met
        First guesses, changed to where rays meet the ground.
    """
    start = met.copy()
    for _ in range(STEPS):
        left = 0
        for m in range(count):
            k = going[m]
            t = met[k]
            dx, dy, dz = ray[3, k], ray[4, k], ray[5, k]
            height, slope_x, slope_y, _albedo = sample(field, scale, ray[0, k] + t * dx, ray[1, k] + t * dy)
            miss = ray[2, k] + t * dz - height
            closing = dz - slope_x * dx - slope_y * dy
            step = miss / closing
            failed = closing > CLOSING or abs(t - step - start[k]) > FARTHEST * start[k]
            met[k] = start[k] if failed else t - step
            # A step that short leaves, by the surface's greatest curvature of about one over its spacing, less than
            # 1e-6 of the distance.
            going[left] = k
            left += not failed and step * step >= 2e-6 * start[k] / scale
        count = left
        if count == 0:
            break


# Fused multiplications round differently, but the same way every time on the same processor.
@njit(cache=True, error_model="numpy", fastmath={"contract"})
def look(
    levels: tuple[Level, ...],
    spacing: float,
    bounds: Bounds,
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
    levels, spacing, bounds
        The surface's pyramid, the spacing of its level 0, and where the mesh ends.
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
    middle = depth.shape[1] / 2.0 - 0.5
    side = depth.shape[1]
    inverse_spacing = 1.0 / spacing
    top_level = len(levels) - 1
    things = ids.shape[1] > 0
    ray = np.empty((6, STRIP))
    guess = np.empty(STRIP)
    met = np.empty(STRIP)
    row = np.empty(STRIP, dtype=np.int64)
    column = np.empty(STRIP, dtype=np.int64)
    shown = np.zeros(STRIP, dtype=np.int32)
    smooth = np.empty(STRIP, dtype=np.int64)
    onto = np.empty(STRIP, dtype=np.int64)
    going = np.empty(STRIP, dtype=np.int64)
    count = directions.shape[0]
    for first in range(0, count, STRIP):
        width = min(STRIP, count - first)
        left = 0
        lowest, highest = top_level, 0
        for k in range(width):
            n = first + k
            ray[0, k], ray[1, k], ray[2, k], ray[3, k], ray[4, k], ray[5, k] = world_ray(
                world_from_body, position, origins, directions, n
            )
            face = face_of_pixel[n]
            px, py, pz = turned(view_from_body[face], directions, n)
            u = focal[face] * px / pz + middle
            v = focal[face] * py / pz + middle
            i = min(max(math.floor(v), 0), side - 2)
            j = min(max(math.floor(u), 0), side - 2)
            row[k] = i
            column[k] = j
            if things:
                shown[k] = ids[face, i, j] | ids[face, i, j + 1] | ids[face, i + 1, j] | ids[face, i + 1, j + 1]
            smooth[k] = 0
            t = math.inf
            seen = _ground_depth(depth, ids, shown[k], face, i, j, u - j, v - i)
            guess[k] = -1.0
            if seen > 0.0:
                # Far away and at a flat angle a pixel takes in many samples along its line of sight: it sees them
                # smoothed.
                t = seen / pz
                stretched = t * pixel_angles[n] / max(-ray[5, k], FLATTEST)
                guess[k] = t
                if stretched > FINE_UNTIL * spacing:
                    smooth[k] = min(int(math.log2(stretched / (FINE_UNTIL * spacing))) + 1, top_level)
                lowest = min(lowest, smooth[k])
                highest = max(highest, smooth[k])
                onto[left] = k
                left += 1
            met[k] = t
        for m in range(left):
            k = onto[m]
            if ray[5, k] > -GRAZING:
                scale = inverse_spacing / (1 << smooth[k])
                met[k] = first_ground(
                    levels[smooth[k]],
                    scale,
                    bounds,
                    ray[0, k],
                    ray[1, k],
                    ray[2, k],
                    ray[3, k],
                    ray[4, k],
                    ray[5, k],
                    met[k],
                )
        for level in range(lowest, highest + 1):
            together = 0
            for m in range(left):
                going[together] = onto[m]
                together += smooth[onto[m]] == level
            _meet_ground(levels[level], inverse_spacing / (1 << level), ray, going, together, met)
        for k in range(width):
            n = first + k
            t = met[k]
            on_terrain = smooth[k] == 0 and t != guess[k]
            level_of_pixel[n] = 0 if on_terrain else (smooth[k] if smooth[k] > 0 else -1)
            triangle = -1
            if shown[k] != 0:
                t_thing, triangle, second, third = _meet_object(
                    ids,
                    face_of_pixel[n],
                    row[k],
                    column[k],
                    tree,
                    ray[0, k],
                    ray[1, k],
                    ray[2, k],
                    ray[3, k],
                    ray[4, k],
                    ray[5, k],
                )
                if triangle >= 0 and t_thing < t:
                    t = t_thing
                    weights[n, 0] = second
                    weights[n, 1] = third
                else:
                    triangle = -1
            distance[n] = t
            triangle_of_pixel[n] = triangle
