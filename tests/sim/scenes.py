"""Cameras, grounds and objects of the tests of rendering and of sensors."""

from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.render import Frame, Objects, Photometry, PixelRays, Renderer, Scene
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.rocks import RockField

#: Axes of cameras in the body frame: looking down with +x to the right, and looking along +x.
DOWN: dict[str, Any] = {"axis": (0.0, 0.0, -1.0), "right": (1.0, 0.0, 0.0)}
FORWARD: dict[str, Any] = {"axis": (1.0, 0.0, 0.0), "right": (0.0, -1.0, 0.0)}
#: Mesh of the ground for a camera a few metres above it.
NEAR_MESH: dict[str, Any] = {"mesh_finest_m": 0.2, "mesh_half_width_m": 60.0}
#: With this law the radiance is albedo times the cosine of incidence in sunlight, and 0 in shadow.
LAMBERT = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0, surrounding_albedo=0.0)


def descent_camera(size: int = 1024, r: tuple[float, float, float] = (0.00096, -0.002183, 0.018547)) -> Cahvor:
    """Make a descent camera of given size (pixels) and distortion, in the body frame."""
    pinhole = Cahv.from_focal_length(14.67e-3, 12e-6 * 1024 / size, (size, size), **DOWN)
    return Cahvor.from_cahv(pinhole, r=np.array(r))


def make_ground(heights_m: np.ndarray, spacing_m: float, albedo: float = 0.2) -> Surface:
    """Make ground of uniform albedo from control values of the heights."""
    samples = np.stack([heights_m, np.full(heights_m.shape, albedo)], axis=-1).astype(np.float32)
    return Surface.from_samples(samples, spacing_m)


def flat_ground(side: int = 64, spacing_m: float = 8.0, albedo: float = 0.2) -> Surface:
    """Make level ground at height 0."""
    return make_ground(np.zeros((side, side)), spacing_m, albedo)


def rocks_near(field: RockField, x_m: float, y_m: float, radius_m: float, above_m: float, albedo: float) -> Objects:
    """Return the rocks around a position as objects."""
    mesh = field.near(x_m, y_m, radius_m, above_m=above_m)
    return Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, albedo=albedo)


def mesh_body(mesh: trimesh.Trimesh, name: int = 0) -> Objects:
    """Return a closed mesh as a body with this name and the albedo 0.2."""
    names = np.full(len(mesh.faces), name, dtype=np.int32)
    vertices, normals = np.array(mesh.vertices), np.array(mesh.vertex_normals)
    return Objects.of_mesh(vertices, normals, mesh.faces.astype(np.int32), names, albedo=0.2)


def level_plate(name: int, middle_m: float = 8.0) -> Objects:
    """Return a square of 2 m, 0.5 m above the ground, as a body with this name and the albedo 0.2.

    middle_m: x and y of its middle
    """
    low, high = middle_m - 1.0, middle_m + 1.0
    corners = np.array([[low, low, 0.5], [high, low, 0.5], [high, high, 0.5], [low, high, 0.5]])
    faces, names = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), np.full(2, name, dtype=np.int32)
    return Objects.of_mesh(corners, np.tile([0.0, 0.0, 1.0], (4, 1)), faces, names, 0.2)


def look_down(
    renderer: Renderer, scene: Scene, position_m: tuple[float, float, float], field_rad: float, side_px: int
) -> Frame:
    """Render a scene by a camera with a square image that looks down from a position, with x to the right."""
    rays = PixelRays.from_camera(Cahv.from_field_of_view(field_rad, (side_px, side_px), **DOWN))
    return renderer.render(scene, rays, rigid(Rotation.identity(), np.array(position_m)))
