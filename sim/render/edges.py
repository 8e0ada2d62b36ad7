"""Pixels at edges (outlines of objects, occlusions by terrain, shadows), and several rays within each of them.

These rays are traced from the hits of the neighbouring pixels.
"""

from __future__ import annotations

from itertools import pairwise, product

import drjit as dr

from marsyard.sim.render.arrays import Values, compiled, larger, smaller, where
from marsyard.sim.render.device import Array3f, Array3f64, Bool, Float, Float64, Int32, UInt32
from marsyard.sim.render.ground import Extent, first_crossing, refine
from marsyard.sim.render.primary import Hits
from marsyard.sim.render.rays import PixelGrid, Pose, Rays
from marsyard.sim.render.shading import ShadedImage
from marsyard.sim.render.spline import Terrain
from marsyard.sim.render.triangles import Hierarchy, nearest_hit, no_hit

#: Minimum relative contrast of an edge: four times the noise at a signal-to-noise ratio of 100.
MIN_EDGE_CONTRAST = 0.04
#: Minimum change of the visible fraction of the sun's disc at the edge of a shadow; penumbras are wider than a pixel.
MIN_SUN_CHANGE = 0.25
#: An occlusion is a jump of the range by at least this fraction, and of the inverse range by at least this multiple of
#: the changes between the neighbouring pixels.
MIN_RANGE_JUMP, MIN_JUMP_RATIO = 0.02, 3.0
#: Limits of the search for the ground, relative to the range of a neighbouring pixel.
SEARCH_START, SEARCH_END = 0.95, 1.05
#: Far limit next to the sky, where range grows without bound from pixel to pixel.
HORIZON_SEARCH_END = 5.0


def _has_edge(grid: PixelGrid, image: ShadedImage, distance: Values, down: int) -> Values:
    """Return whether there is a visible edge between pixels and their neighbour below (`down` 1) or to the right (0).

    An edge is an outline of an object, the edge of a shadow, or an occlusion by terrain: a jump of the range. The
    inverse range of a plane is linear in the image, so it has no jump. Texture and pebbles have no edges: they are
    smooth over a pixel.
    """
    right = 1 - down
    neighbour, exists = grid.neighbour(down, right)
    next_radiance = dr.gather(Float, image.radiance, neighbour)
    change, brighter = dr.abs(next_radiance - image.radiance), larger(image.radiance, next_radiance)
    is_candidate = exists & (change >= MIN_EDGE_CONTRAST * brighter)

    def has_cause() -> Values:
        ranges = [
            dr.gather(Float64, distance, grid.neighbour(step * down, step * right)[0], is_candidate)
            for step in (-1, 0, 1, 2)
        ]
        steps = [dr.abs(1.0 / b - 1.0 / a) for a, b in pairwise(ranges)]
        has_jump = dr.abs(ranges[2] - ranges[1]) > MIN_RANGE_JUMP * larger(ranges[1], ranges[2])
        is_occlusion = has_jump & (steps[1] > MIN_JUMP_RATIO * larger(steps[0], steps[2]))
        bodies, suns = (
            [dr.gather(kind, layer, pixel, is_candidate) for pixel in (grid.pixel, neighbour)]
            for kind, layer in ((Int32, image.body), (Float, image.sun_fraction))
        )
        is_shadow = dr.abs(suns[1] - suns[0]) >= MIN_SUN_CHANGE
        return is_occlusion | (bodies[0] != bodies[1]) | is_shadow

    return is_candidate & where(is_candidate, has_cause, Bool(False))


@compiled
def mark_edges(image: ShadedImage, distance: Values, columns: Values, rows: Values) -> Values:
    """Mark the pixels on both sides of each visible edge."""
    grid = PixelGrid.of(dr.arange(UInt32, dr.width(distance)), columns, rows)
    to_right, to_below = (_has_edge(grid, image, distance, down) for down in (0, 1))
    dr.eval(to_right, to_below)
    (left, has_left), (above, has_above) = grid.neighbour(0, -1), grid.neighbour(-1, 0)
    from_left, from_above = dr.gather(Bool, to_right, left, has_left), dr.gather(Bool, to_below, above, has_above)
    return to_right | to_below | from_left | from_above


