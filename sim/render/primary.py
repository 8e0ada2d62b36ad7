"""The first surface on the ray of each pixel: the ground, or an object's triangle.

OpenGL draws a mesh of the ground and the triangles of the objects into pinhole views. Each ray reads four neighbouring
samples of its view: the depth of the mesh gives a first guess of the distance, which is refined on the exact surface,
and the triangle numbers select the triangles that are tested.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import drjit as dr
import numpy as np
from jaxtyping import Float32
from jaxtyping import Int32 as IntArray

from marsyard.sim.render.arrays import Values, compiled, larger, smaller, to_device, where
from marsyard.sim.render.device import Array3f, Array3f64, Bool, Float, Float64, Int32, Matrix3f64, UInt32
from marsyard.sim.render.ground import MAX_CHANGE, Extent, clearance_at, first_crossing, refine, search_grazing_ray
from marsyard.sim.render.pixel_rays import PixelRays
from marsyard.sim.render.rays import Pose, Ray, Rays
from marsyard.sim.render.spline import Terrain
from marsyard.sim.render.triangles import Hierarchy, TriangleHit, intersect, is_inside, nearest_hit, no_hit

#: Minimum sine of the angle between ray and horizontal with which the length of a pixel's footprint is computed.
MIN_INCIDENCE_SINE = 0.01
#: Maximum footprint, in samples, of a ray that is traced on the finest level of the terrain.
MAX_FINE_FOOTPRINT = 8.0
#: Sine of the angle between ray and horizontal below which the ray may hit crests that the mesh does not resolve.
MAX_GRAZING_SINE = 0.4
#: Maximum ratio of the depths of four neighbouring samples between which the ground is continuous.
MAX_DEPTH_RATIO = 1.1
#: Tolerance of barycentric weights, so that no ray passes between two neighbouring triangles.
SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class Views:
    """Pinhole images rendered by OpenGL from a camera's position.

    - depth: along the optical axis, metres; all views follow each other, row by row
    - numbers: triangle index plus one, 0 for ground; None if no triangles were rendered
    - side: samples along each side of a view
    - focal: focal length of each view, samples
    - view_from_body: rotation from body axes to the axes of each view (x right, y down, z forward)
    - view_of_pixel: number of the view that contains each pixel
    """

    depth: Values
    numbers: Values | None
    side: Values
    focal: Values
    view_from_body: Values
    view_of_pixel: Values

    @classmethod
    def of(
        cls, depth: Float32[np.ndarray, "views side side"], numbers: IntArray[np.ndarray, "views _ _"], rays: PixelRays
    ) -> Views:
        """Copy the views of a camera's rays to the device."""
        return cls(
            to_device(Float, depth),
            to_device(Int32, numbers) if numbers.size else None,
            UInt32(depth.shape[1]),
            to_device(Float64, rays.focal_px),
            to_device(Float64, rays.view_from_body),
            rays.device_view_of_pixel,
        )


@dataclass(frozen=True, eq=False)
class Hits:
    """Intersections of rays with ground and objects.

    - distance: along the ray, metres; infinite for the sky
    - triangle, second, third: number of the object's triangle (-1: none), and weights of its second and third corner
    - level: terrain level of the intersection with the ground; -1 instead of 0 if the search on that level failed and
      the distance is that of the mesh that OpenGL draws
    """

    distance: Values
    triangle: Values
    second: Values
    third: Values
    level: Values

    @classmethod
    def of(cls, hit: TriangleHit, level: Values) -> Hits:
        """Return the nearest hits of rays that meet triangles, or the ground on a level."""
        return cls(hit.t, hit.number, Float(hit.second), Float(hit.third), level)

    def select(self, index: Values) -> Hits:
        """Return the hits of some rays."""
        return Hits(*(dr.gather(type(values), values, index) for values in vars(self).values()))

    def interpolate_normal(self, corner_normals: Values, active: Values) -> Values:
        """Interpolate the unit normals at the corners of the triangles that are hit.

        `corner_normals` contains three normals per triangle, in the order of the triangles.
        """
        normal, corner = Array3f(0.0), 3 * UInt32(self.triangle)
        for k, weight in enumerate((1.0 - self.second - self.third, self.second, self.third)):
            normal += weight * dr.gather(Array3f, corner_normals, corner + k, active)
        return dr.normalize(normal)


