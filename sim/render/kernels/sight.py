"""Compiled kernel of the picture: what each pixel's ray meets."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.render.kernels.ground import Array32, Bounds, first_ground, meet_ground
from sim.render.kernels.hierarchy import Hierarchy, nearest_hit
from sim.render.kernels.intersection import hit_triangle
from sim.terrain.kernels import Array, Level

Ints = NDArray[np.int32]
#: Sine of the flattest angle at which a pixel's footprint on the ground is still drawn out in full.
FLATTEST = 0.01
#: Samples of the terrain up to which a footprint is met by the terrain itself, not by a smoothed level of it.
FINE_UNTIL = 8.0
#: Sine of the angle below which a ray may pass over crests that the mesh does not hold.
GRAZING = 0.4
#: Slack of a triangle's edge, as a share: so that no ray slips between two triangles.
SLACK = 1e-9


@njit(cache=True, inline="always")
def _ground_depth(depth: Array32, ids: Ints, things: bool, face: int, u: float, v: float) -> float:
    """Depth of the ground between the samples of a depth picture; 0 where no sample around shows ground.

    Where all four samples show one stretch of ground its inverse depth, linear over a plane's picture, is interpolated;
    across an edge the nearest sample of the ground is taken.
    """
    side = depth.shape[1]
    i = min(max(math.floor(v), 0), side - 2)
    j = min(max(math.floor(u), 0), side - 2)
    fu = u - j
    fv = v - i
    a = depth[face, i, j]
    b = depth[face, i, j + 1]
    c = depth[face, i + 1, j]
    d = depth[face, i + 1, j + 1]
    smallest = min(min(a, b), min(c, d))
    largest = max(max(a, b), max(c, d))
    whole = smallest > 0.0 and largest < 1.1 * smallest
    if whole and things:
        whole = ids[face, i, j] == 0 and ids[face, i, j + 1] == 0
        whole = whole and ids[face, i + 1, j] == 0 and ids[face, i + 1, j + 1] == 0
    if whole:
        above = (1.0 - fu) / a + fu / b
        below = (1.0 - fu) / c + fu / d
        return float(1.0 / ((1.0 - fv) * above + fv * below))
    nearest = 0.0
    least = math.inf
    for di in range(2):
        for dj in range(2):
            value = depth[face, i + di, j + dj]
            far = abs(fv - di) + abs(fu - dj)
            if value > 0.0 and far < least and (not things or ids[face, i + di, j + dj] == 0):
                least = far
                nearest = value
    return nearest


@njit(cache=True)
def _meet_object(
    ids: Ints,
    face: int,
    u: float,
    v: float,
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
    side = ids.shape[1]
    i = min(max(math.floor(v), 0), side - 2)
    j = min(max(math.floor(u), 0), side - 2)
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


# Fused multiplications round differently, but the same way every time on the same processor.
@njit(cache=True, fastmath={"contract"})
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
    inverse_spacing = 1.0 / spacing
    top_level = len(levels) - 1
    things = ids.shape[1] > 0
    w = world_from_body
    for n in range(directions.shape[0]):
        bx = directions[n, 0]
        by = directions[n, 1]
        bz = directions[n, 2]
        ox = origins[n, 0]
        oy = origins[n, 1]
        oz = origins[n, 2]
        face = face_of_pixel[n]
        p = view_from_body[face]
        px = p[0, 0] * bx + p[0, 1] * by + p[0, 2] * bz
        py = p[1, 0] * bx + p[1, 1] * by + p[1, 2] * bz
        pz = p[2, 0] * bx + p[2, 1] * by + p[2, 2] * bz
        u = focal[face] * px / pz + middle
        v = focal[face] * py / pz + middle
        dx = w[0, 0] * bx + w[0, 1] * by + w[0, 2] * bz
        dy = w[1, 0] * bx + w[1, 1] * by + w[1, 2] * bz
        dz = w[2, 0] * bx + w[2, 1] * by + w[2, 2] * bz
        x0 = position[0] + w[0, 0] * ox + w[0, 1] * oy + w[0, 2] * oz
        y0 = position[1] + w[1, 0] * ox + w[1, 1] * oy + w[1, 2] * oz
        z0 = position[2] + w[2, 0] * ox + w[2, 1] * oy + w[2, 2] * oz
        t = math.inf
        smooth = 0
        met = True
        guess = _ground_depth(depth, ids, things, face, u, v)
        if guess > 0.0:
            # Far away and at a flat angle a pixel takes in many samples along its line of sight: it sees them smoothed.
            t = guess / pz
            stretched = t * pixel_angles[n] / max(-dz, FLATTEST)
            first_guess = t
            if stretched > FINE_UNTIL * spacing:
                smooth = min(int(math.log2(stretched / (FINE_UNTIL * spacing))) + 1, top_level)
            scale = inverse_spacing / (1 << smooth)
            if dz > -GRAZING:
                t = first_ground(levels[smooth], scale, bounds, x0, y0, z0, dx, dy, dz, t)
            t = meet_ground(levels[smooth], scale, x0, y0, z0, dx, dy, dz, t)
            met = smooth == 0 and t != first_guess
        triangle = -1
        second = 0.0
        third = 0.0
        if things:
            t_thing, triangle, second, third = _meet_object(ids, face, u, v, tree, x0, y0, z0, dx, dy, dz)
            if triangle >= 0 and t_thing < t:
                t = t_thing
            else:
                triangle = -1
        distance[n] = t
        triangle_of_pixel[n] = triangle
        level_of_pixel[n] = 0 if met else (smooth if smooth > 0 else -1)
        if triangle >= 0:
            weights[n, 0] = second
            weights[n, 1] = third
