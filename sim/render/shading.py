"""The radiance of every pixel: sample the surface that its ray meets, then texture, illumination and reflectance."""

from dataclasses import dataclass

import drjit as dr

from marsyard.sim.render.arrays import Values, compiled, larger, smaller, where
from marsyard.sim.render.clouds import Clouds
from marsyard.sim.render.device import Array3f, Array3f64, Array4f, Bool, Float, Float64, Int32, UInt32
from marsyard.sim.render.micro_relief import RoughGround, relief_slopes, smith_shadowing
from marsyard.sim.render.obstructions import Hidden, Obstructions
from marsyard.sim.render.pebbles import PebbleField, pebble_surface
from marsyard.sim.render.photometry import Angles, Law
from marsyard.sim.render.primary import Hits, Points, locate
from marsyard.sim.render.rays import Pose, Rays
from marsyard.sim.render.rock_surface import WEAR, RockSurface, dust_cover, rock_surface, texture_frame
from marsyard.sim.render.shadows import AUREOLE_BEHIND_BODY, VisibleLight
from marsyard.sim.render.sky import Sky, disc_overlap
from marsyard.sim.render.skyline import Skyline
from marsyard.sim.render.spline import Terrain, evaluate
from marsyard.sim.render.texture import Cover, Octaves, log_relative_albedo

#: Maximum footprint, in samples, for which the finest level is used; the B-spline contains no finer detail.
MAX_SHARP_FOOTPRINT = 1.2
#: Body number of pixels that see the ground, and of pixels that see the sky.
GROUND, SKY = -1, -2


@dataclass(frozen=True, eq=False)
class Light:
    """Illumination at one time: unit vector to the sun, its angular radius, reflectance law, sky, and clouds.

    `disc_fraction` of the direct sunlight comes from the sun's disc, the rest from its aureole. `caster_diameter` is
    that of a round body at the camera, metres; None without one. `obstructions` hide the sky from the ground, the
    `skyline` hides it in images.
    """

    sun: Values
    sun_radius: Values
    disc_fraction: Values
    law: Law
    sky: Sky
    caster_diameter: Values | None
    clouds: Clouds | None
    obstructions: Obstructions | None
    skyline: Skyline | None

    def sky_radiance(self, direction: Values, pixel_rad: Values) -> Values:
        """Radiance factor of the sky, and of the relief on the horizon, in directions."""
        cos_g = dr.dot(direction, self.sun)
        sky = Float(self.sky.radiance(self.sun.z, self.sun_radius, direction.z, cos_g, Float64(pixel_rad)))
        return sky if self.skyline is None else self.skyline.cover(sky, direction, self.law, self.sun, pixel_rad)


@dataclass(frozen=True, eq=False)
class ObjectSurfaces:
    """Normals at the corners of all triangles, body of each triangle, and albedo of each body.

    `dust_albedo` is that of a body's level faces, `grain` that of `rock_surface.describe_grain`, of size 0 for
    bodies without grain.
    """

    corner_normals: Values
    body_of_triangle: Values
    albedo: Values
    dust_albedo: Values
    grain: Values


@dataclass(frozen=True, eq=False)
class Materials:
    """Micro-relief, pebbles, borders of sand, textures of ground and objects, and the objects' surfaces.

    None where there are none.
    """

    relief: RoughGround | None
    pebbles: PebbleField | None
    cover: Cover | None
    ground_texture: Octaves
    object_texture: Octaves
    objects: ObjectSurfaces | None


@dataclass(frozen=True, eq=False)
class ShadedImage:
    """Radiance factor, body number (or `GROUND`, `SKY`) and unit normal in world axes of each pixel.

    `sun_fraction` is the fraction of the sun's disc that ground and objects leave visible (`shadows.VisibleLight`).
    """

    radiance: Values
    body: Values
    normal: Values
    sun_fraction: Values


