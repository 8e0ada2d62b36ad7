"""Objects on the ground, as triangles: rocks, rovers, landers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from marsyard.sim.render.kernels.hierarchy import Hierarchy, body_spheres, morton_codes, node_boxes, select_facing

#: Triangle numbers are drawn as colours of 24 bits, of which 0 is the ground.
MAX_TRIANGLES = 2**24 - 2


@dataclass(frozen=True)
class Objects:
    """Triangles of bodies in world axes, in contiguous ranges, one per body.

    - normals: unit normals of the smooth surface at the triangles' corners
    - body_of_triangle: number of each triangle's body: row of `albedo`
    - first_triangle: first triangle of each body, and the number of triangles at the end
    - names: number by which the creator of each body identifies it, as a rock's number in its field
    """

    triangles: Float64[np.ndarray, "triangles 3 3"]
    normals: Float64[np.ndarray, "triangles 3 3"]
    body_of_triangle: Int32[np.ndarray, "triangles"]
    first_triangle: Int64[np.ndarray, "bodies+1"]
    albedo: Float64[np.ndarray, "bodies"]
    names: Int64[np.ndarray, "bodies"]

    @classmethod
    def of_mesh(
        cls,
        vertices: Float64[np.ndarray, "vertices 3"],
        vertex_normals: Float64[np.ndarray, "vertices 3"],
        faces: Int32[np.ndarray, "triangles 3"],
        name_of_face: Int32[np.ndarray, "triangles"],
        albedo: float,
        body_of_face: Int32[np.ndarray, "triangles"] | None = None,
    ) -> Objects:
        """Build bodies of one albedo from a mesh: contiguous faces of one name, or of one `body_of_face`, are one body.

        Raises ValueError for more triangles than a picture can number.
        """
        changes = np.flatnonzero(np.diff(name_of_face if body_of_face is None else body_of_face)) + 1
        first = np.concatenate([[0], changes]) if len(faces) else np.empty(0, dtype=np.int64)
        # np.take is several times faster than indexing for a scene's million triangles
        return cls._of_bodies(
            np.take(np.asarray(vertices, dtype=np.float64), faces, axis=0),
            np.take(np.asarray(vertex_normals, dtype=np.float64), faces, axis=0),
            np.diff(first, append=len(faces)),
            np.full(first.size, float(albedo)),
            np.asarray(name_of_face, dtype=np.int64)[first],
        )

    @classmethod
    def joined(cls, parts: Sequence[Objects]) -> Objects:
        """Join the bodies of several sets."""
        names = ("triangles", "normals", "albedo", "names", "spheres")
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls._of_bodies(counts=np.concatenate([np.diff(part.first_triangle) for part in parts]), **arrays)

    @classmethod
    def _of_bodies(
        cls,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        normals: Float64[np.ndarray, "triangles 3 3"],
        counts: Int64[np.ndarray, "bodies"],
        albedo: Float64[np.ndarray, "bodies"],
        names: Int64[np.ndarray, "bodies"],
        spheres: Float64[np.ndarray, "bodies 4"] | None = None,
    ) -> Objects:
        """Number bodies of so many triangles; known spheres are not computed again for thousands of rocks."""
        if len(triangles) > MAX_TRIANGLES:
            raise ValueError(f"{len(triangles)} triangles; at most {MAX_TRIANGLES} can be drawn at once")
        body_of_triangle = np.repeat(np.arange(counts.size, dtype=np.int32), counts)
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        objects = cls(triangles, normals, body_of_triangle, first, albedo, names)
        if spheres is not None:
            objects.__dict__["spheres"] = spheres
        return objects

    @classmethod
    def none(cls) -> Objects:
        """Return an empty set."""
        points, faces = np.empty((0, 3)), np.empty((0, 3), np.int32)
        return cls.of_mesh(points, points, faces, np.empty(0, np.int32), albedo=1.0)

    def __len__(self) -> int:
        return len(self.albedo)

    @cached_property
    def spheres(self) -> Float64[np.ndarray, "bodies 4"]:
        """Centre and radius of a sphere around each body, about the centre of its bounding box."""
        return np.asarray(body_spheres(self.triangles, self.first_triangle))

    def in_cone(
        self, apex: Float64[np.ndarray, "3"], axis: Float64[np.ndarray, "3"], half_angle_rad: float
    ) -> Int64[np.ndarray, "kept"]:
        """Numbers of the triangles that face a cone's apex, of all bodies whose spheres reach into the cone."""
        kept = spheres_in_cone(self.spheres, apex, axis, half_angle_rad)
        return np.asarray(select_facing(self.triangles, self._triangles_of(kept), *apex))

    def only(self, kept: Bool[np.ndarray, "bodies"]) -> Objects:
        """Select some of the bodies, which are numbered again."""
        triangles = self._triangles_of(kept)
        return self._of_bodies(
            np.take(self.triangles, triangles, axis=0),
            np.take(self.normals, triangles, axis=0),
            np.diff(self.first_triangle)[kept],
            self.albedo[kept],
            self.names[kept],
            self.spheres[kept],
        )

    def _triangles_of(self, kept: Bool[np.ndarray, "bodies"]) -> Int64[np.ndarray, "kept"]:
        return np.flatnonzero(np.repeat(kept, np.diff(self.first_triangle)))

    @cached_property
    def hierarchy(self) -> Hierarchy:
        """The bounding volume hierarchy of the triangles."""
        order = np.argsort(morton_codes(self.triangles), kind="stable")
        return self.triangles, order, node_boxes(self.triangles, order)


def spheres_in_cone(
    spheres: Float64[np.ndarray, "bodies 4"],
    apex: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    half_angle_rad: float,
) -> Bool[np.ndarray, "bodies"]:
    """Select the spheres that reach into a cone."""
    away, radius = spheres[:, :3] - apex, spheres[:, 3]
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    off_axis = np.arccos(np.clip(away @ axis / distance, -1.0, 1.0))
    widening = np.where(distance <= radius, np.pi, np.arcsin(np.clip(radius / distance, 0.0, 1.0)))
    return np.asarray(off_axis <= half_angle_rad + widening)
