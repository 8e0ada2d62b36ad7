"""Map product of a landing site: appearance from orbital images, orthorectified, and elevation, with their errors.

Position errors: the surface point at world position w appears at the map position ``m = w + shift + d(m)``: a shift of
the whole map, and a smooth random displacement field d. The brightness of a map pixel is that along the ray from the
orbiter to the surface point of the pixel. This is exact orthorectification: it equals the projection of the surface
point into an orbital image, without an interpolation between the image's pixels.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy.random import Generator
from pydantic import Field
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.scenarios.localisation.fields import SmoothField
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.scenarios.radiance import add_haze, sun_at
from marsyard.scenarios.views import SiteGround, micro_relief
from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.frames import rigid
from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.render import Frame, PixelRays, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import Backend, RenderingError
from marsyard.sim.render.rays import VIEW_SIDES_PX
from marsyard.sim.render.shading import GROUND
from marsyard.sim.terrain import Surface

#: Spacing of the renderer's mesh at the centre, metres, and its relative growth per line. The mesh gives first guesses
#: of the intersections of rays and ground. Rays are nearly vertical: Newton's method converges from any such guess.
_MESH_M, _MESH_GROWTH = 40.0, 0.02
#: Side of the pinhole view of the mesh, samples, and margin around the rays in it, as a fraction.
_VIEW_SIDE_PX, _VIEW_MARGIN = VIEW_SIDES_PX[0], 0.03
#: Quantile of the brightness that becomes the largest count of the map, and step between pixels for this quantile.
_WHITE_QUANTILE, _QUANTILE_STEP = 0.999, 4
#: Number of map rows for which rays are computed, and that are rendered, at a time; limits the memory.
_BLOCK_ROWS, _BAND_ROWS = 128, 512
#: Margin of error fields around the map, m: positions near its border can be inverted.
_FIELD_MARGIN_M = 500.0
#: Maximum number of fixed-point iterations of `MapTruth.map_position`, and the change after which they end, m.
_INVERSE_STEPS, _INVERSE_CHANGE_M = 12, 1e-9
Grid = Float32[np.ndarray, "rows columns"]
Coordinates = Float64[np.ndarray, "count"]

REGISTRATION = ErrorSource("map-registration", "map: position as a whole")
DISTORTION = ErrorSource("map-distortion", "map: distortion")
ELEVATION = ErrorSource("map-elevation", "map: elevation")


class MapParameters(Parameters):
    """A map from images of the Context Camera (CTX) on an orbiter; the defaults follow the map of Mars 2020.

    The Lander Vision System used orthorectified CTX images of 6 m a pixel and elevations from CTX stereo images
    (Fergason et al. 2020, doi:10.5066/P906QQT8). CTX: 20 microradians a pixel, 6 m from 300 km (Malin et al. 2007).
    """

    pixel_m: Annotated[Positive, Field(description="size of a map pixel, m")] = 6.0
    side_px: Annotated[int, Field(ge=16, le=4096, description="rows, and columns, of the map")] = 2048
    sun_azimuth_deg: Annotated[
        float, bounded_field(0.0, 360.0, "azimuth of the sun in the orbital images, clockwise from north (15 h)")
    ] = 275.0
    sun_elevation_deg: Annotated[
        float, bounded_field(5.0, 90.0, "elevation of the sun in the orbital images (15 h local time)")
    ] = 40.0
    optical_depth: Annotated[
        float | None, Field(ge=0.0, le=10.0, description="optical depth in the orbital images; None: as at the landing")
    ] = None
    orbit_height_m: Annotated[
        float, bounded_field(1e5, 1e6, "height of the orbiter above the ground, above the map's centre, m")
    ] = 3.0e5
    signal_to_noise: Annotated[
        Positive, Field(description="mean signal divided by the SD of noise per map pixel; assumed")
    ] = 100.0
    aperture_px: Annotated[
        float, bounded_field(0.1, 1.0, "width of the ground that a detector element averages, map pixels; assumed")
    ] = 0.8
    nyquist_mtf: Annotated[
        float,
        bounded_field(
            0.01, 1.0, "MTF of optics, motion and processing, without aperture, at one cycle per two pixels; assumed"
        ),
    ] = 0.33
    bits: Annotated[int | None, Field(ge=6, le=16, description="bits of a pixel; None: not quantised")] = 8
    registration_sd_m: Annotated[
        NonNegative,
        REGISTRATION,
        Field(description="SD of the shift of the whole map, per axis, m; assumed: up to 150 m is 3 SD"),
    ] = 50.0
    distortion_sd_m: Annotated[
        NonNegative, DISTORTION, Field(description="SD of the distortion, per axis, m; assumed: one pixel")
    ] = 6.0
    distortion_length_m: Annotated[Positive, Field(description="correlation length of the distortion, m; assumed")] = (
        1500.0
    )
    elevation_sd_m: Annotated[NonNegative, ELEVATION, Field(description="SD of the elevation error, m; assumed")] = 5.0
    elevation_length_m: Annotated[
        Positive, Field(description="correlation length of the elevation error, m; assumed")
    ] = 300.0
    elevation_post_m: Annotated[
        NonNegative, Field(description="distance of the elevation model's posts, m; assumed; 0: exact in each pixel")
    ] = 20.0


@dataclass(frozen=True)
class MapTruth:
    """True errors of a map.

    - shift_m: map position minus world position, of the whole map
    - distortion_x, distortion_y: additional displacement along each axis, m, at a map position
    - elevation_error: error of the elevation, m, at a map position, without the effect of the posts' distance
    - counts_per_radiance: appearance divided by the radiance factor at the orbiter
    """

    shift_m: Float64[np.ndarray, "2"]
    distortion_x: SmoothField
    distortion_y: SmoothField
    elevation_error: SmoothField
    counts_per_radiance: float

    def distortion(self, map_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the displacement of map positions relative to the whole map, m."""
        x, y = np.atleast_1d(map_m[..., 0]), np.atleast_1d(map_m[..., 1])
        return np.stack([self.distortion_x.at(x, y), self.distortion_y.at(x, y)], axis=-1).reshape(np.shape(map_m))

    def world_position(self, map_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the world x, y of the surface point that appears at a map position.

        The position error of the map is ``map_m - world_position(map_m)``.
        """
        return np.asarray(map_m - self.shift_m - self.distortion(map_m))

    def map_position(self, world_m: Float[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        """Return the map position at which a world position appears, by fixed-point iteration.

        It converges, because the distortion changes much less over a metre than a metre.
        """
        map_m = world_m + self.shift_m
        for _ in range(_INVERSE_STEPS):
            previous_m, map_m = map_m, world_m + self.shift_m + self.distortion(map_m)
            if np.abs(map_m - previous_m).max(initial=0.0) < _INVERSE_CHANGE_M:
                break
        return np.asarray(map_m)


def make_map(
    world: LocalisationWorld,
    parameters: MapParameters,
    centre_m: Float[np.ndarray, "2"],
    rng: Generator,
    backend: Backend,
) -> tuple[MapProduct, MapTruth]:
    """Make a map of the ground around `centre_m` (world x, y), and return its true errors.

    The steps: position errors, rendering along the rays from the orbiter through the whole atmosphere under the
    orbital images' own sun and dust, blur, noise, quantisation; elevation of the posts and its error.
    """
    p = parameters
    half_m = 0.5 * (p.side_px - 1) * p.pixel_m
    origin = np.asarray(centre_m, dtype=np.float64) - half_m
    x, y = (start + p.pixel_m * np.arange(p.side_px) for start in origin)
    extent = origin - _FIELD_MARGIN_M, origin + 2.0 * half_m + _FIELD_MARGIN_M
    shift = p.registration_sd_m * rng.standard_normal(2)
    distortion_x, distortion_y = (
        SmoothField.draw(*extent, p.distortion_sd_m, p.distortion_length_m, rng) for _ in range(2)
    )
    elevation_error = SmoothField.draw(*extent, p.elevation_sd_m, p.elevation_length_m, rng)
    truth = MapTruth(shift, distortion_x, distortion_y, elevation_error, 1.0)

    elevation = _elevation(world.surface, p, truth, x, y)
    elevation += elevation_error.on_grid(x, y)
    elevation = elevation.astype(np.float32)
    appearance = _render(world.ground, p, np.asarray(centre_m, dtype=np.float64), truth, (x, y), backend)
    appearance = blur(appearance, p.nyquist_mtf)
    noise = rng.standard_normal(appearance.shape, dtype=np.float32)
    appearance += noise * np.float32(appearance.mean(dtype=np.float64) / p.signal_to_noise)
    if p.bits is not None:
        top = 2**p.bits - 1
        white = np.quantile(appearance[::_QUANTILE_STEP, ::_QUANTILE_STEP], _WHITE_QUANTILE)
        truth = replace(truth, counts_per_radiance=top / float(white))
        appearance = np.clip(np.rint(appearance * np.float32(truth.counts_per_radiance)), 0.0, top)

    product = MapProduct(
        appearance=appearance.astype(np.float32, copy=False),
        elevation_m=elevation,
        origin_m=origin,
        pixel_m=p.pixel_m,
        registration_sd_m=p.registration_sd_m,
        distortion_sd_m=p.distortion_sd_m,
        elevation_sd_m=p.elevation_sd_m,
    )
    return product, truth


def blur(image: Grid, nyquist_mtf: float) -> Grid:
    """Filter an image by a Gaussian whose modulation transfer at one cycle per two pixels is `nyquist_mtf`.

    The transfer of a Gaussian with the standard deviation s, pixels, is ``exp(-2 (pi s f)**2)``.
    """
    if nyquist_mtf == 1.0:
        return image
    sd_px = np.sqrt(-2.0 * np.log(nyquist_mtf)) / np.pi
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sd_px, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)


def _world_grid(
    truth: MapTruth, x: Coordinates, y: Coordinates
) -> tuple[Float64[np.ndarray, "rows columns"], Float64[np.ndarray, "rows columns"]]:
    """Return the world x and y of the surface points that appear on a grid of map positions."""
    east = x[None, :] - truth.shift_m[0] - truth.distortion_x.on_grid(x, y)
    north = y[:, None] - truth.shift_m[1] - truth.distortion_y.on_grid(x, y)
    return east, north


def _elevation(
    surface: Surface, p: MapParameters, truth: MapTruth, x: Coordinates, y: Coordinates
) -> Float64[np.ndarray, "rows columns"]:
    """Return the elevation of the map's pixels: exact, or interpolated by cubic splines between posts.

    A post has the height of the terrain level with the next smaller spacing: stereo correlation averages over a post.
    """
    if p.elevation_post_m == 0.0:
        return surface.height(*_world_grid(truth, x, y))
    level = int(np.clip(np.log2(p.elevation_post_m / surface.spacing_m), 0, len(surface.levels) - 1))
    posts_x, posts_y = (
        np.arange(line[0] - 2.0 * p.elevation_post_m, line[-1] + 3.0 * p.elevation_post_m, p.elevation_post_m)
        for line in (x, y)
    )
    heights = surface.height(*_world_grid(truth, posts_x, posts_y), level)
    return np.asarray(RectBivariateSpline(posts_y, posts_x, heights)(y, x))


def _render(
    ground: SiteGround,
    p: MapParameters,
    centre_m: Float64[np.ndarray, "2"],
    truth: MapTruth,
    map_axes: tuple[Coordinates, Coordinates],
    backend: Backend,
) -> Grid:
    """Compute the radiance factor at the orbiter of the surface points that appear on the grid of map positions."""
    ground = replace(ground, site=ground.site.with_dust(p.optical_depth))
    air = ground.site.environment
    sun = sun_at(air, p.sun_azimuth_deg, p.sun_elevation_deg)
    orbiter = np.array([*centre_m, float(ground.surface.height(*centre_m)) + p.orbit_height_m])
    east, north = _world_grid(truth, *map_axes)
    rays = orbital_rays(ground.surface, orbiter, east, north, p.aperture_px * p.pixel_m)
    scene = _map_scene(ground, sun, centre_m, east, north, p.orbit_height_m)
    del east, north  # frees memory before rendering
    pose = rigid(Rotation.identity(), orbiter)
    columns, rows = rays.size
    radiance, range_m = np.empty((rows, columns), dtype=np.float32), np.empty((rows, columns))
    for first in range(0, rows, _BAND_ROWS):
        band = slice(first, min(first + _BAND_ROWS, rows))
        rendered = process_renderer(backend).render(scene, _select_rows(rays, band), pose)
        radiance[band], range_m[band] = rendered.radiance, rendered.range_m
    if not np.isfinite(range_m).all():
        raise RenderingError("the mesh of the orbital images does not cover the map")
    # the haze depends on the mean radiance of the whole map
    body = np.broadcast_to(np.int32(GROUND), range_m.shape)
    normal = np.broadcast_to(np.zeros(3, dtype=np.float32), (rows, columns, 3))
    frame = Frame(radiance, range_m, body, normal, pose, rays)
    return add_haze(frame, air, sun, air.mean_extinction_m(p.orbit_height_m))


def _select_rows(rays: PixelRays, rows: slice) -> PixelRays:
    """Return the rays of some rows of an image with a single view."""
    columns = rays.size[0]
    pixels = slice(rows.start * columns, rows.stop * columns)
    return replace(
        rays,
        origins=rays.origins[pixels],
        directions=rays.directions[pixels],
        size=(columns, rows.stop - rows.start),
        pixel_angles=rays.pixel_angles[pixels],
        view_of_pixel=rays.view_of_pixel[pixels],
    )


def orbital_rays(
    surface: Surface,
    orbiter_m: Float64[np.ndarray, "3"],
    east: Float64[np.ndarray, "rows columns"],
    north: Float64[np.ndarray, "rows columns"],
    aperture_m: float,
) -> PixelRays:
    """Compute the rays from an orbiter to the surface points at world x, y, in world axes.

    `aperture_m` is the width of the ground that each of them averages.

    Rays are in single precision: at 300 km and up to 1.2 deg from nadir a position on the ground is exact to a
    millimetre.
    """
    rows, columns = east.shape
    directions = np.empty((rows, columns, 3), dtype=np.float32)
    angles = np.empty((rows, columns), dtype=np.float32)
    for first in range(0, rows, _BLOCK_ROWS):
        block = slice(first, first + _BLOCK_ROWS)
        x, y = east[block], north[block]
        vectors = np.stack([x, y, surface.height(x, y)], axis=-1) - orbiter_m
        distance = np.sqrt(np.einsum("ijk,ijk->ij", vectors, vectors))
        directions[block] = vectors / distance[..., None]
        angles[block] = aperture_m / distance
    border = [directions[0], directions[-1], directions[:, 0], directions[:, -1]]
    radius = max(float(np.abs(rays[:, :2] / rays[:, 2:]).max()) for rays in border)
    return PixelRays(
        centre=np.zeros(3),
        origins=np.zeros((rows * columns, 3), dtype=np.float32),
        directions=directions.reshape(-1, 3),
        size=(columns, rows),
        pixel_angles=angles.ravel(),
        view_side_px=_VIEW_SIDE_PX,
        view_from_body=np.diag([1.0, -1.0, -1.0])[None],
        focal_px=np.array([(0.5 - _VIEW_MARGIN) * _VIEW_SIDE_PX / radius]),
        view_of_pixel=np.zeros(rows * columns, dtype=np.uint8),
    )


def _map_scene(
    ground: SiteGround,
    sun: Sun,
    centre_m: Float64[np.ndarray, "2"],
    east: Float64[np.ndarray, "rows columns"],
    north: Float64[np.ndarray, "rows columns"],
    orbit_height_m: float,
) -> Scene:
    """Create the scene of the orbital images: the ground without rocks, which are smaller than a map pixel."""
    bounds = float(east.min()), float(east.max()), float(north.min()), float(north.max())
    # the renderer traces rays up to twice the half width of the mesh: 1.1 times the height of the orbiter
    half_width_m = 0.55 * orbit_height_m
    half_lines = int(np.arcsinh(half_width_m / _MESH_M * np.sinh(_MESH_GROWTH)) / _MESH_GROWTH)
    texture = ground.site.ground_texture
    return Scene(
        ground.surface,
        (float(centre_m[0]), float(centre_m[1])),
        sun,
        ground.photometry(sun),
        relief=micro_relief(ground),
        ground_texture=Texture(texture.coarsest_m, texture.amplitudes),
        mesh_finest_m=_MESH_M,
        mesh_half_width_m=half_width_m,
        mesh_lines=2 * half_lines + 1,
        visible_m=bounds,
    )