@dataclass(eq=False)
class _Surface:
    """Slopes along x and y and albedo of the ground."""

    slope_x: Values
    slope_y: Values
    albedo: Values

    def normal(self) -> Values:
        """Compute the unit normal."""
        return dr.normalize(Array3f(-self.slope_x, -self.slope_y, 1.0))


def _sample_ground(terrain: Terrain, points: Points, level: Values) -> _Surface:
    """Sample the ground on the two terrain levels nearest to the pixels' footprints, and blend them."""
    samples = points.footprint / (MAX_SHARP_FOOTPRINT * Float(terrain.spacing))
    fractional = larger(dr.log2(larger(samples, 1.0)), Float(level))
    lower = dr.minimum(Int32(fractional), terrain.top_level)
    blend = dr.select(lower < terrain.top_level, smaller(fractional - Float(lower), 1.0), 0.0)

    def add_level(total: _Surface, weight: Values, level: Values, is_active: Values) -> tuple[_Surface, ...]:
        ground = evaluate(terrain, level, points.position.x, points.position.y, is_active)
        total = _Surface(
            dr.fma(weight, ground.slope_x, total.slope_x),
            dr.fma(weight, ground.slope_y, total.slope_y),
            dr.fma(weight, ground.albedo, total.albedo),
        )
        return total, blend, level + 1, is_active & (blend > 0.0) & (level == lower)

    nothing = _Surface(Float(0.0), Float(0.0), Float(0.0))
    return dr.while_loop(
        (nothing, 1.0 - blend, Int32(lower), Bool(points.is_ground)),
        lambda total, weight, level, is_active: is_active,
        add_level,
    )[0]


