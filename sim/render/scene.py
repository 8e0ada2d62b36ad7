"""A scene: ground, objects and light; the ground's shadow, and bounds of the shadows of objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.ndimage import binary_dilation
from scipy.optimize import brentq

from marsyard.sim.render.kernels.casters import Casters, list_casters
from marsyard.sim.render.kernels.ground import height_range, max_rises
from marsyard.sim.render.kernels.shading import Occluders
from marsyard.sim.render.kernels.structs import Bounds, Extent, Footprint, GroundShadow, Light, Materials, MicroRelief
from marsyard.sim.render.kernels.sun import heights_in_rows, sweep_shadow
from marsyard.sim.render.objects import Objects, spheres_in_cone
from marsyard.sim.render.photometry import CloudLayer, Photometry, Sun, Texture, no_cover
from marsyard.sim.terrain import Surface

#: Rounding of a mean of heights in single precision, metres, at a few km.
ROUNDING_M = 0.01
NO_TEXTURE = Texture()
_NO_COVER = np.ones((1, 1), dtype=np.float32)
NO_RELIEF = MicroRelief(1.0, np.empty(0), _NO_COVER, _NO_COVER, 0.0)
NO_CLOUDS = (no_cover(), np.zeros(5))
#: A cone: apex, unit vector along its axis, and half angle in radians.
Cone = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float]
#: Centre and radius of a sphere about each body, metres.
Spheres = Float64[np.ndarray, "bodies 4"]
#: Largest number of cells along a side of a footprint.
MAX_CELLS = 512
#: The footprint of objects that may shade any position.
EVERYWHERE = Footprint(np.ones((1, 1), dtype=np.bool_), 0.0, 0.0, 0.0)
#: Largest number of posts along a side of the grid on which the ground's shadow is swept.
SHADOW_SIDE = 4096
#: The shadow of ground that casts none.
NO_SHADOW = GroundShadow(
    np.full((1, 1), -np.inf, dtype=np.float32), np.zeros((1, 1), dtype=np.uint8), False, 1.0, 0, 1.0, 1.0, 0.0
)
#: Directions along a cone's rim whose hull bounds the ground in it, and the fraction by which the hull is widened.
_RIM, _MARGIN = 64, 0.01
#: Additional posts: those for interpolation, and a row or two for rounding.
_SPARE = 4


@dataclass(frozen=True)
class Scene:
    """Ground, objects and light.

    - centre_m: world x, y around which the mesh is dense: below a camera near the ground, or the site of a descent
    - relief: relief finer than the terrain's samples, which shading sees by its slopes; normals and range do not
    - ground_texture, object_texture: albedo finer than the terrain's samples
    - caster_diameter_m: diameter of a body at the camera that casts a shadow, as a lander seen against the sun
    - ground_shadows: whether the ground shades itself, with a penumbra; shadows of objects are hard
    - clouds: clouds that dim the sun as they drift
    - mesh_finest_m, mesh_reach_m, mesh_lines: spacing of the mesh at the centre, its extent to each side, and the
      number of its lines
    - among_objects: whether pictures are taken from among the objects, whose shadows may then fall nearly anywhere.
      Otherwise the region where they may fall is computed in advance, which spares all other pixels the search
      (`shadow_footprint`)
    - edge_rays: rays along each side of a pixel at an edge (`marsyard.sim.render.renderer`); 1 draws every pixel by one
    - shown_m: bounds of x, then of y, of what pictures show; None for no bounds
    """

    surface: Surface
    centre_m: tuple[float, float]
    sun: Sun
    photometry: Photometry
    objects: Objects = field(default_factory=Objects.none)
    relief: MicroRelief = NO_RELIEF
    ground_texture: Texture = NO_TEXTURE
    object_texture: Texture = NO_TEXTURE
    caster_diameter_m: float = 0.0
    ground_shadows: bool = True
    clouds: CloudLayer | None = None
    mesh_finest_m: float = 12.0
    mesh_reach_m: float = 20000.0
    mesh_lines: int = 513
    among_objects: bool = False
    edge_rays: int = 2
    shown_m: Bounds | None = None

    @cached_property
    def mesh_offsets(self) -> Float64[np.ndarray, "lines"]:
        """Offsets of the mesh's lines from the centre."""
        return graded_offsets(self.mesh_reach_m, self.mesh_finest_m, self.mesh_lines)

    def with_objects(self, objects: Objects) -> Scene:
        """Replace the objects; keep the results computed for the ground."""
        return self._keep_results(
            replace(self, objects=objects), "mesh_offsets", "height_range_m", "max_slopes", "shadow"
        )

    def in_light(self, sun: Sun, photometry: Photometry) -> Scene:
        """Replace the light."""
        other = self._keep_results(replace(self, sun=sun, photometry=photometry), "mesh_offsets", "height_range_m")
        # the other sun may have bounds although this one has none
        return self._keep_results(other, "max_slopes") if np.all(np.isfinite(self.max_slopes)) else other

    def _keep_results(self, other: Scene, *names: str) -> Scene:
        """Copy cached results of this scene that hold for another."""
        other.__dict__.update({name: getattr(self, name) for name in names})
        return other

    def within(self, cones: Sequence[Cone]) -> Scene:
        """Restrict objects, and the ground's shadow, to those that pictures within these cones may show."""
        sun, lowest = np.asarray(self.sun.direction, dtype=np.float64), self.height_range_m[0]
        kept = np.zeros(len(self.objects), dtype=np.bool_)
        for cone in cones:
            kept |= potentially_visible(self.objects.spheres, sun, lowest, cone)
        less = replace(self, objects=self.objects.only(kept), shown_m=ground_in_cones(cones, lowest))
        return self._keep_results(less, "mesh_offsets", "height_range_m", "max_slopes")

    @property
    def extent_m(self) -> Extent:
        """Bounds of the mesh in x, then in y, and of the surface's height."""
        (x, y), reach = self.centre_m, self.mesh_reach_m
        # coarser levels are means of finer ones: none is higher, except for rounding
        return x - reach, x + reach, y - reach, y + reach, self.height_range_m[1] + ROUNDING_M

    @cached_property
    def height_range_m(self) -> tuple[float, float]:
        """Bounds of the ground's height."""
        low, high = height_range(self.surface.levels[0])
        return float(low), float(high)

    @cached_property
    def max_slopes(self) -> tuple[float, float]:
        """Bounds of the ground's slope along x and y; infinite where it may rise as steeply as the sun's rays."""
        return slope_bounds(self.surface, self.sun)

    @cached_property
    def shadow(self) -> GroundShadow:
        """The ground's shadow."""
        if not self.ground_shadows or self.sun.direction[2] <= 0.0 or sun_over_slopes(self.sun, self.max_slopes):
            return NO_SHADOW
        return ground_shadow(self.surface, self.sun, self.height_range_m, self.shown_m)

    @cached_property
    def footprint(self) -> Footprint:
        """Region where objects may shade the ground."""
        if self.among_objects:
            return EVERYWHERE
        towards = np.asarray(self.sun.direction, dtype=np.float64)
        return shadow_footprint(self.objects.spheres, towards, self.height_range_m[0])

    @cached_property
    def occluders(self) -> Occluders:
        """Occluders of the sun, for kernels."""
        return Occluders(self.shadow, casters_towards(self.objects, self.sun), self.footprint)

    @cached_property
    def materials(self) -> Materials:
        """Textures, normals and albedo, for kernels."""
        objects = self.objects
        textures = self.ground_texture.arrays(), self.object_texture.arrays()
        return Materials(self.relief, *textures, objects.normals, objects.body_of_triangle, objects.albedo)

    def light(self, time_s: float) -> Light:
        """The light at a time, for kernels."""
        photometry, drifting = self.photometry, NO_CLOUDS
        if self.clouds is not None:
            more = self.clouds.parameters.sky_light(self.sun)
            photometry = replace(photometry, sky_share=photometry.sky_share + more)
            drifting = (self.clouds.cover, self.clouds.coefficients(self.sun, time_s))
        # clouds are not drawn: they do not change the sky's own brightness
        sky = self.photometry.sky_coefficients(self.sun)
        towards = np.asarray(self.sun.direction, dtype=np.float64)
        return Light(towards, photometry.law(self.sun, self.caster_diameter_m), sky, *drifting)


