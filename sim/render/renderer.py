"""Radiance and truth of a scene through an exact camera model.

OpenGL draws the depth of the ground in a pinhole view that contains the camera's field. Every pixel's own ray, from the
exact camera model, takes its first guess of distance from that picture, is brought onto the terrain's surface by
Newton's method, and is shaded there. Distortion is therefore exact and not a resampling of a pinhole picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import RigidTransform

from sim.camera import CameraModel
from sim.render.backend import Backend, DepthRenderer, PinholeView, RenderingError
from sim.render.kernels import shade
from sim.render.mesh import graded_offsets, ground_mesh
from sim.render.photometry import Photometry, Sun
from sim.terrain import Surface

#: Samples along each side of the depth picture: a 1024 x 1024 camera of 45 deg is drawn at about its own resolution.
DEPTH_SIDE_PX = 1088
#: Samples left free around the camera's field in the depth picture.
DEPTH_MARGIN_PX = 2.0
#: Widest angle from the optical axis that one pinhole view can hold.
WIDEST_HALF_ANGLE_RAD = np.radians(75.0)


@dataclass(frozen=True)
class Scene:
    """Ground and light.

    Attributes
    ----------
    surface
        The terrain.
    centre_m
        World x, y around which the mesh is dense.
    sun, photometry
        The light, and how the ground scatters it.
    mesh_finest_m, mesh_reach_m, mesh_lines
        Spacing of the mesh at the centre, how far it reaches to each side, and the number of its lines.
    """

    surface: Surface
    centre_m: tuple[float, float]
    sun: Sun
    photometry: Photometry
    mesh_finest_m: float = 12.0
    mesh_reach_m: float = 20000.0
    mesh_lines: int = 513


@dataclass(frozen=True)
class PixelRays:
    """Every pixel's ray in body axes, and the pinhole view that contains them all.

    Attributes
    ----------
    centre
        Centre of projection in the body frame, metres; for CAHVORE the mean of the moving entrance pupil.
    origins, directions
        Rays relative to `centre`, shape (rows * columns, 3), float32; directions are unit vectors.
    size
        Columns and rows.
    pixel_angle_rad
        Mean angle between neighbouring pixels' rays.
    view_from_body
        Rotation matrix from body axes to those of the pinhole view.
    focal_px
        Focal length of the pinhole view.
    """

    centre: Float64[np.ndarray, "3"]
    origins: Float32[np.ndarray, "pixels 3"]
    directions: Float32[np.ndarray, "pixels 3"]
    size: tuple[int, int]
    pixel_angle_rad: float
    view_from_body: Float64[np.ndarray, "3 3"]
    focal_px: float

    @classmethod
    def of(cls, camera: CameraModel) -> PixelRays:
        """The rays of this camera, given in the body frame. Raises RenderingError for too wide a field."""
        columns, rows = camera.size
        u, v = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
        origins, directions = camera.rays(np.stack([u, v], axis=-1))
        origins = np.broadcast_to(origins, directions.shape)
        if not np.isfinite(directions).all():
            raise RenderingError("the camera model has pixels without a ray")
        centre = origins.reshape(-1, 3).mean(axis=0)
        view_from_body = _view_axes(directions)
        in_view = directions.reshape(-1, 3) @ view_from_body.T
        widest = float(np.arccos(in_view[:, 2].min()))
        if widest > WIDEST_HALF_ANGLE_RAD:
            raise RenderingError(
                f"the camera sees {np.degrees(widest):.0f} deg from its axis; "
                f"at most {np.degrees(WIDEST_HALF_ANGLE_RAD):.0f} deg can be drawn"
            )
        extent = np.abs(in_view[:, :2] / in_view[:, 2:]).max()
        neighbours = np.linalg.norm(np.diff(directions, axis=1), axis=-1).mean()
        return cls(
            centre=centre,
            origins=(origins - centre).reshape(-1, 3).astype(np.float32),
            directions=directions.reshape(-1, 3).astype(np.float32),
            size=(columns, rows),
            pixel_angle_rad=float(neighbours),
            view_from_body=view_from_body,
            focal_px=float((DEPTH_SIDE_PX / 2.0 - DEPTH_MARGIN_PX) / extent),
        )


def _view_axes(directions: Float64[np.ndarray, "rows columns 3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows: right, down and forward of the pinhole view in body axes."""
    corners = directions[[0, 0, -1, -1], [0, -1, 0, -1]]
    forward = corners.mean(axis=0)
    forward /= np.linalg.norm(forward)
    right = corners[1] + corners[3] - corners[0] - corners[2]
    right -= forward * (right @ forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


@dataclass(frozen=True)
class Frame:
    """A picture without detector, and its truth.

    Attributes
    ----------
    radiance
        Radiance factor (I/F), shape (rows, columns).
    range_m
        Distance from each pixel's ray origin to the ground along the ray, infinite where it meets none.
    world_from_body
        Pose of the body at the exposure.
    rays
        The camera's rays in the body frame.
    """

    radiance: Float32[np.ndarray, "rows columns"]
    range_m: Float64[np.ndarray, "rows columns"]
    world_from_body: RigidTransform
    rays: PixelRays

    def points_world(self) -> Float64[np.ndarray, "rows columns 3"]:
        """World point seen by each pixel, metres; NaN where it sees no ground."""
        along = np.where(np.isfinite(self.range_m), self.range_m, np.nan).reshape(-1, 1)
        points_body = self.rays.centre + self.rays.origins + along * self.rays.directions.astype(np.float64)
        points: Float64[np.ndarray, "pixels 3"] = self.world_from_body.apply(points_body)
        return points.reshape(*self.radiance.shape, 3)


class Renderer:
    """Renders scenes through cameras. One per process, made inside the worker that uses it.

    Parameters
    ----------
    backend
        Which library provides the OpenGL context.
    """

    def __init__(self, backend: Backend) -> None:
        self._depth = DepthRenderer(DEPTH_SIDE_PX, backend)
        self._loaded: Scene | None = None

    def description(self) -> str:
        """Renderer and version strings of OpenGL."""
        return self._depth.description()

    def render(self, scene: Scene, rays: PixelRays, world_from_body: RigidTransform) -> Frame:
        """The picture of the scene from this pose.

        Parameters
        ----------
        scene
            Ground and light; its mesh stays loaded until another scene is asked for.
        rays
            The camera in the body frame, `PixelRays.of(camera)`.
        world_from_body
            Pose of the body.

        Raises
        ------
        RenderingError
            The camera is at or below the ground.
        """
        if self._loaded is not scene:
            self._load(scene)
        position = world_from_body.apply(rays.centre)
        ground_from_camera = position[2] - float(scene.surface.height(position[0], position[1]))
        if ground_from_camera <= 0.0:
            raise RenderingError(f"the camera is {-ground_from_camera:.2f} m below the ground at {position}")
        rotation = world_from_body.rotation.as_matrix()
        depth = self._depth.draw(self._view(scene, rays, rotation, position, ground_from_camera))
        columns, rows = rays.size
        radiance = np.empty(rows * columns, dtype=np.float32)
        distance = np.empty(rows * columns, dtype=np.float64)
        shade(
            scene.surface.levels,
            scene.surface.spacing_m,
            depth,
            rays.focal_px,
            rays.view_from_body,
            rotation,
            position,
            rays.origins,
            rays.directions,
            rays.pixel_angle_rad,
            np.asarray(scene.sun.direction, dtype=np.float64),
            _law(scene.photometry),
            radiance,
            distance,
        )
        return Frame(radiance.reshape(rows, columns), distance.reshape(rows, columns), world_from_body, rays)

    def close(self) -> None:
        """Releases the OpenGL context."""
        self._depth.close()

    def _load(self, scene: Scene) -> None:
        offsets = graded_offsets(scene.mesh_reach_m, scene.mesh_finest_m, scene.mesh_lines)
        self._depth.load(ground_mesh(scene.surface, np.asarray(scene.centre_m), offsets))
        self._loaded = scene

    def _view(
        self,
        scene: Scene,
        rays: PixelRays,
        rotation: Float64[np.ndarray, "3 3"],
        position: Float64[np.ndarray, "3"],
        clearance_m: float,
    ) -> PinholeView:
        pose = np.eye(4)
        pose[:3, :3] = rotation @ rays.view_from_body.T
        pose[:3, 3] = position
        # A fifth of the height above the ground below leaves room for any relief in view at descent altitudes.
        return PinholeView(pose, rays.focal_px, near_m=0.2 * clearance_m, far_m=2.0 * scene.mesh_reach_m + clearance_m)


def _law(photometry: Photometry) -> tuple[float, float, float, float, float, float]:
    """The numbers of the photometric law in the order of the kernel, with the surge at the phase of normalisation."""
    surge_norm = 1.0 + photometry.surge_amplitude / (1.0 + np.tan(np.radians(22.5)) / photometry.surge_width)
    return (
        photometry.lunar_share,
        photometry.surge_amplitude,
        photometry.surge_width,
        float(surge_norm),
        photometry.sky_share,
        photometry.sky_radiance,
    )


@cache
def process_renderer(backend: Backend) -> Renderer:
    """The renderer of this process, made when first asked for."""
    return Renderer(backend)
