"""Read and check the files of user-defined meshes, in the formats of trimesh."""

import hashlib
import json
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.mesh_orientation import orient_triangles
from marsyard.sim.files import check_regular, expanded_bytes, report_damage

#: Maximum size of a file, bytes, and maximum number of triangles.
MAX_BYTES, MAX_FACES = 1 << 28, 1_000_000
#: Suffixes of archives, which are not supported, and of mesh formats that are zip archives.
_ARCHIVES = frozenset({"zip", "bz2", "gz", "tar.gz", "tar.bz2"})
_ZIPPED = frozenset({"3mf", "3dxml", "zae"})
_NO_MESH = "cannot be read as a mesh"
#: Numbers in an element of a glTF accessor.
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class MeshFileError(ValueError):
    """An invalid mesh; the message contains the file, the problem, and the allowed values."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh in the axes and unit of its file.

    - triangles: corners, counter-clockwise seen from outside; those of open surfaces occur on both sides
    - normals: smooth outward normals at the corners
    """

    sha256: str
    triangles: Float64[np.ndarray, "faces 3 3"]
    normals: Float64[np.ndarray, "faces 3 3"]


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
        # header of 12 bytes, then the length and the type of the first chunk, which contains the JSON text
        length, _ = struct.unpack_from("<II", contents, offset=12)
        contents = contents[20 : 20 + length]
    accessors = json.loads(contents).get("accessors", [])
    # a component has up to 4 bytes, an element (a matrix) up to 16 components
    return sum(4 * _COMPONENTS.get(accessor.get("type"), 16) * int(accessor.get("count", 0)) for accessor in accessors)