def graded_offsets(reach_m: float, finest_m: float, count: int) -> Float[np.ndarray, "count"]:
    """Increasing offsets ``a sinh(b i)`` from -reach to reach, `finest_m` apart in the middle.

    The spacing grows in proportion to the distance, as the footprint of a pixel does. Raises ValueError when `count` is
    even or `count` offsets `finest_m` apart already reach beyond `reach_m`.
    """
    if count % 2 == 0:
        raise ValueError(f"{count} offsets have none in the middle; an odd number is needed")
    steps = np.arange(count) - (count - 1) / 2.0
    last = steps[-1]
    if finest_m * last >= reach_m:
        raise ValueError(f"{count} offsets {finest_m:g} m apart reach beyond {reach_m:g} m")
    target = np.log(reach_m / finest_m)
    b = brentq(lambda b: np.log(np.sinh(b * last) / np.sinh(b)) - target, 1e-6 / last, 500.0 / last, xtol=1e-15)
    return np.asarray(finest_m / np.sinh(b) * np.sinh(b * steps))


def shadow_footprint(spheres: Spheres, sun: Float64[np.ndarray, "3"], lowest_m: float) -> Footprint:
    """Mark the cells of a grid where a body may hide the sun from ground that is nowhere lower than `lowest_m`.

    The shadow of a sphere lies along the sun's azimuth between the point below its centre and the point where the ray
    past its top reaches the lowest ground.
    """
    if len(spheres) == 0 or sun[2] <= 0.0:
        return EVERYWHERE
    starts = spheres[:, :2]
    falls = np.maximum(spheres[:, 2] + spheres[:, 3] - lowest_m, 0.0) / sun[2]
    ends = starts - falls[:, None] * sun[:2]
    low, high = np.minimum(starts, ends).min(axis=0), np.maximum(starts, ends).max(axis=0)
    # a body and half a step lie within a cell to each side
    cell = float(max((high - low).max() / MAX_CELLS, 2.0 * spheres[:, 3].max(), 1e-3))
    steps = int(np.ceil(2.0 * float(np.linalg.norm(ends - starts, axis=1).max()) / cell)) + 2
    along = np.linspace(0.0, 1.0, steps)[:, None, None]
    positions = (starts + along * (ends - starts)).reshape(-1, 2)
    corner = low - 2.0 * cell
    columns, rows = (np.floor((high - corner) / cell).astype(int) + 3).tolist()
    cells = np.zeros((rows, columns), dtype=np.bool_)
    column, row = np.floor((positions - corner) / cell).astype(int).T
    cells[row, column] = True
    cells = binary_dilation(cells, np.ones((3, 3), dtype=np.bool_))
    return Footprint(cells, float(corner[0]), float(corner[1]), 1.0 / cell)


