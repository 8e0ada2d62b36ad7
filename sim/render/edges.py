"""Pixels at edges: outlines of objects, occlusions by terrain, and edges of shadows."""

from __future__ import annotations

from itertools import pairwise

import drjit as dr

from marsyard.sim.render.arrays import Values, compiled, larger, where
from marsyard.sim.render.device import Bool, Float, Float64, Int32, UInt32
from marsyard.sim.render.pixel_grid import PixelGrid
from marsyard.sim.render.shading import ShadedImage

#: Minimum relative contrast of an edge: four times the noise at a signal-to-noise ratio of 100.
MIN_EDGE_CONTRAST = 0.04
#: Minimum change of the visible fraction of the sun's disc at the edge of a shadow; penumbras are wider than a pixel.
MIN_SUN_CHANGE = 0.25
#: An occlusion is a jump of the range by at least this fraction, and of the inverse range by at least this multiple of
#: the changes between the neighbouring pixels.
MIN_RANGE_JUMP, MIN_JUMP_RATIO = 0.02, 3.0


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
