"""Radiance and truth of a scene through an exact camera model.

pyrender draws pinhole views that contain the camera's field of view: the depth of the ground, and the numbers of the
object triangles in front of it. They are a first guess for each pixel's ray, which comes from the exact camera model.
The intersection of the ray with the terrain is then solved by Newton's method, or its intersection with the triangle is
computed. The surface is shaded at this point. The camera's distortion is therefore exact.

One ray per pixel causes aliasing at edges of objects, terrain occlusions, the horizon and shadows. These pixels are
traced again by several rays, and their radiance is the mean. Range, body and normal remain those of the ray through the
pixel's centre.
"""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING
from weakref import ref

import drjit as dr
import numpy as np
from jaxtyping import Float32, Int64
from jaxtyping import Float64 as FloatArray
from jaxtyping import Int32 as IntArray
from scipy.spatial.transform import RigidTransform

from marsyard.sim.frames import rotation_matrix
from marsyard.sim.render.arrays import Values, to_device, to_host
from marsyard.sim.render.backend import Backend, RenderingError
from marsyard.sim.render.device import UInt32, description
from marsyard.sim.render.edges import mark_edges, split_rays, trace_subpixel_rays
from marsyard.sim.render.mesh import visible_mesh
from marsyard.sim.render.pixel_rays import VIEW_SIDE_PX, PixelRays
from marsyard.sim.render.primary import MAX_GRAZING_SINE, Hits, Views, trace_primary_rays
from marsyard.sim.render.rays import Pose, Rays
from marsyard.sim.render.scene import Scene
from marsyard.sim.render.shading import Light, ShadedImage, shade
from marsyard.sim.render.shadows import visible_sun
from marsyard.sim.render.spline import Terrain

if TYPE_CHECKING:
    from marsyard.sim.render.pinhole import DepthRenderer

#: Options of glibc's mallopt (malloc.h).
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1
#: Size from which memory is mapped separately: terrains are larger, images are smaller.
_MMAP_THRESHOLD_BYTES = 32 << 20
#: Size of the free end of the heap from which it is returned to the system.
_TRIM_THRESHOLD_BYTES = 1 << 30
#: Number of scenes between returns of freed memory; a return after each scene takes 10 % of a rover case's time.
_TRIM_INTERVAL_SCENES = 16
#: Number of rays along each side of an image (probe rays) that determine the visible ground.
_PROBES = 9
#: Depth of the near clipping plane divided by the height of the camera above the ground.
_NEAR_FRACTION = 0.05
#: Index of rows and columns of an image.
PixelIndex = tuple[slice | Int64[np.ndarray, "n"], slice | Int64[np.ndarray, "n"]]


@dataclass(frozen=True)
class Frame:
    """An image before the detector model, and its ground truth.

    - radiance: radiance factor (I/F)
    - range_m: distance along each pixel's ray from its origin, infinite for the sky
    - body: number of the visible object (row of `Scene.objects`), `GROUND` (-1) or `SKY` (-2)
    - normal: unit normal of the visible surface, world axes; zero for the sky
    - rays: the camera's rays in the body frame
    """

    radiance: Float32[np.ndarray, "rows columns"]
    range_m: FloatArray[np.ndarray, "rows columns"]
    body: IntArray[np.ndarray, "rows columns"]
    normal: Float32[np.ndarray, "rows columns 3"]
    world_from_body: RigidTransform
    rays: PixelRays

    def points_world(self, pixels: PixelIndex = np.s_[:, :]) -> FloatArray[np.ndarray, "*selected 3"]:
        """Return the world points, metres, that the selected pixels see; NaN for the sky.

        `pixels` is an index of rows and columns: slices, or arrays of row and column numbers.
        """
        distance = self.range_m[pixels]
        origins, directions = (
            vectors.reshape(*self.range_m.shape, 3)[pixels].reshape(-1, 3)
            for vectors in (self.rays.origins, self.rays.directions)
        )
        finite_distance = np.where(np.isfinite(distance), distance, np.nan).reshape(-1, 1)
        points_body = self.rays.centre + origins + finite_distance * directions.astype(np.float64)
        return np.asarray(self.world_from_body.apply(points_body)).reshape(*distance.shape, 3)


