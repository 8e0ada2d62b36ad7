"""The fractions of the sun's disc and of its aureole that ground and objects leave visible where rays meet surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float64 as FloatArray
from scipy.ndimage import binary_dilation

from marsyard.sim.render.arrays import Values, compiled, larger, to_device, where
from marsyard.sim.render.casters import Casters, are_occluded
from marsyard.sim.render.cones import Spheres
from marsyard.sim.render.device import Array3f, Array3f64, Bool, Float, Float64, Int32, UInt32
from marsyard.sim.render.ground_shadow import COARSE_GRID_MARGIN, GroundShadow, march_to_sun
from marsyard.sim.render.primary import Hits, locate
from marsyard.sim.render.rays import Pose, Rays
from marsyard.sim.render.sky import AUREOLE_RADIUS_RAD, disc_above
from marsyard.sim.render.spline import Terrain, evaluate

#: Maximum number of cells along a side of a footprint.
MAX_CELLS = 512
#: Fraction of the aureole that a body leaves visible in its shadow, where its outline is not known: the mean over the
#: shadow of a half sphere on the ground. It is 0.28 to 0.41 for suns between 20 and 75 deg (see the test).
AUREOLE_BEHIND_BODY = 0.31


@dataclass(frozen=True, eq=False)
class Footprint:
    """Region of ground that objects may shade: a grid of flags, its west and south border, and cells per metre."""

    cells: Values
    rows: Values
    columns: Values
    west: Values
    south: Values
    per_metre: Values

    @classmethod
    def of(cls, spheres: Spheres, sun: FloatArray[np.ndarray, "3"], min_height_m: float) -> Footprint | None:
        """Mark the cells where a body may hide the sun from ground with a height of at least `min_height_m`.

        The shadow of a sphere extends along the sun's azimuth from the point below its centre to the point where the
        ray past its top meets the lowest ground. Returns None without bodies or sun.
        """
        if len(spheres) == 0 or sun[2] <= 0.0:
            return None
        starts = spheres[:, :2]
        lengths = np.maximum(spheres[:, 2] + spheres[:, 3] - min_height_m, 0.0) / sun[2]
        ends = starts - lengths[:, None] * sun[:2]
        low, high = np.minimum(starts, ends).min(axis=0), np.maximum(starts, ends).max(axis=0)
        # a cell is longer than a body's radius and half a step together: the dilation by one cell covers both
        cell = float(max((high - low).max() / MAX_CELLS, 2.0 * spheres[:, 3].max(), 1e-3))
        steps = int(np.ceil(2.0 * float(np.linalg.norm(ends - starts, axis=1).max()) / cell)) + 2
        fraction = np.linspace(0.0, 1.0, steps)[:, None, None]
        positions = (starts + fraction * (ends - starts)).reshape(-1, 2)
        corner = low - 2.0 * cell
        columns, rows = (np.floor((high - corner) / cell).astype(int) + 3).tolist()
        cells = np.zeros((rows, columns), dtype=np.bool_)
        column, row = np.floor((positions - corner) / cell).astype(int).T
        cells[row, column] = True
        cells = binary_dilation(cells, np.ones((3, 3), dtype=np.bool_))
        border = map(Float64, (*corner, 1.0 / cell))
        return cls(to_device(Bool, cells), Int32(rows), Int32(columns), *border)

    def contains(self, x: Values, y: Values) -> Values:
        """Return whether an object may hide the sun from the ground at a position."""
        column, row = (Int32(dr.floor(d * self.per_metre)) for d in (x - self.west, y - self.south))
        is_inside = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        return dr.gather(Bool, self.cells, UInt32(row * self.columns + column), is_inside)


@dataclass(frozen=True, eq=False)
class Occluders:
    """Occluders of the sun: the ground's shadow, the objects' triangles, and the region that objects may shade.

    `knows_outlines`: whether the bodies that shade the ground are also `obstructions`, which hide the aureole from it.
    """

    shadow: GroundShadow | None
    casters: Casters | None
    footprint: Footprint | None
    knows_outlines: bool


@dataclass(frozen=True, eq=False)
class VisibleLight:
    """Fractions of the sun's disc, and of its aureole, that ground and objects leave visible from each point.

    The aureole behind bodies with a known outline (`obstructions`) is not yet subtracted.
    """

    sun: Values
    aureole: Values


@compiled
def _shade_by_grid(
    terrain: Terrain, shadow: GroundShadow, pose: Pose, rays: Rays, hits: Hits, radius: Values
) -> tuple[VisibleLight, Values]:
    """Compute the visible light above the ground from the shadow's grid, and mark where it is too coarse for the sun.

    On the finest level the edge of a shadow needs rays to the sun. The ground is a straight line across the aureole.
    """
    points = locate(rays, pose, hits)
    x, y, z = points.position
    is_finest = points.is_ground & (hits.level == 0)
    # a point on a smoothed level must not be shaded by bumps of the finest level
    is_smoothed = points.is_ground & (hits.level != 0)
    z = where(is_smoothed, lambda: larger(z, evaluate(terrain, shadow.level, x, y, is_smoothed).height), z)
    clearance, rows = shadow.clearance(x, y, z, points.is_ground | points.is_object)
    half_penumbra = shadow.half_penumbra(Float(radius), 0.0, rows)
    margin = COARSE_GRID_MARGIN * Float(shadow.spacing) + half_penumbra
    fraction = dr.select(clearance <= -margin, Float(0.0), 1.0)
    fraction = dr.select(is_finest, fraction, disc_above(clearance / half_penumbra))
    half_aureole = shadow.half_penumbra(Float(AUREOLE_RADIUS_RAD), 0.0, rows)
    aureole = dr.select(half_aureole > 0.0, disc_above(clearance / half_aureole), 1.0)
    return VisibleLight(fraction, aureole), is_finest & (dr.abs(clearance) < margin)


@compiled
def _shade_by_rays(
    terrain: Terrain,
    shadow: GroundShadow,
    pose: Pose,
    rays: Rays,
    hits: Hits,
    sun: Values,
    radius: Values,
    pixel_indices: Values,
) -> Values:
    """Compute the fraction of the sun above the ground in some pixels by rays to the sun."""
    points = locate(rays.select(pixel_indices), pose, hits.select(pixel_indices))
    return march_to_sun(terrain, shadow, points.position, sun, radius, Bool(True))


@compiled
def _mark_shaded_region(pose: Pose, rays: Rays, hits: Hits, fraction: Values, footprint: Footprint | None) -> Values:
    """Mark the pixels in sunlight that objects may shade."""
    points = locate(rays, pose, hits)
    if footprint is None:
        return (fraction > 0.0) & (points.is_object | points.is_ground)
    is_near = points.is_ground & footprint.contains(points.position.x, points.position.y)
    return (fraction > 0.0) & (points.is_object | is_near)


@compiled
def _shade_by_objects(
    casters: Casters, corner_normals: Values, pose: Pose, rays: Rays, hits: Hits, pixel_indices: Values
) -> tuple[Values, Values]:
    """Return whether objects hide the sun in some pixels, and whether these pixels show objects."""
    rays, hits = rays.select(pixel_indices), hits.select(pixel_indices)
    points = locate(rays, pose, hits)
    normal = where(
        points.is_object, lambda: hits.interpolate_normal(corner_normals, points.is_object), Array3f(0.0, 0.0, 1.0)
    )
    # an offset along the normal, m (objects: plus 5 % of a pixel); rounding could let a facet shade itself
    offset = 1e-4 + dr.select(points.is_object, 0.05 * Float(hits.distance) * rays.pixel_angles, 0.0)
    return are_occluded(casters, points.position + Array3f64(offset * normal), Bool(True)), points.is_object


def visible_sun(
    terrain: Terrain,
    pose: Pose,
    rays: Rays,
    hits: Hits,
    sun: Values,
    radius: Values,
    occluders: Occluders,
    corner_normals: Values | None,
) -> VisibleLight:
    """Compute the visible fractions of the sun's disc, which has this angular radius, and of its aureole.

    `corner_normals` are the normals at the corners of all triangles of objects; None without objects.
    """
    pixels = dr.width(hits.distance)
    visible = VisibleLight(dr.full(Float, 1.0, pixels), dr.full(Float, 1.0, pixels))
    if occluders.shadow is not None:
        visible, is_uncertain = _shade_by_grid(terrain, occluders.shadow, pose, rays, hits, radius)
        pixel_indices = dr.compress(is_uncertain)
        if len(pixel_indices) > 0:
            marched = _shade_by_rays(terrain, occluders.shadow, pose, rays, hits, sun, radius, pixel_indices)
            dr.scatter(visible.sun, marched, pixel_indices)
    if occluders.casters is not None and corner_normals is not None:
        pixel_indices = dr.compress(_mark_shaded_region(pose, rays, hits, visible.sun, occluders.footprint))
        if len(pixel_indices) > 0:
            is_hidden, is_object = _shade_by_objects(occluders.casters, corner_normals, pose, rays, hits, pixel_indices)
            dr.scatter(visible.sun, Float(0.0), pixel_indices, is_hidden)
            is_unknown = is_hidden & is_object if occluders.knows_outlines else is_hidden
            aureole = AUREOLE_BEHIND_BODY * dr.gather(Float, visible.aureole, pixel_indices, is_unknown)
            dr.scatter(visible.aureole, aureole, pixel_indices, is_unknown)
    return visible
