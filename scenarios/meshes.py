"""User-defined meshes on the ground (rocks, landers, landmarks), in the formats of trimesh.

A mesh appears once per period of the terrain: in images with its shadow, and in the truth (range, bodies, landing site
truth). Triangles are oriented when the file is read, because the winding of files is often inverted or mixed.
"""

import hashlib
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.mesh_orientation import orient_triangles
from marsyard.scenarios.user_files import UserFile
from marsyard.sim.files import check_regular, expanded_bytes, report_damage
from marsyard.sim.render import Objects, Scene
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.terrain import Surface

#: Maximum size of a file, and maximum number of triangles.
MAX_BYTES, MAX_FACES = 1 << 28, 1_000_000
#: Suffixes of archives, which are not supported, and of mesh formats that are zip archives.
_ARCHIVES = frozenset({"zip", "bz2", "gz", "tar.gz", "tar.bz2"})
_ZIPPED = frozenset({"3mf", "3dxml", "zae"})
_NO_MESH = "cannot be read as a mesh"
#: Numbers in an element of a glTF accessor.
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
#: Default albedo by kind: rock, painted structure, bright target.
_ALBEDO = {"rock": 0.15, "lander": 0.5, "landmark": 0.6}
#: Rotations from the file's axes, by the axis that points up, to axes whose z axis points up.
_UPRIGHT = {
    "x": Rotation.from_euler("y", -90.0, degrees=True),
    "y": Rotation.from_euler("x", 90.0, degrees=True),
    "z": Rotation.identity(),
}


class MeshFileError(ValueError):
    """An invalid mesh; the message contains the file, the problem, and the allowed values."""


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
        ground = float(surface.height(position[0], position[1]))
        corners = corners + np.array([*position, ground - self.sink_m - float(corners[:, 2].min())])
        if self.kind != "rock":  # normals of the faces
            first, second, third = np.moveaxis(corners.reshape(-1, 3, 3), 1, 0)
            normals = np.cross(second - first, third - first)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0).repeat(3, axis=0)
        faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        body_numbers = np.full(len(faces), FIRST_MESH_NUMBER, dtype=np.int32)
        return Objects.of_mesh(corners, normals, faces, body_numbers, self.albedo or _ALBEDO[self.kind])


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh in the axes and unit of its file.

    - triangles: corners, counter-clockwise seen from outside; those of open surfaces occur on both sides
    - normals: smooth outward normals at the corners
    """

    sha256: str
    triangles: Float64[np.ndarray, "faces 3 3"]
    normals: Float64[np.ndarray, "faces 3 3"]


def add_meshes(scene: Scene, meshes: Sequence[MeshParameters], point: tuple[float, float]) -> Scene:
    """Add meshes to a scene, each at its periodic position nearest to a point (x, y)."""
    if not meshes:
        return scene
    mesh_objects = Objects.join([mesh.place_on_ground(scene.surface, point) for mesh in meshes])
    return scene.with_objects(Objects.join([scene.objects, mesh_objects]))


def read_mesh(path: str) -> Mesh:
    """Read and check a mesh; cached while its file does not change. Raises MeshFileError."""
    try:
        status = check_regular(path)
    except OSError as error:
        raise MeshFileError(f"{path}: cannot be read ({error.strerror})") from error
    if status.st_size > MAX_BYTES:
        raise MeshFileError(f"{path}: is larger than {MAX_BYTES >> 20} MiB; reduce the number of triangles")
    return _read(path, status.st_mtime_ns)


@lru_cache(maxsize=16)
def _read(path: str, _modified_ns: int) -> Mesh:
    """Read a mesh; the modification time is part of the cache's key."""
    import trimesh

    kind = Path(path).suffix.lower().lstrip(".")
    formats = sorted(set(trimesh.available_formats()) - _ARCHIVES)
    if kind not in formats:
        raise MeshFileError(f"{path}: '.{kind}' is not a supported mesh format; allowed: {', '.join(formats)}")
    # a small file may expand to a mesh that is too large
    size = 0
    with report_damage(path, MeshFileError, _NO_MESH):
        if kind in _ZIPPED:
            size = expanded_bytes(path)
        elif kind in ("glb", "gltf"):
            size = _accessor_bytes(Path(path).read_bytes(), kind)
    if size > MAX_BYTES:
        raise MeshFileError(f"{path}: expands to {size} bytes; allowed: up to {MAX_BYTES >> 20} MiB")
    with report_damage(path, MeshFileError, _NO_MESH):
        digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
        scene = trimesh.load_scene(path, process=False)
        for body in scene.geometry.values():
            corners = np.asarray(getattr(body, "faces", ()), dtype=np.int64)
            if corners.size and (corners.shape[1:] != (3,) or corners.min() < 0 or corners.max() >= len(body.vertices)):
                allowed = f"three of the {len(body.vertices)} vertices"
                raise MeshFileError(f"{path}: a face has other corners than {allowed}")
        # the arrays of trimesh are read-only, which rotations do not accept
        triangles = np.array(getattr(scene.to_mesh(), "triangles", np.zeros((0, 3, 3))), dtype=np.float64)
    if len(triangles) == 0:
        raise MeshFileError(f"{path}: contains no triangle")
    if len(triangles) > MAX_FACES:
        raise MeshFileError(f"{path}: contains {len(triangles)} triangles; allowed: up to {MAX_FACES}")
    if not np.all(np.isfinite(triangles)):
        raise MeshFileError(f"{path}: contains a corner that is not finite")
    if not np.ptp(triangles.reshape(-1, 3), axis=0).all():
        raise MeshFileError(f"{path}: is flat; allowed: bodies that extend along all axes")
    oriented, normals = orient_triangles(triangles)
    if len(oriented) == 0:
        raise MeshFileError(f"{path}: contains only triangles without area")
    if len(oriented) > MAX_FACES:
        raise MeshFileError(
            f"{path}: its open surfaces are two-sided, which gives {len(oriented)} triangles; "
            f"allowed: up to {MAX_FACES}; close the surfaces"
        )
    return Mesh(digest, oriented, normals)


def _accessor_bytes(contents: bytes, kind: str) -> int:
    """Return the bytes of all accessors of a glTF file; missing buffers expand to zeros."""
    if kind == "glb":
        (length,) = struct.unpack("<I", contents[12:16])
        contents = contents[20 : 20 + length]
    accessors = json.loads(contents).get("accessors", [])
    # a component has up to 4 bytes, an element (a matrix) up to 16 components
    return sum(4 * _COMPONENTS.get(accessor.get("type"), 16) * int(accessor.get("count", 0)) for accessor in accessors)