class Renderer:
    """Renderer of scenes through cameras. Create one per process, in the process that uses it."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._views: dict[int, DepthRenderer] = {}
        # not the scene itself, whose terrain would stay in memory while the next one is built
        self._last_scene: ref[Scene] | None = None
        self._scene_count = 0
        keep_freed_memory()

    def description(self) -> str:
        """Renderer and version strings of OpenGL, and the version of the compiler of the device."""
        return f"{self._view_renderer(VIEW_SIDE_PX).description()} / {description()}"

    def render(self, scene: Scene, rays: PixelRays, world_from_body: RigidTransform, time_s: float = 0.0) -> Frame:
        """Render the scene through a camera in the body frame, with the clouds at their positions at this time.

        Raises RenderingError if the camera is at or below the ground.
        """
        rotation, position = rotation_matrix(world_from_body), world_from_body.apply(rays.centre)
        clearance = position[2] - float(scene.surface.height(position[0], position[1]))
        if clearance <= 0.0:
            raise RenderingError(f"the camera is {-clearance:.2f} m below the ground at {position}")
        # a margin of one pixel for the subpixel rays of the pixels at the image's border
        half_angle_rad = rays.half_angle_rad + rays.pixel_rad
        numbers = scene.objects.in_cone(
            position, rotation @ rays.axis, half_angle_rad, apex_radius_m=rays.origin_radius_m
        )
        self._free_memory_of_last_scene(scene)
        views = self._draw_views(scene, rays, rotation, position, clearance, numbers)
        highest_ray = np.arcsin(np.clip((rotation @ rays.axis)[2], -1.0, 1.0)) + rays.half_angle_rad
        is_grazing = bool(np.sin(min(highest_ray, 0.5 * np.pi)) > -MAX_GRAZING_SINE)
        # height bounds save time only for rays almost parallel to the ground
        terrain = scene.terrain_with_ceilings if is_grazing else scene.terrain
        tree, light = scene.objects.hierarchy(numbers, position), scene.light(time_s)
        pose, extent = Pose.of(rotation, position), scene.extent
        hits = trace_primary_rays(terrain, extent, views, pose, rays.device_rays, tree, is_grazing)
        image = shade_hits(scene, light, terrain, pose, rays.device_rays, hits)
        radiance, body, range_m = to_host(image.radiance), to_host(image.body), to_host(hits.distance)
        columns, rows = rays.size
        size, side = (UInt32(columns), UInt32(rows)), scene.edge_rays
        edge_pixels = np.flatnonzero(to_host(mark_edges(image, hits.distance, *size))) if side > 1 else np.empty(0)
        if len(edge_pixels) > 0:
            pixel, subpixel_rays = supersample_rays(rays, edge_pixels, side)
            geometry = terrain, extent, pose, tree
            subpixel_hits = trace_subpixel_rays(*geometry, *size, pixel, subpixel_rays, hits)
            subpixels = to_host(shade_hits(scene, light, terrain, pose, subpixel_rays, subpixel_hits).radiance)
            radiance[edge_pixels] = subpixels.reshape(len(edge_pixels), -1).mean(axis=1)
        radiance, body, range_m = (layer.reshape(rows, columns) for layer in (radiance, body, range_m))
        return Frame(radiance, range_m, body, to_host(image.normal).reshape(rows, columns, 3), world_from_body, rays)

    def _free_memory_of_last_scene(self, scene: Scene) -> None:
        """Free the memory that Dr.Jit keeps for further images: now if the scene is new, and when it is deleted."""
        if self._last_scene is not None and self._last_scene() is scene:
            return
        # the next terrain is built without this memory
        self._last_scene = ref(scene, lambda _: dr.flush_malloc_cache())
        self._scene_count += 1
        dr.flush_malloc_cache()
        if self._scene_count % _TRIM_INTERVAL_SCENES == 0:
            return_freed_memory()

    def _view_renderer(self, side_px: int) -> DepthRenderer:
        if side_px not in self._views:
            self._views[side_px] = create_depth_renderer(side_px, self._backend)
        return self._views[side_px]

    def _draw_views(
        self,
        scene: Scene,
        rays: PixelRays,
        rotation: FloatArray[np.ndarray, "3 3"],
        position: FloatArray[np.ndarray, "3"],
        clearance_m: float,
        numbers: Int64[np.ndarray, "triangles"],
    ) -> Views:
        """Draw the pinhole views by pyrender: the ground, and the triangles of objects with these numbers.

        `rotation` and `position` are the camera's pose, `clearance_m` is the height of the camera above the ground.
        """
        columns, rows = rays.size
        probes = np.ix_(np.linspace(0, rows - 1, _PROBES).astype(int), np.linspace(0, columns - 1, _PROBES).astype(int))
        directions = rays.directions.reshape(rows, columns, 3)[probes].reshape(-1, 3) @ rotation.T
        vertices, faces = visible_mesh(scene, position, directions)
        renderer = self._view_renderer(rays.view_side_px)
        renderer.load(vertices, faces, scene.objects.triangles[numbers], numbers)
        images = []
        for view_from_body, focal in zip(rays.view_from_body, rays.focal_px, strict=True):
            world_from_view = np.eye(4)
            world_from_view[:3, :3] = rotation @ view_from_body.T
            world_from_view[:3, 3] = position
            # nearer surfaces are clipped; the depth is only a first guess, so its low resolution at large distances has
            # no effect on the image
            near, far = _NEAR_FRACTION * clearance_m, 2.0 * scene.mesh_half_width_m + clearance_m
            images.append(renderer.draw(world_from_view, float(focal), near, far))
        # a single view is not copied
        depth, ids = (maps[0][np.newaxis] if len(maps) == 1 else np.stack(maps) for maps in zip(*images, strict=True))
        return Views.of(depth, ids, rays)


def shade_hits(scene: Scene, light: Light, terrain: Terrain, pose: Pose, rays: Rays, hits: Hits) -> ShadedImage:
    """Compute radiance, body and normal at the hits of rays."""
    geometry, materials = (terrain, pose, rays, hits), scene.materials
    corner_normals = None if materials.objects is None else materials.objects.corner_normals
    visible = visible_sun(*geometry, light.sun, light.sun_radius, scene.occluders, corner_normals)
    return shade(*geometry, light, visible, materials)


def supersample_rays(rays: PixelRays, pixels: Int64[np.ndarray, "pixels"], side: int) -> tuple[Values, Rays]:
    """Compute `side` x `side` rays in each of these pixels, and the pixel of each ray."""
    columns, rows = rays.size
    pixel = to_device(UInt32, np.repeat(pixels, side**2))
    ray_in_pixel = to_device(UInt32, np.tile(np.arange(side**2), len(pixels)))
    return pixel, split_rays(rays.device_rays, UInt32(columns), UInt32(rows), pixel, ray_in_pixel, UInt32(side))


def create_depth_renderer(side_px: int, backend: Backend) -> DepthRenderer:
    """Create a renderer of square depth images with `side_px` rows, and its OpenGL context.

    Raises RenderingError if no context can be created.
    """
    if not __debug__:
        raise RenderingError("pyrender calls OpenGL inside assert statements: run Python without -O")
    current = os.environ.get("PYOPENGL_PLATFORM")
    if "OpenGL" in sys.modules and current != backend:
        raise RenderingError(
            f"this process already uses OpenGL through {current}; a process can use one backend: "
            f"start another process for {backend}"
        )
    os.environ["PYOPENGL_PLATFORM"] = backend
    try:
        from marsyard.sim.render.pinhole import DepthRenderer
    # PyOpenGL raises AttributeError for the functions of a missing library
    except (ImportError, AttributeError, OSError) as error:
        raise RenderingError(
            f"OpenGL through {backend} cannot be loaded ({error}); run 'marsyard doctor' to see what is missing"
        ) from error
    try:
        return DepthRenderer(side_px)
    except Exception as error:
        raise RenderingError(
            f"no OpenGL context through {backend} ({error}); run 'marsyard doctor' to see what is missing"
        ) from error


@cache
def process_renderer(backend: Backend) -> Renderer:
    """Return the renderer of this process, created at the first call."""
    return Renderer(backend)


def keep_freed_memory() -> None:
    """Configure glibc to reuse the memory of freed images; this saves 4 % of the run time of a descent case."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _TRIM_THRESHOLD_BYTES)


def return_freed_memory() -> None:
    """Return freed memory to the system; otherwise the memory of the process grows by about 1 MB per scene."""
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if malloc_trim is not None:
        malloc_trim(0)
