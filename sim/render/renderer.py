"""Radiance and truth of a scene through an exact camera model.

OpenGL draws what is seen in pinhole views that contain the camera's field: the depth of the ground and the numbers of
the triangles before it. Every pixel's own ray, from the exact camera model, takes its first guess from these pictures,
is brought onto the terrain's surface by Newton's method or onto its triangle by intersection, and is shaded there.
Distortion is therefore exact and not a resampling of a pinhole picture.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from marsyard.sim.frames import turn_matrix
from marsyard.sim.render.backend import Backend, DepthRenderer, PinholeView, RenderingError
from marsyard.sim.render.edges import edge_pixels, rays_within
from marsyard.sim.render.heap import keep_freed_memory, return_freed_memory
from marsyard.sim.render.kernels.edges import trace_subpixel_rays
from marsyard.sim.render.kernels.primary import GRAZING, trace_primary_rays
from marsyard.sim.render.kernels.shading import shade
from marsyard.sim.render.kernels.structs import Ground, Hits, Light, Picture, Pose, Rays, Views
from marsyard.sim.render.mesh import cells_in_hull, ground_mesh, lines_in_view
from marsyard.sim.render.pyramid import ground_struct
from marsyard.sim.render.rays import VIEW_SIDE_PX, PixelRays
from marsyard.sim.render.scene import Scene
from marsyard.sim.render.threads import in_parts


@dataclass(frozen=True)
class Frame:
    """A picture without detector, and its truth.

    Attributes
    ----------
    radiance
        Radiance factor (I/F), shape (rows, columns).
    range_m
        Distance from each pixel's ray origin to what it sees along the ray, infinite for the sky.
    body
        Number of the object seen (row of `Scene.objects`), `GROUND` (-1) or `SKY` (-2).
    normal
        Unit normal of the surface seen, world axes; zero for the sky.
    world_from_body
        Pose of the body at the exposure.
    rays
        The camera's rays in the body frame.
    """

    radiance: Float32[np.ndarray, "rows columns"]
    range_m: Float64[np.ndarray, "rows columns"]
    body: Int32[np.ndarray, "rows columns"]
    normal: Float32[np.ndarray, "rows columns 3"]
    world_from_body: RigidTransform
    rays: PixelRays

    def points_world(self, step_px: int = 1) -> Float64[np.ndarray, "m n 3"]:
        """World point seen by each pixel of every so many rows and columns, metres; NaN where it sees the sky."""
        kept = (slice(None, None, step_px), slice(None, None, step_px))
        distance = self.range_m[kept]
        origins = self.rays.origins.reshape(*self.range_m.shape, 3)[kept].reshape(-1, 3)
        directions = self.rays.directions.reshape(*self.range_m.shape, 3)[kept].reshape(-1, 3)
        along = np.where(np.isfinite(distance), distance, np.nan).reshape(-1, 1)
        points_body = self.rays.centre + origins + along * directions.astype(np.float64)
        points: Float64[np.ndarray, "pixels 3"] = self.world_from_body.apply(points_body)
        return points.reshape(*distance.shape, 3)


#: Scenes after which their freed memory goes back to the system. What goes back has to be asked for again, a page at a
#: time: after every scene that was a tenth of a rover's run.
_SCENES_KEPT = 16


class Renderer:
    """Renders scenes through cameras. One per process, made inside the worker that uses it.

    Parameters
    ----------
    backend
        Which library provides the OpenGL context.
    """

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
        """The picture of the scene from this pose at this time.

        Parameters
        ----------
        scene
            Ground, objects and light; what the picture shows of them is drawn.
        rays
            The camera in the body frame, `PixelRays.of(camera)`.
        world_from_body
            Pose of the body.
        time_s
            Where the clouds have drifted to; all else stands still.

        Raises
        ------
        RenderingError
            The camera is at or below the ground.
        """
        pose = Pose(turn_matrix(world_from_body), world_from_body.apply(rays.centre))
        clearance = pose.position[2] - float(scene.surface.height(pose.position[0], pose.position[1]))
        if clearance <= 0.0:
            raise RenderingError(f"the camera is {-clearance:.2f} m below the ground at {pose.position}")
        self._load(scene, rays, pose)
        views = self._draw(scene, rays, pose, clearance)
        columns, rows = rays.size
        highest_ray = np.arcsin(np.clip((pose.rotation @ rays.axis)[2], -1.0, 1.0)) + rays.half_angle_rad
        flat = bool(np.sin(min(highest_ray, 0.5 * np.pi)) > -GRAZING)
        ground = ground_struct(scene.surface, scene.extent_m, ceilings=flat)
        hits, light = _room_for_hits(rows * columns, scene), scene.light(time_s)

        def trace(part: slice) -> None:
            seen = views._replace(view_of_pixel=rays.view_of_pixel[part])
            trace_primary_rays(
                ground, seen, pose, Rays(*_part(rays.rays, part)), scene.objects.hierarchy, Hits(*_part(hits, part))
            )

        in_parts(trace, rows * columns)
        picture = _shade(scene, ground, pose, rays.rays, hits, light)
        frame = Frame(
            picture.radiance.reshape(rows, columns),
            hits.distance.reshape(rows, columns),
            picture.body.reshape(rows, columns),
            picture.normal.reshape(rows, columns, 3),
            world_from_body,
            rays,
        )
        if scene.edge_rays > 1:
            pixels = edge_pixels(frame.radiance, frame.range_m, frame.body)
            within = rays_within(rays, pixels, scene.edge_rays)
            met = _room_for_hits(len(within.directions), scene)
            trace_subpixel_rays(ground, pose, scene.objects.hierarchy, columns, pixels, within, hits, met)
            finer = _shade(scene, ground, pose, within, met, light).radiance
            picture.radiance[pixels] = finer.reshape(len(pixels), scene.edge_rays**2).mean(axis=1)
        return frame

    def close(self) -> None:
        """Releases the OpenGL contexts."""
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
        places = _ground_in_view(scene, rays, pose)
        (west, south), (east, north) = places.min(axis=0), places.max(axis=0)
        x = lines_in_view(scene.centre_m[0] + scene.mesh_offsets, west, east)
        y = lines_in_view(scene.centre_m[1] + scene.mesh_offsets, south, north)
        numbers = scene.objects.in_cone(pose.position, pose.rotation @ rays.axis, rays.half_angle_rad)
        ground = ground_mesh(scene.surface, x, y, cells_in_hull(x, y, places))
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
            # A twentieth of the height above the ground leaves room for relief and objects before the camera; depth is
            # only the first guess, so that its coarseness far away does no harm.
            far = 2.0 * scene.mesh_reach_m + clearance_m
            drawn.append(renderer.draw(PinholeView(world_from_view, float(focal), 0.05 * clearance_m, far)))
        # one view, the usual case, is not copied
        depth, numbers = (
            pictures[0][np.newaxis] if len(pictures) == 1 else np.stack(pictures)
            for pictures in zip(*drawn, strict=True)
        )
        return Views(depth, numbers, rays.focal_px, rays.view_from_body, rays.view_of_pixel)


def _room_for_hits(count: int, scene: Scene) -> Hits:
    """Arrays for what so many rays meet."""
    weighed = count if len(scene.objects) > 0 else 0
    return Hits(
        np.empty(count), np.empty(count, np.int32), np.empty((weighed, 2), np.float32), np.empty(count, np.int8)
    )


def _part(arrays: Iterable[NDArray[Any]], part: slice) -> list[NDArray[Any]]:
    return [array[part] for array in arrays]


def _shade(scene: Scene, ground: Ground, pose: Pose, rays: Rays, hits: Hits, light: Light) -> Picture:
    """Radiance factor, body's number and normal of what rays meet."""
    count = len(rays.directions)
    picture = Picture(np.empty(count, np.float32), np.empty(count, np.int32), np.empty((count, 3), np.float32))
    occluders, materials = scene.occluders, scene.materials

    def shade_part(part: slice) -> None:
        some_rays, some_hits, some_pixels = (_part(arrays, part) for arrays in (rays, hits, picture))
        shade(ground, pose, Rays(*some_rays), Hits(*some_hits), light, occluders, materials, Picture(*some_pixels))

    in_parts(shade_part, count)
    return picture