@dataclass(frozen=True, eq=False)
class _Guess:
    """What the views show around a ray.

    - t: first guess of the distance to the ground, metres; 0 if no sample shows ground
    - numbers: triangle numbers (from 1) of the four samples; None without triangles
    """

    t: Values
    numbers: list[Values] | None


def _guess(views: Views, rays: Rays, ray: Ray) -> _Guess:
    """Guess the distance of each ray from the four samples around it in its view.

    Inverse depth is interpolated, because the inverse depth of a plane is linear in the image. Where the depth is
    discontinuous, or a sample shows a triangle, the guess is that of the nearest sample of the ground.
    """
    view = views.view_of_pixel
    x, y, z = dr.gather(Matrix3f64, views.view_from_body, view) @ Array3f64(rays.directions)
    focal, centre = dr.gather(Float64, views.focal, view), 0.5 * Float64(views.side) - 0.5
    u, v, last = focal * x / z + centre, focal * y / z + centre, Int32(views.side) - 2
    column, row = (dr.maximum(dr.minimum(Int32(dr.floor(position)), last), 0) for position in (u, v))
    fraction_u, fraction_v = Float(u - Float64(column)), Float(v - Float64(row))
    first = (view * views.side + UInt32(row)) * views.side + UInt32(column)
    corners = [first + (views.side if i else 0) + j for i, j in product((0, 1), repeat=2)]
    depths = [dr.gather(Float, views.depth, corner) for corner in corners]
    numbers = None if views.numbers is None else [dr.gather(Int32, views.numbers, corner) for corner in corners]
    upper_left, upper_right, lower_left, lower_right = (1.0 / depth for depth in depths)
    above = dr.fma(fraction_u, upper_right - upper_left, upper_left)
    below = dr.fma(fraction_u, lower_right - lower_left, lower_left)
    interpolated = 1.0 / dr.fma(fraction_v, below - above, above)
    smallest = smaller(smaller(depths[0], depths[1]), smaller(depths[2], depths[3]))
    largest = larger(larger(depths[0], depths[1]), larger(depths[2], depths[3]))
    is_continuous = (smallest > 0.0) & (largest < MAX_DEPTH_RATIO * smallest)
    shows_triangle = Bool(False) if numbers is None else (numbers[0] | numbers[1] | numbers[2] | numbers[3]) != 0
    nearest, min_offset = Float(0.0), Float(dr.inf)
    for k, (i, j) in enumerate(product((0, 1), repeat=2)):
        offset = dr.abs(fraction_v - i) + dr.abs(fraction_u - j)
        is_nearer = (depths[k] > 0.0) & (offset < min_offset)
        if numbers is not None:
            is_nearer &= numbers[k] == 0
        nearest, min_offset = dr.select(is_nearer, depths[k], nearest), dr.select(is_nearer, offset, min_offset)
    return _Guess(Float64(dr.select(is_continuous & ~shows_triangle, interpolated, nearest)) / z, numbers)


def _hit_object(numbers: list[Values], tree: Hierarchy, ray: Ray, farthest: Values) -> TriangleHit:
    """Intersect rays with the triangles in the four samples around them; return the nearest hit.

    If a ray misses all of these triangles, it is near an outline, or triangles are smaller than samples. Then the
    hierarchy is searched.
    """
    shows_triangle, best = Bool(False), no_hit(dr.inf)
    for number in numbers:
        shows_triangle |= number > 0

    def test(k: Values, best: TriangleHit, is_active: Values) -> tuple[Values, TriangleHit, Values]:
        number = dr.select(k == 0, numbers[0], dr.select(k == 1, numbers[1], dr.select(k == 2, numbers[2], numbers[3])))
        is_shown = is_active & (number > 0)
        corners = (dr.gather(Array3f64, tree.corners, 3 * UInt32(number - 1) + corner, is_shown) for corner in range(3))
        t, u, v = intersect(ray, *corners)
        is_nearer = is_shown & is_inside(u, v, SLACK) & (t > 0.0) & (t < best.t)
        best = dr.select(is_nearer, TriangleHit(t, number - 1, u, v), best)
        return k + 1, best, is_active & (k < 3)

    _, best, _ = dr.while_loop((UInt32(0), best, shows_triangle), lambda k, best, is_active: is_active, test)
    is_missed = shows_triangle & (best.number < 0)
    return where(is_missed, lambda: nearest_hit(tree, ray, farthest, is_missed), best)


