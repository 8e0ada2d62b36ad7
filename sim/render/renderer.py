"""Radiance and truth of a scene through an exact camera model.

OpenGL draws pinhole views that contain the camera's field: the depth of the ground, and the numbers of the triangles
before it. They give each pixel's own ray, from the exact camera model, a first guess. The ray is then brought onto the
terrain by Newton's method or onto its triangle by intersection, and shaded there: distortion is exact.

One ray per pixel draws outlines ragged. Pixels at edges of objects, of ground before other ground or the sky, and of
shadows are therefore traced again by several rays; their radiance is the mean. Range, body and normal remain those of
the ray through the pixel's centre.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from marsyard.sim.frames import turn_matrix
from marsyard.sim.render.backend import Backend, DepthRenderer, PinholeView, RenderingError
from marsyard.sim.render.kernels.edges import mark_edges, split_rays, trace_subpixel_rays
from marsyard.sim.render.kernels.primary import GRAZING, trace_primary_rays
from marsyard.sim.render.kernels.shading import shade
from marsyard.sim.render.kernels.structs import Ground, Hits, Light, Picture, Pose, Rays, Views
from marsyard.sim.render.mesh import cells_in_hull, ground_mesh, ground_struct, lines_in_view
from marsyard.sim.render.process import in_parts, keep_freed_memory, return_freed_memory
from marsyard.sim.render.rays import VIEW_SIDE_PX, PixelRays
from marsyard.sim.render.scene import Scene


def edge_pixels(
    radiance: Float32[np.ndarray, "rows columns"],
    distance: Float64[np.ndarray, "rows columns"],
    body: Int32[np.ndarray, "rows columns"],
) -> Int64[np.ndarray, "pixels"]:
    """Numbers, row by row, of the pixels on both sides of visible edges."""
    marked = np.zeros(radiance.shape, dtype=np.bool_)
    mark_edges(radiance, distance, body, marked)
    return np.flatnonzero(marked)


def rays_within(rays: PixelRays, pixels: Int64[np.ndarray, "pixels"], side: int) -> Rays:
    """Spread `side` x `side` rays over each of some pixels; each takes the pixel angle of its pixel."""
    columns, rows = rays.size
    count = len(pixels) * side**2
    origins, directions = np.empty((count, 3), dtype=np.float32), np.empty((count, 3), dtype=np.float32)
    split_rays(rays.origins, (rows, columns), pixels, side, False, origins)
    split_rays(rays.directions, (rows, columns), pixels, side, True, directions)
    return Rays(origins, directions, np.repeat(rays.pixel_angles[pixels], side**2))


@dataclass(frozen=True)
class Frame:
    """A picture without detector, and its truth.

    - radiance: radiance factor (I/F)
    - range_m: distance along each pixel's ray from its origin, infinite for the sky
    - body: number of the visible object (row of `Scene.objects`), `GROUND` (-1) or `SKY` (-2)
    - normal: unit normal of the visible surface, world axes; zero for the sky
    - rays: the camera's rays in the body frame
    """

    radiance: Float32[np.ndarray, "rows columns"]
    range_m: Float64[np.ndarray, "rows columns"]
    body: Int32[np.ndarray, "rows columns"]
    normal: Float32[np.ndarray, "rows columns 3"]
    world_from_body: RigidTransform
    rays: PixelRays

    def points_world(self, step_px: int = 1) -> Float64[np.ndarray, "m n 3"]:
        """World point seen by each pixel of every `step_px`-th row and column, metres; NaN for the sky."""
        distance = self.range_m[::step_px, ::step_px]
        origins, directions = (
            vectors.reshape(*self.range_m.shape, 3)[::step_px, ::step_px].reshape(-1, 3)
            for vectors in (self.rays.origins, self.rays.directions)
        )
        along = np.where(np.isfinite(distance), distance, np.nan).reshape(-1, 1)
        points_body = self.rays.centre + origins + along * directions.astype(np.float64)
        points: Float64[np.ndarray, "pixels 3"] = self.world_from_body.apply(points_body)
        return points.reshape(*distance.shape, 3)


#: Scenes after which freed memory is returned to the system; after every scene it would take a tenth of a rover's run.
_SCENES_KEPT = 16


class Renderer:
    """Renders scenes through cameras. One per process, created inside the worker that uses it."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._views: dict[int, DepthRenderer] = {}
        self._last: Scene | None = None
        self._scenes = 0
        keep_freed_memory()

    def description(self) -> str:
        """Renderer and version strings of OpenGL."""
        return self._view_renderer(VIEW_SIDE_PX).description()

    def render(self, scene: Scene, rays: PixelRays, world_from_body: RigidTransform, time_s: float = 0.0) -> Frame:
        """Render the scene through a camera in the body frame, its clouds drifted to their positions at this time.

        Raises RenderingError where the camera is at or below the ground.
        """
        pose = Pose(turn_matrix(world_from_body), world_from_body.apply(rays.centre))
        clearance = pose.position[2] - float(scene.surface.height(pose.position[0], pose.position[1]))
        if clearance <= 0.0:
            raise RenderingError(f"the camera is {-clearance:.2f} m below the ground at {pose.position}")
        self._load(scene, rays, pose)
        views = self._draw(scene, rays, pose, clearance)
        columns, rows = rays.size
        highest_ray = np.arcsin(np.clip((pose.rotation @ rays.axis)[2], -1.0, 1.0)) + rays.half_angle_rad
        grazing = bool(np.sin(min(highest_ray, 0.5 * np.pi)) > -GRAZING)
        ground = ground_struct(scene.surface, scene.extent_m, ceilings=grazing)
        hits, light, tree = _empty_hits(rows * columns, scene), scene.light(time_s), scene.objects.hierarchy

        def trace(part: slice) -> None:
            some = views._replace(view_of_pixel=rays.view_of_pixel[part])
            trace_primary_rays(ground, some, pose, Rays(*_part(rays.rays, part)), tree, Hits(*_part(hits, part)))

        in_parts(trace, rows * columns)
        picture = _shade(scene, ground, pose, rays.rays, hits, light)
        radiance, body = picture.radiance.reshape(rows, columns), picture.body.reshape(rows, columns)
        range_m, normal = hits.distance.reshape(rows, columns), picture.normal.reshape(rows, columns, 3)
        if scene.edge_rays > 1:
            pixels = edge_pixels(radiance, range_m, body)
            subpixel_rays = rays_within(rays, pixels, scene.edge_rays)
            subpixel_hits = _empty_hits(len(subpixel_rays.directions), scene)
            trace_subpixel_rays(ground, pose, tree, columns, pixels, subpixel_rays, hits, subpixel_hits)
            finer = _shade(scene, ground, pose, subpixel_rays, subpixel_hits, light).radiance
            picture.radiance[pixels] = finer.reshape(len(pixels), scene.edge_rays**2).mean(axis=1)
        return Frame(radiance, range_m, body, normal, world_from_body, rays)

    def close(self) -> None:
        """Release the OpenGL contexts."""
        for view in self._views.values():
            view.close()
        self._views.clear()
        self._last = None

    def _view_renderer(self, side_px: int) -> DepthRenderer:
        if side_px not in self._views:
            self._views[side_px] = DepthRenderer(side_px, self._backend)
        return self._views[side_px]

    def _load(self, scene: Scene, rays: PixelRays, pose: Pose) -> None:
        """Load the ground and the objects that this picture shows."""
        points = _ground_in_view(scene, rays, pose)
        (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
        x = lines_in_view(scene.centre_m[0] + scene.mesh_offsets, west, east)
        y = lines_in_view(scene.centre_m[1] + scene.mesh_offsets, south, north)
        numbers = scene.objects.in_cone(pose.position, pose.rotation @ rays.axis, rays.half_angle_rad)
        ground = ground_mesh(scene.surface, x, y, cells_in_hull(x, y, points))
        self._view_renderer(rays.view_side_px).load(ground, scene.objects.triangles[numbers], numbers)
        if self._last is not scene:
            self._last = scene
            self._scenes += 1
            if self._scenes % _SCENES_KEPT == 0:
                return_freed_memory()

    def _draw(self, scene: Scene, rays: PixelRays, pose: Pose, clearance_m: float) -> Views:
        """Depth and triangle numbers of the camera's pinhole views."""
        renderer = self._view_renderer(rays.view_side_px)
        drawn = []
        for view_from_body, focal in zip(rays.view_from_body, rays.focal_px, strict=True):
            world_from_view = np.eye(4)
            world_from_view[:3, :3] = pose.rotation @ view_from_body.T
            world_from_view[:3, 3] = pose.position
            # a twentieth of the height above the ground: nearer relief and objects are cut off; depth is only a first
            # guess, so its coarseness far away is harmless
            far = 2.0 * scene.mesh_reach_m + clearance_m
            drawn.append(renderer.draw(PinholeView(world_from_view, float(focal), 0.05 * clearance_m, far)))
        # a single view is not copied
        depth, numbers = (
            pictures[0][np.newaxis] if len(pictures) == 1 else np.stack(pictures)
            for pictures in zip(*drawn, strict=True)
        )
        return Views(depth, numbers, rays.focal_px, rays.view_from_body, rays.view_of_pixel)


def _empty_hits(count: int, scene: Scene) -> Hits:
    """Output arrays for the hits of so many rays."""
    weighted = count if len(scene.objects) > 0 else 0
    return Hits(
        np.empty(count), np.empty(count, np.int32), np.empty((weighted, 2), np.float32), np.empty(count, np.int8)
    )


def _part(arrays: Iterable[NDArray[Any]], part: slice) -> list[NDArray[Any]]:
    return [array[part] for array in arrays]


def _shade(scene: Scene, ground: Ground, pose: Pose, rays: Rays, hits: Hits, light: Light) -> Picture:
    """Compute radiance factor, body number and normal at hits."""
    count = len(rays.directions)
    picture = Picture(np.empty(count, np.float32), np.empty(count, np.int32), np.empty((count, 3), np.float32))
    occluders, materials = scene.occluders, scene.materials

    def shade_part(part: slice) -> None:
        some_rays, some_hits, some_pixels = (_part(arrays, part) for arrays in (rays, hits, picture))
        shade(ground, pose, Rays(*some_rays), Hits(*some_hits), light, occluders, materials, Picture(*some_pixels))

    in_parts(shade_part, count)
    return picture


#: Rays along each side of a picture by which the visible ground is bounded.
_PROBES = 9


def _ground_in_view(scene: Scene, rays: PixelRays, pose: Pose) -> Float64[np.ndarray, "points 2"]:
    """Points whose convex hull contains the ground that a picture can show.

    The ground lies between two planes: a ray ends at the lower one; one that never meets it ends where the mesh does.
    """
    columns, rows = rays.size
    probes = np.ix_(np.linspace(0, rows - 1, _PROBES).astype(int), np.linspace(0, columns - 1, _PROBES).astype(int))
    directions = rays.directions.reshape(rows, columns, 3)[probes].reshape(-1, 3) @ pose.rotation.T
    position = pose.position
    low, high = scene.height_range_m
    farthest = 2.0 * scene.mesh_reach_m
    falls = np.minimum(directions[:, 2], -1e-9)
    ends = [np.clip((level - position[2]) / falls, 0.0, farthest) for level in (low, max(high, position[2]))]
    points = np.concatenate([position[:2] + end[:, None] * directions[:, :2] for end in ends])
    # between the probes the border bulges by a small fraction of their span at most
    margin = 0.02 * (points.max(axis=0) - points.min(axis=0)) + 2.0 * scene.mesh_finest_m
    corners = margin * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    return np.asarray((points[:, None] + corners).reshape(-1, 2))


@cache
def process_renderer(backend: Backend) -> Renderer:
    """Return the renderer of this process, created at the first call."""
    return Renderer(backend)
