"""Orbital images of the ground of a map: rendering along the rays from an orbiter."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.localisation.map_truth import MapTruth
from marsyard.scenarios.localisation.parameters import MapParameters
from marsyard.scenarios.radiance import add_haze, sun_at
from marsyard.scenarios.views import SiteGround, micro_relief
from marsyard.sim.frames import rigid
from marsyard.sim.render import Frame, PixelRays, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import Backend, RenderingError
from marsyard.sim.render.cones import Bounds
from marsyard.sim.render.pixel_rays import VIEW_SIDES_PX
from marsyard.sim.render.shading import GROUND
from marsyard.sim.terrain import Surface

#: Spacing of the renderer's mesh at the centre, metres, and its relative growth per line. The mesh gives first guesses
#: of the intersections of rays and ground. Rays are nearly vertical: Newton's method converges from any such guess.
_MESH_M, _MESH_GROWTH = 40.0, 0.02
#: Side of the pinhole view of the mesh, samples, and margin around the rays in it, as a fraction.
_VIEW_SIDE_PX, _VIEW_MARGIN = VIEW_SIDES_PX[0], 0.03
#: Number of map rows for which rays are computed, and that are rendered, at a time; limits the memory.
_BLOCK_ROWS, _BAND_ROWS = 128, 512
Grid = Float32[np.ndarray, "rows columns"]
Coordinates = Float64[np.ndarray, "count"]


def world_grid(
    truth: MapTruth, x: Coordinates, y: Coordinates
) -> tuple[Float64[np.ndarray, "rows columns"], Float64[np.ndarray, "rows columns"]]:
    """Return the world x and y of the surface points that appear on a grid of map positions."""
    east = x[None, :] - truth.shift_m[0] - truth.distortion_x.on_grid(x, y)
    north = y[:, None] - truth.shift_m[1] - truth.distortion_y.on_grid(x, y)
    return east, north


def render_map(
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
    east, north = world_grid(truth, *map_axes)
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
    """Compute the rays from an orbiter to the surface points at world x, y (`east`, `north`), in world axes.

    `aperture_m` is the width of the ground that each of them averages. Rays are in single precision: at 300 km and up
    to 1.2 deg from nadir a position on the ground is exact to a millimetre.
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
    max_tangent = max(float(np.abs(rays[:, :2] / rays[:, 2:]).max()) for rays in border)
    return PixelRays(
        centre=np.zeros(3),
        origins=np.zeros((rows * columns, 3), dtype=np.float32),
        directions=directions.reshape(-1, 3),
        size=(columns, rows),
        pixel_angles=angles.ravel(),
        view_side_px=_VIEW_SIDE_PX,
        view_from_body=np.diag([1.0, -1.0, -1.0])[None],
        focal_px=np.array([(0.5 - _VIEW_MARGIN) * _VIEW_SIDE_PX / max_tangent]),
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
    bounds = Bounds(float(east.min()), float(east.max()), float(north.min()), float(north.max()))
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