def _level_at(terrain: Terrain, rays: Rays, ray: Ray, t: Values) -> Values:
    """Return the terrain level for ground at a distance: coarse if a pixel covers many samples of the finest level."""
    footprint = Float(t) * rays.pixel_angles / larger(Float(-ray.direction.z), MIN_INCIDENCE_SINE)
    samples = footprint / (MAX_FINE_FOOTPRINT * Float(terrain.spacing))
    return dr.select(samples > 1.0, dr.minimum(Int32(dr.log2(samples)) + 1, terrain.top_level), 0)


def _cover_buried(terrain: Terrain, level: Values, ray: Ray, hit: TriangleHit) -> TriangleHit:
    """Replace hits of objects below the ground by those of the ground in front of them."""
    is_buried = clearance_at(terrain, level, ray, hit.t, Bool(True)).height < 0.0
    t = first_crossing(terrain, level, ray, (1.0 - MAX_CHANGE) * hit.t, hit.t, is_buried)
    return dr.select(is_buried & (t < hit.t), no_hit(t), hit)


@compiled
def trace_primary_rays(
    terrain: Terrain, extent: Extent, views: Views, pose: Pose, rays: Rays, tree: Hierarchy | None, is_grazing: bool
) -> Hits:
    """Trace the ray of every pixel from first guesses in `views` to the ground or a triangle.

    `is_grazing` states whether a ray may be almost parallel to the ground.
    """
    ray = rays.in_world(pose)
    guess = _guess(views, rays, ray)
    is_ground = guess.t > 0.0
    level = dr.select(is_ground, _level_at(terrain, rays, ray, guess.t), 0)
    t = Float64(dr.inf)
    if is_grazing:
        is_searched = is_ground & (ray.direction.z > -MAX_GRAZING_SINE)
        t = search_grazing_ray(terrain, level, extent, ray, guess.t, is_searched)
    is_refined = is_ground & (t == dr.inf)
    t = dr.select(is_refined, refine(terrain, level, ray, guess.t, MAX_CHANGE, is_refined), t)
    has_failed = is_ground & (t == dr.inf)
    hit = no_hit(dr.select(has_failed, guess.t, t))
    if tree is not None and guess.numbers is not None:
        object_hit = _hit_object(guess.numbers, tree, ray, hit.t)
        hit = dr.select((object_hit.number >= 0) & (object_hit.t < hit.t), object_hit, hit)
        # the mesh is not exact: at the foot of a body, it may be below the body where the ground is above it
        is_object, foot_level = hit.number >= 0, _level_at(terrain, rays, ray, hit.t)
        hit = where(is_object, lambda: _cover_buried(terrain, foot_level, ray, hit), hit)
        level = dr.select(is_object & (hit.number < 0), foot_level, level)
    is_on_mesh = (level == 0) & has_failed
    return Hits.of(hit, dr.select(is_on_mesh, -1, level))


@dataclass(frozen=True, eq=False)
class Points:
    """What the rays meet: positions, directions of the lines of sight, kind of surface, and footprints.

    The footprint is that on level ground, metres.
    """

    position: Values
    direction: Values
    is_ground: Values
    is_object: Values
    footprint: Values


def locate(rays: Rays, pose: Pose, hits: Hits) -> Points:
    """Compute what the rays meet; sky pixels have the position of the camera."""
    ray = rays.in_world(pose)
    is_sky, is_object = hits.distance == dr.inf, hits.triangle >= 0
    t = dr.select(is_sky, 0.0, hits.distance)
    sine = larger(Float(-ray.direction.z), MIN_INCIDENCE_SINE)
    footprint = Float(t) * rays.pixel_angles / dr.sqrt(sine)
    return Points(ray.origin + t * ray.direction, ray.direction, ~is_sky & ~is_object, is_object, footprint)