@compiled
def split_rays(rays: Rays, columns: Values, rows: Values, pixel: Values, ray_in_pixel: Values, side: Values) -> Rays:
    """Interpolate rays at side x side positions within pixels; `ray_in_pixel` is the number of a ray in its pixel.

    The positions are a rotated square grid: no two positions are in the same row or column, so a horizontal or vertical
    edge is resolved to 1 / side**2.
    """
    grid, k, m = PixelGrid.of(pixel, columns, rows), Float(ray_in_pixel // side), Float(ray_in_pixel % side)
    count = Float(side)
    u = (k + (m + 0.5) / count) / count - 0.5
    v = (m + (count - k - 0.5) / count) / count - 0.5

    def interpolate(vectors: Values) -> Values:
        derivatives = Float64(u) * grid.derivative(vectors, 0, 1) + Float64(v) * grid.derivative(vectors, 1, 0)
        return Array3f64(dr.gather(Array3f, vectors, pixel)) + derivatives

    # a unit vector is rounded once: near the sun an error of its length is an error of the angle
    origins = None if rays.origins is None else Array3f(interpolate(rays.origins))
    return Rays(
        Array3f(dr.normalize(interpolate(rays.directions))), origins, dr.gather(Float, rays.pixel_angles, pixel)
    )


@compiled
def trace_subpixel_rays(
    terrain: Terrain,
    extent: Extent,
    pose: Pose,
    tree: Hierarchy | None,
    columns: Values,
    rows: Values,
    pixel: Values,
    rays: Rays,
    primary: Hits,
) -> Hits:
    """Trace rays that belong to a pixel, with the hits of each pixel's 3 x 3 neighbourhood as first guesses.

    The ground is searched near the ranges of the neighbouring pixels, on their terrain levels, so that the ground is
    continuous. On smooth ground Newton's method replaces this search. `primary` are the hits of all pixels.
    """
    ray = rays.in_world(pose)
    grid = PixelGrid.of(pixel, columns, rows)
    ranges, levels = [], []
    has_sky, has_object, is_smooth, farthest = Bool(False), Bool(False), Bool(True), Float64(0.0)
    own_level, own_range = dr.gather(Int32, primary.level, pixel), dr.gather(Float64, primary.distance, pixel)
    for down, right in product((-1, 0, 1), repeat=2):
        neighbour, exists = grid.neighbour(down, right)
        distance, level = dr.gather(Float64, primary.distance, neighbour), dr.gather(Int32, primary.level, neighbour)
        is_sky, is_object = distance == dr.inf, dr.gather(Int32, primary.triangle, neighbour) >= 0
        is_ground = exists & ~is_sky & ~is_object
        ranges.append(dr.select(is_ground, distance, dr.inf))
        levels.append(level)
        has_sky |= exists & is_sky
        has_object |= exists & is_object
        farthest = dr.select(exists & ~is_sky, larger(farthest, distance), farthest)
        is_smooth &= is_ground & (level >= 0) & (level == own_level)
    nearest = ranges[0]
    for distance in ranges[1:]:
        nearest = smaller(nearest, distance)
    is_smooth &= farthest - nearest < MIN_RANGE_JUMP * farthest
    hit = no_hit(dr.inf)
    if tree is not None:
        hit = nearest_hit(tree, ray, dr.select(has_sky, dr.inf, SEARCH_END * farthest), has_object)
    smooth_t = refine(terrain, dr.maximum(own_level, 0), ray, own_range, MIN_RANGE_JUMP, is_smooth)

    def search_next(t: Values, level: Values, last: Values, end: Values, is_active: Values) -> tuple[Values, ...]:
        """Search the ground near the next ranges on one level; `last` is the last range searched, `end` its end."""
        start, level = Float64(dr.inf), Int32(level)
        for distance, its_level in zip(ranges, levels, strict=True):
            is_next = (distance > last) & (distance < start)
            start, level = dr.select(is_next, distance, start), dr.select(is_next, its_level, level)
        # successive ranges on one level form one interval
        change, stop = Float64(dr.inf), start
        for distance, its_level in zip(ranges, levels, strict=True):
            change = dr.select((distance > start) & (its_level != level), smaller(change, distance), change)
        for distance in ranges:
            stop = dr.select((distance < change) & (distance < dr.inf), larger(stop, distance), stop)
        is_last = change == dr.inf
        begin = larger(smaller(SEARCH_START * start, end), extent.entry_distance(ray))
        # ground behind an object is hidden
        is_active &= (start < dr.inf) & (begin < hit.t)
        end = dr.select(has_sky & is_last, HORIZON_SEARCH_END, SEARCH_END) * stop
        end = smaller(end, extent.exit_distance(ray))
        t = first_crossing(terrain, dr.maximum(level, 0), ray, begin, smaller(end, hit.t), is_active)
        return t, level, stop, end, is_active & (t == dr.inf) & ~is_last

    is_searched = (smooth_t == dr.inf) | ~is_smooth
    t, level, _, _, _ = dr.while_loop(
        (Float64(dr.inf), Int32(0), Float64(-1.0), Float64(dr.inf), is_searched & (nearest < dr.inf)),
        lambda t, level, last, end, is_active: is_active,
        search_next,
    )
    t, level = dr.select(is_searched, t, smooth_t), dr.select(is_searched, level, own_level)
    hit = dr.select(hit.t < t, hit, no_hit(t))
    # a ray without an intersection grazes the ground; without ground in the neighbourhood it has the pixel's hit
    is_missed = (hit.t == dr.inf) & ~has_sky
    farthest_ground = Float64(-1.0)
    for distance in ranges:
        farthest_ground = dr.select(distance < dr.inf, larger(farthest_ground, distance), farthest_ground)
    has_ground = farthest_ground >= 0.0
    hit = dr.select(is_missed & has_ground, no_hit(farthest_ground), hit)
    return dr.select(is_missed & ~has_ground, primary.select(pixel), Hits.of(hit, level))