@compiled
def shade(
    terrain: Terrain, pose: Pose, rays: Rays, hits: Hits, light: Light, visible: VisibleLight, materials: Materials
) -> ShadedImage:
    """Compute radiance factor, body and normal of every pixel."""
    points = locate(rays, pose, hits)
    is_object, is_ground = points.is_object, points.is_ground
    ground = _sample_ground(terrain, points, hits.level)
    normal, albedo = ground.normal(), ground.albedo
    strength, texture_position = Float(1.0), Array3f64(points.position)
    body, texture_footprint = dr.select(is_ground, Int32(GROUND), SKY), dr.select(is_ground, points.footprint, dr.inf)
    if materials.objects is not None:
        object_normal = hits.interpolate_normal(materials.objects.corner_normals, is_object)
        normal = dr.select(is_object, object_normal, normal)
        object_body = dr.gather(Int32, materials.objects.body_of_triangle, UInt32(hits.triangle), is_object)
        body = dr.select(is_object, object_body, body)
        object_albedo = dr.gather(Float, materials.objects.albedo, UInt32(object_body), is_object)
        dust_albedo = dr.gather(Float, materials.objects.dust_albedo, UInt32(object_body), is_object)
        facing = -dr.dot(Array3f(points.direction), object_normal)
        object_footprint = Float(hits.distance) * rays.pixel_angles / dr.sqrt(larger(facing, 0.05))
        grain = dr.gather(Array4f, materials.objects.grain, UInt32(object_body), is_object)
        is_grainy = is_object & (grain.w > 0.0)
        rock = where(
            is_grainy,
            lambda: rock_surface(grain, points.position, object_normal, object_footprint),
            RockSurface(Array3f(0.0), Float(0.0), dust_cover(object_normal.z)),
        )
        object_albedo = dr.lerp(object_albedo, dust_albedo, rock.dust) * dr.exp(rock.log_albedo)
        albedo = dr.select(is_object, object_albedo, albedo)
        rock_position, rock_footprint = texture_frame(grain, points.position, object_footprint)
        texture_position = dr.select(is_grainy, rock_position, texture_position)
        texture_footprint = dr.select(is_object, object_footprint, texture_footprint)
        texture_footprint = dr.select(is_grainy, rock_footprint, texture_footprint)
        strength = dr.select(is_object & ~is_grainy, WEAR, 1.0)
    is_surface = is_ground | is_object
    smooth_normal = dr.select(is_surface, normal, 0.0)
    if materials.objects is not None:
        grainy_normal = normal - (rock.slope - dr.dot(rock.slope, normal) * normal)
        normal = dr.select(is_grainy, dr.normalize(grainy_normal), normal)
    slopes, roughness = None, Float(1.0)
    if materials.relief is not None:
        # tilted normals change the mean radiance, but the reflectance law already includes the mean effect of all
        # roughness: the mean is restored below
        slopes = relief_slopes(materials.relief, points.position, dr.select(is_ground, points.footprint, dr.inf))
        x, y = points.position.x, points.position.y
        roughness = dr.select(is_ground, materials.relief.roughness.interpolate(x, y), 0.0)
        strength = dr.select(is_ground, materials.relief.texture.interpolate(x, y), strength)
        tilted = _Surface(ground.slope_x + roughness * slopes.x, ground.slope_y + roughness * slopes.y, albedo)
        normal = dr.select(is_ground, tilted.normal(), normal)
        slopes.resolved, slopes.unresolved = (
            roughness * roughness * variance for variance in (slopes.resolved, slopes.unresolved)
        )
    pebbles = None
    if materials.pebbles is not None:
        footprint = dr.select(is_ground, points.footprint, dr.inf)
        density = materials.pebbles.density_at(ground.albedo, roughness)
        pebbles = pebble_surface(materials.pebbles, points.position, footprint, Array3f(light.sun), density)
        bump_x, bump_y = pebbles.normal.x / pebbles.normal.z, pebbles.normal.y / pebbles.normal.z
        bumped = Array3f(normal.x / normal.z + bump_x, normal.y / normal.z + bump_y, 1.0)
        normal = dr.select(is_ground, dr.normalize(bumped), normal)
        albedo *= dr.exp(pebbles.log_albedo)
    angles = Angles.of(normal, points.direction, light.sun)
    textures = materials.ground_texture, materials.object_texture
    texture = log_relative_albedo(*textures, is_object, texture_position, texture_footprint, strength)
    if materials.cover is not None:
        brighter = materials.cover.brighten(dr.log(larger(ground.albedo, 1e-6)) + texture)
        texture += dr.select(is_ground, brighter, 0.0)
    albedo *= dr.exp(texture)
    # a copy: products in place would change the fraction that is returned
    fraction = Float(visible.sun)
    if light.caster_diameter is not None:
        radius = 0.5 * light.caster_diameter / hits.distance
        fraction *= where(
            is_surface & (angles.cos_g > 0.9),
            lambda: 1.0 - Float(disc_overlap(radius, light.sun_radius, dr.acos(angles.cos_g))),
            Float(1.0),
        )
    hidden = Hidden(Array3f(0.0), Float(0.0))
    if light.obstructions is not None:
        hidden = light.obstructions.hide_light(points.position, is_ground, is_object)
    fraction = dr.lerp(visible.aureole * (1.0 - hidden.aureole), fraction, light.disc_fraction)
    if pebbles is not None:
        # the reflectance law includes the mean effect of all roughness
        darkness = dr.lerp(1.0 - AUREOLE_BEHIND_BODY, 1.0, light.disc_fraction)
        fraction *= (1.0 - darkness * pebbles.shadow) * (1.0 + darkness * pebbles.loss)
    if light.clouds is not None:
        fraction *= light.clouds.transmittance(points.position, light.sun)
    if slopes is not None:
        # on level ground the mean of n_z, 1 / sqrt(1 + slope**2), is 1 - variance to second order in the slope
        cosine = smaller(larger(angles.cos_i, 1e-6), 1.0)
        fraction *= (1.0 + slopes.resolved) * smith_shadowing(cosine, slopes.unresolved)
    radiance = albedo * light.law.radiance(angles, normal, fraction, hidden.sky)
    radiance = where(~is_surface, lambda: light.sky_radiance(points.direction, rays.pixel_angles), radiance)
    return ShadedImage(radiance, body, smooth_normal, visible.sun)
