"""User-defined meshes on the ground (rocks, landers, landmarks), in the formats of trimesh.

A mesh appears once per period of the terrain: in images with its shadow, and in the truth (range, bodies, landing site
truth). Triangles are oriented when the file is read, because the winding of files is often inverted or mixed.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.mesh_files import read_mesh
from marsyard.scenarios.user_files import UserFile
from marsyard.sim.render import Objects, Scene
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.terrain import Surface

#: Default albedo by kind: rock, painted structure, bright target.
_ALBEDO = {"rock": 0.15, "lander": 0.5, "landmark": 0.6}
#: Rotations from the file's axes, by the axis that points up, to axes whose z axis points up.
_UPRIGHT = {
    "x": Rotation.from_euler("y", -90.0, degrees=True),
    "y": Rotation.from_euler("x", 90.0, degrees=True),
    "z": Rotation.identity(),
}


class MeshParameters(UserFile):
    """A user's mesh, and its position on the ground; its lowest point is `sink_m` below the ground."""

    kind: Annotated[
        Literal["rock", "lander", "landmark"], Field(description="kind of object; rocks have smooth normals")
    ] = "rock"
    east_m: Annotated[float, Field(allow_inf_nan=False, description="position of the origin")] = 0.0
    north_m: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    heading_deg: Annotated[float, Field(ge=-720.0, le=720.0, description="rotation about up, clockwise")] = 0.0
    size_m: Annotated[
        float | None, Field(gt=0.0, le=1000.0, description="maximum horizontal extent; scales the file")
    ] = None
    scale: Annotated[float, Field(gt=0.0, le=1e4, description="metres per unit of the file, without size_m")] = 1.0
    up: Annotated[Literal["x", "y", "z"], Field(description="the file's axis that points up")] = "z"
    sink_m: Annotated[float, Field(ge=-100.0, le=100.0, description="depth of the lowest point below the ground")] = 0.0
    albedo: Annotated[float | None, Field(gt=0.0, lt=1.0, description="default: albedo of the kind")] = None

    @classmethod
    def file_hash(cls, file: str) -> str:
        """Return the SHA-256 of a valid mesh file."""
        return read_mesh(file).sha256

    def place_on_ground(self, surface: Surface, point: tuple[float, float]) -> Objects:
        """Place the mesh on the ground; of its periodic positions, use the nearest to a point (x, y)."""
        mesh = read_mesh(self.file)
        corners = _UPRIGHT[self.up].apply(mesh.triangles.reshape(-1, 3))
        extent = float(np.ptp(corners[:, :2], axis=0).max())
        corners = corners * (self.scale if self.size_m is None else self.size_m / extent)
        heading = Rotation.from_rotvec(np.radians(-self.heading_deg) * np.array([0.0, 0.0, 1.0]))
        corners = heading.apply(corners)
        normals = heading.apply(_UPRIGHT[self.up].apply(mesh.normals.reshape(-1, 3)))
        period = surface.levels[0].shape[0] * surface.spacing_m
        position = np.array([self.east_m, self.north_m])
        position = position + period * np.round((np.array(point) - position) / period)
        ground_m = float(surface.height(*position))
        corners = corners + np.array([*position, ground_m - self.sink_m - float(corners[:, 2].min())])
        if self.kind != "rock":
            normals = _face_normals(corners.reshape(-1, 3, 3)).repeat(3, axis=0)
        faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        body_numbers = np.full(len(faces), FIRST_MESH_NUMBER, dtype=np.int32)
        return Objects.of_mesh(corners, normals, faces, body_numbers, self.albedo or _ALBEDO[self.kind])


def _face_normals(triangles: Float64[np.ndarray, "faces 3 3"]) -> Float64[np.ndarray, "faces 3"]:
    """Return the unit normals of triangles; zero for a triangle without area."""
    first, second, third = np.moveaxis(triangles, 1, 0)
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0))


def add_meshes(scene: Scene, meshes: Sequence[MeshParameters], point: tuple[float, float]) -> Scene:
    """Add meshes to a scene, each at its periodic position nearest to a point (x, y)."""
    if not meshes:
        return scene
    mesh_objects = Objects.join([mesh.place_on_ground(scene.surface, point) for mesh in meshes])
    return scene.with_objects(Objects.join([scene.objects, mesh_objects]))