def casters_towards(objects: Objects, sun: Sun) -> Casters:
    """List the triangles of objects by their position across the rays to the sun."""
    towards = np.asarray(sun.direction, dtype=np.float64)
    across = np.cross(towards, np.eye(3)[int(np.argmin(np.abs(towards)))])
    across /= np.linalg.norm(across)
    # the kernel's rays run exactly along the sun's direction, as the third axis
    axes = np.stack([across, np.cross(towards, across), towards])
    casters: Casters = list_casters(objects.triangles, objects.first_triangle, axes)
    return casters


def potentially_visible(
    spheres: Spheres, sun: Float64[np.ndarray, "3"], lowest_m: float, cone: Cone
) -> Bool[np.ndarray, "bodies"]:
    """Select the bodies that a picture within a cone may show, or show the shadows of.

    A body's shadow lies within its radius of a line from its centre away from the sun, which ends where all of it is
    below the lowest ground. A sphere about that line and the body is tested against the cone. There are no shadows
    where the sun is not above the horizon.
    """
    tops = np.maximum(spheres[:, 2] + spheres[:, 3] - lowest_m, 0.0)
    half = 0.5 * tops / sun[2] if sun[2] > 0.0 else np.zeros(len(spheres))
    about = np.column_stack([spheres[:, :3] - half[:, None] * sun, spheres[:, 3] + half])
    return spheres_in_cone(about, *cone)


def slope_bounds(surface: Surface, sun: Sun) -> tuple[float, float]:
    """Bounds of the ground's slope along x and y; infinite where ground may be steep enough to hide part of the sun."""
    east, north, _ = np.abs(sun.direction)
    rises = max_rises(surface.levels[0], _lowest_ray(sun) * surface.spacing_m, float(east), float(north))
    return rises[0] / surface.spacing_m, rises[1] / surface.spacing_m


