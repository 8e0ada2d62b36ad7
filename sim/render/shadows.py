"""The fraction of the sun's disc that ground and objects leave visible at the points that rays meet."""

from dataclasses import dataclass

import drjit as dr

from marsyard.sim.render.arrays import Values, compiled, larger, where
from marsyard.sim.render.casters import Casters, are_occluded
from marsyard.sim.render.device import Array3f, Array3f64, Bool, Float, UInt32
from marsyard.sim.render.primary import Hits, Pose, Rays, locate
from marsyard.sim.render.spline import Terrain, evaluate
from marsyard.sim.render.sunlight import COARSE_GRID_MARGIN, Footprint, GroundShadow, disc_above, march_to_sun


@dataclass(frozen=True, eq=False)
class Occluders:
    """Occluders of the sun: the ground's shadow, the objects' triangles, and the region that objects may shade."""

    shadow: GroundShadow | None
    casters: Casters | None
    footprint: Footprint | None


@dataclass(frozen=True, eq=False)
class ObjectSurfaces:
    """Normals at the corners of all triangles, body of each triangle, and albedo of each body.

    `dust_albedo` is that of a body's level faces, `grain` that of `rock_surface.describe_grain`, of size 0 for
    bodies without grain.
    """

    normals: Values
    body_of_triangle: Values
    albedo: Values
    dust_albedo: Values
    grain: Values

    def normal_at(self, hits: Hits, active: Values) -> Values:
        """Interpolate the unit normals at the corners of the triangles that are hit."""
        normal, corner = Array3f(0.0), 3 * UInt32(hits.triangle)
        for k, weight in enumerate((1.0 - hits.second - hits.third, hits.second, hits.third)):
            normal += weight * dr.gather(Array3f, self.normals, corner + k, active)
        return dr.normalize(normal)


@compiled
def _shade_by_grid(
    terrain: Terrain, shadow: GroundShadow, pose: Pose, rays: Rays, hits: Hits, radius: Values
) -> tuple[Values, Values]:
    """Compute the fraction of the sun above the ground from the shadow's grid, and mark where it is too coarse.

    On the finest level the edge of a shadow needs rays to the sun.
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
    return fraction, is_finest & (dr.abs(clearance) < margin)


@compiled
def _shade_by_rays(
    terrain: Terrain,
    shadow: GroundShadow,
    pose: Pose,
    rays: Rays,
    hits: Hits,
    sun: Values,
    radius: Values,
    pixel: Values,
) -> Values:
    """Compute the fraction of the sun above the ground in some pixels by rays to the sun."""
    points = locate(rays.select(pixel), pose, hits.select(pixel))
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
    casters: Casters, objects: ObjectSurfaces, pose: Pose, rays: Rays, hits: Hits, pixel: Values
) -> Values:
    """Return whether objects hide the sun in some pixels."""
    rays, hits = rays.select(pixel), hits.select(pixel)
    points = locate(rays, pose, hits)
    normal = where(points.is_object, lambda: objects.normal_at(hits, points.is_object), Array3f(0.0, 0.0, 1.0))
    # an offset along the normal, m (objects: plus 5 % of a pixel); rounding could let a facet shade itself
    offset = 1e-4 + dr.select(points.is_object, 0.05 * Float(hits.distance) * rays.pixel_angles, 0.0)
    return are_occluded(casters, points.position + Array3f64(offset * normal), Bool(True))


def visible_sun(
    terrain: Terrain,
    pose: Pose,
    rays: Rays,
    hits: Hits,
    sun: Values,
    radius: Values,
    occluders: Occluders,
    objects: ObjectSurfaces | None,
) -> Values:
    """Compute the fraction of the sun's disc, with this angular radius, that ground and objects leave visible."""
    fraction = dr.full(Float, 1.0, dr.width(hits.distance))
    if occluders.shadow is not None:
        fraction, is_uncertain = _shade_by_grid(terrain, occluders.shadow, pose, rays, hits, radius)
        pixel = dr.compress(is_uncertain)
        if len(pixel) > 0:
            marched = _shade_by_rays(terrain, occluders.shadow, pose, rays, hits, sun, radius, pixel)
            dr.scatter(fraction, marched, pixel)
    if occluders.casters is not None and objects is not None:
        pixel = dr.compress(_mark_shaded_region(pose, rays, hits, fraction, occluders.footprint))
        if len(pixel) > 0:
            is_hidden = _shade_by_objects(occluders.casters, objects, pose, rays, hits, pixel)
            dr.scatter(fraction, Float(0.0), pixel, is_hidden)
    return fraction