#: Rays along each side of a picture from which the ground that it shows is found.
_PROBES = 9


def _ground_in_view(scene: Scene, rays: PixelRays, pose: Pose) -> Float64[np.ndarray, "places 2"]:
    """Places whose convex hull holds the ground that a picture can show.

    The ground lies between two planes; a ray that meets the lower one has seen nothing beyond. A ray that never does
    sees as far as the mesh reaches.
    """
    columns, rows = rays.size
    probes = np.ix_(np.linspace(0, rows - 1, _PROBES).astype(int), np.linspace(0, columns - 1, _PROBES).astype(int))
    directions = rays.directions.reshape(rows, columns, 3)[probes].reshape(-1, 3) @ pose.rotation.T
    position = pose.position
    low, high = scene.height_range_m
    farthest = 2.0 * scene.mesh_reach_m
    falls = np.minimum(directions[:, 2], -1e-9)
    ends = [np.clip((level - position[2]) / falls, 0.0, farthest) for level in (low, max(high, position[2]))]
    places = np.concatenate([position[:2] + end[:, None] * directions[:, :2] for end in ends])
    # between the probes the border bulges by at most a part of what they span
    margin = 0.02 * (places.max(axis=0) - places.min(axis=0)) + 2.0 * scene.mesh_finest_m
    corners = margin * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    return np.asarray((places[:, None] + corners).reshape(-1, 2))


@cache
def process_renderer(backend: Backend) -> Renderer:
    """The renderer of this process, made when first asked for."""
    return Renderer(backend)