def sun_over_slopes(sun: Sun, max_slopes: tuple[float, float]) -> bool:
    """Whether ground of at most these slopes along x and y leaves the sun's whole disc visible everywhere.

    No line between two of its points then rises as steeply as the rays to the disc's lower edge.
    """
    east, north, _ = np.abs(sun.direction)
    return bool(max_slopes[0] * east + max_slopes[1] * north < _lowest_ray(sun))


def _lowest_ray(sun: Sun) -> float:
    """Rise of rays to the lower edge of the sun's disc over the horizontal length of those to its centre."""
    across = float(np.hypot(sun.direction[0], sun.direction[1]))
    elevation = np.arctan2(sun.direction[2], across) - sun.angular_radius_rad
    return across * float(np.tan(max(elevation, 0.0)))


def ground_shadow(
    surface: Surface, sun: Sun, height_range_m: tuple[float, float], shown_m: Bounds | None = None
) -> GroundShadow:
    """Sweep the ground's shadow along the axis nearest to the azimuth of the sun, which is above the horizon.

    `shown_m` bounds x, then y, of the positions whose shadow is needed, and from which paths towards the sun start;
    None for everywhere. The shadow's grid is that of a level of the surface; where it covers a part of the ground only
    it repeats after fewer posts.
    """
    level = int(np.argmax([one.shape[0] <= SHADOW_SIDE for one in surface.levels]))
    field, spacing = surface.levels[level], surface.spacing_m * 2.0**level
    east, north, up = (float(part) for part in sun.direction)
    along_x = abs(east) > abs(north)
    main, side = (east, north) if along_x else (north, east)
    if main == 0.0:
        return NO_SHADOW
    drop, shift = spacing * up / abs(main), side / abs(main)
    rows = columns = np.arange(len(field))
    reach = int(min(np.ceil((height_range_m[1] - height_range_m[0]) / drop) + 1, len(field)))
    if shown_m is not None:
        # a path towards the sun, and the shadows that fall on its end
        path = 2.2 * reach + _SPARE
        away = spacing * path * np.array([np.sign(main), shift] if along_x else [shift, np.sign(main)])
        bounds = np.reshape(shown_m, (2, 2)) + np.stack([np.minimum(away, 0.0), np.maximum(away, 0.0)], axis=1)
        first = np.floor(bounds[:, 0] / spacing).astype(int) - _SPARE
        last = np.ceil(bounds[:, 1] / spacing).astype(int) + _SPARE
        # the grid repeats after a power of two: post k is entry k modulo that
        count = 1 << int((last - first).max()).bit_length()
        if count < len(field):
            posts = np.arange(count)
            columns, rows = ((one + ((posts - one) & (count - 1))) & (len(field) - 1) for one in first)
    height = heights_in_rows(field, rows, columns, along_x)
    swept, casters = sweep_shadow(height, float(np.sign(main)), drop, shift, reach)
    row_m, across = spacing / abs(main), float(np.hypot(east, north))
    return GroundShadow(swept, casters, along_x, spacing, level, row_m, across, height_range_m[1])


def ground_in_cones(cones: Sequence[Cone], lowest_m: float) -> Bounds | None:
    """Bounds in x and y of all points in any of the cones that are not below `lowest_m`; None if they are unbounded."""
    azimuths = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
    points = []
    for apex, axis, half_angle_rad in cones:
        across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        across /= np.linalg.norm(across)
        perpendicular = np.cos(azimuths)[:, None] * across + np.sin(azimuths)[:, None] * np.cross(axis, across)
        rim = np.cos(half_angle_rad) * axis + np.sin(half_angle_rad) * perpendicular
        if half_angle_rad >= 0.5 * np.pi or np.any(rim[:, 2] >= -1e-6):
            return None
        ends = apex + ((lowest_m - apex[2]) / rim[:, 2])[:, None] * rim
        points.append(np.vstack([apex, ends])[:, :2])
    hull = np.concatenate(points)
    low, high = hull.min(axis=0), hull.max(axis=0)
    margin = _MARGIN * (high - low)
    (west, south), (east, north) = low - margin, high + margin
    return float(west), float(east), float(south), float(north)
