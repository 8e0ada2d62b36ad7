"""Objects on the ground, as triangles: rocks, rovers, landers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from marsyard.sim.render.arrays import Values, vectors_to_device
from marsyard.sim.render.cones import spheres_in_cone
from marsyard.sim.render.device import Array3f64
from marsyard.sim.render.triangles import Hierarchy, morton_codes

#: Identifiers of users' meshes start here; identifiers of rocks are smaller.
FIRST_MESH_NUMBER = 2**30
#: Maximum number of triangles of all bodies. A view draws fewer: it numbers the corners with 24 bits (`pinhole`).
MAX_TRIANGLES = 2**24 - 2


@dataclass(frozen=True)
class Objects:
    """Triangles of bodies in world axes, in contiguous ranges, one per body.

    - normals: unit normals of the smooth surface at the triangles' corners
    - body_of_triangle: number of each triangle's body: row of `albedo`
    - first_triangle: first triangle of each body, and the number of triangles at the end
    - names: identifier of each body, a number that its creator defines: a rock has its number in the rock field; a
      user's mesh has a number from 2^30; the rover has a negative number
    - shelter: corners of a convex body that hides the sky from the ground below it (`obstructions.Shelter`), or None
    - unseen_mounds: mounds (see `mounds`) of bodies without triangles: they only hide the sky
    """

    triangles: Float64[np.ndarray, "triangles 3 3"]
    normals: Float64[np.ndarray, "triangles 3 3"]
    body_of_triangle: Int32[np.ndarray, "triangles"]
    first_triangle: Int64[np.ndarray, "bodies+1"]
    albedo: Float64[np.ndarray, "bodies"]
    names: Int64[np.ndarray, "bodies"]
    shelter: Float64[np.ndarray, "8 3"] | None = None
    unseen_mounds: Float64[np.ndarray, "mounds 4"] = field(default_factory=lambda: np.empty((0, 4)))

    @classmethod
    def of_mesh(
        cls,
        vertices: Float64[np.ndarray, "vertices 3"],
        vertex_normals: Float64[np.ndarray, "vertices 3"],
        faces: Int32[np.ndarray, "triangles 3"],
        name_of_face: Int32[np.ndarray, "triangles"],
        albedo: float | Float64[np.ndarray, "names"],
        body_of_face: Int32[np.ndarray, "triangles"] | None = None,
    ) -> Objects:
        """Build bodies from a mesh: contiguous faces of one name, or of one number in `body_of_face`, are one body.

        `albedo` is common to all bodies, or has one value for each name. Raises ValueError for more than
        `MAX_TRIANGLES` triangles.
        """
        changes = np.flatnonzero(np.diff(name_of_face if body_of_face is None else body_of_face)) + 1
        first = np.concatenate([[0], changes]) if len(faces) else np.empty(0, dtype=np.int64)
        names = np.asarray(name_of_face, dtype=np.int64)[first]
        # np.take is several times faster than indexing for a million triangles
        return cls._of_bodies(
            np.take(np.asarray(vertices, dtype=np.float64), faces, axis=0),
            np.take(np.asarray(vertex_normals, dtype=np.float64), faces, axis=0),
            np.diff(first, append=len(faces)),
            np.full(first.size, albedo) if np.ndim(albedo) == 0 else np.asarray(albedo)[names],
            names,
        )

    @classmethod
    def join(cls, parts: Sequence[Objects]) -> Objects:
        """Join the bodies of several sets; at most one of them has a shelter."""
        shelters = [part.shelter for part in parts if part.shelter is not None]
        if len(shelters) > 1:
            raise ValueError(f"{len(shelters)} sets of objects have a shelter; at most one is possible")
        names = ("triangles", "normals", "albedo", "names", "unseen_mounds", "bounds", "spheres")
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        counts = np.concatenate([np.diff(part.first_triangle) for part in parts])
        return cls._of_bodies(counts=counts, shelter=shelters[0] if shelters else None, **arrays)

    @classmethod
    def _of_bodies(
        cls,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        normals: Float64[np.ndarray, "triangles 3 3"],
        counts: Int64[np.ndarray, "bodies"],
        albedo: Float64[np.ndarray, "bodies"],
        names: Int64[np.ndarray, "bodies"],
        shelter: Float64[np.ndarray, "8 3"] | None = None,
        unseen_mounds: Float64[np.ndarray, "mounds 4"] | None = None,
        **computed: Float64[np.ndarray, "bodies columns"],
    ) -> Objects:
        """Create bodies with `counts` triangles each; `computed` are results (`bounds`, `spheres`) to keep."""
        if len(triangles) > MAX_TRIANGLES:
            raise ValueError(f"{len(triangles)} triangles; at most {MAX_TRIANGLES} can be drawn at once")
        body_of_triangle = np.repeat(np.arange(counts.size, dtype=np.int32), counts)
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        mounds = np.empty((0, 4)) if unseen_mounds is None else unseen_mounds
        objects = cls(triangles, normals, body_of_triangle, first, albedo, names, shelter, mounds)
        objects.__dict__.update(computed)
        return objects

    @classmethod
    def none(cls) -> Objects:
        """Return an empty set."""
        points, faces = np.empty((0, 3)), np.empty((0, 3), np.int32)
        return cls.of_mesh(points, points, faces, np.empty(0, np.int32), albedo=1.0)

    def __len__(self) -> int:
        return len(self.albedo)

    @cached_property
    def bounds(self) -> Float64[np.ndarray, "bodies 6"]:
        """Minimum x, y, z, then maximum x, y, z of each body."""
        if len(self) == 0:
            return np.empty((0, 6))
        a, b, c = (self.triangles[:, corner] for corner in range(3))
        extremes = [
            choose.reduceat(choose(choose(a, b), c), self.first_triangle[:-1]) for choose in (np.minimum, np.maximum)
        ]
        return np.concatenate(extremes, axis=1)

    @cached_property
    def spheres(self) -> Float64[np.ndarray, "bodies 4"]:
        """Bounding sphere of each body, centred at the centre of its bounding box: centre and radius."""
        if len(self) == 0:
            return np.empty((0, 4))
        centres = 0.5 * (self.bounds[:, :3] + self.bounds[:, 3:])
        centre_of_triangle = centres[self.body_of_triangle]
        squares = np.max([np.square(self.triangles[:, k] - centre_of_triangle).sum(axis=1) for k in range(3)], axis=0)
        return np.column_stack([centres, np.sqrt(np.maximum.reduceat(squares, self.first_triangle[:-1]))])

    @property
    def is_rock(self) -> Bool[np.ndarray, "bodies"]:
        """Whether each body is a rock of a rock field."""
        return np.asarray((self.names >= 0) & (self.names < FIRST_MESH_NUMBER))

    @property
    def is_rover(self) -> Bool[np.ndarray, "bodies"]:
        """Mark the bodies of rovers."""
        return np.asarray(self.names < 0)

    @property
    def mounds(self) -> Float64[np.ndarray, "mounds 4"]:
        """Mounds that hide the sky: x, y of the centre, radius, and z of the top.

        They are those of the bodies that stand on the ground (rocks and meshes of users), and `unseen_mounds`.
        """
        return np.concatenate([self._mounds_of(np.ones(len(self), dtype=np.bool_)), self.unseen_mounds])

    def _mounds_of(self, is_selected: Bool[np.ndarray, "bodies"]) -> Float64[np.ndarray, "mounds 4"]:
        bounds = self.bounds[is_selected & (self.names >= 0)]
        low, high = bounds[:, :3], bounds[:, 3:]
        return np.column_stack([0.5 * (low + high)[:, :2], 0.25 * (high - low)[:, :2].sum(axis=1), high[:, 2]])

    def in_cone(
        self,
        apex: Float64[np.ndarray, "3"],
        axis: Float64[np.ndarray, "3"],
        half_angle_rad: float,
        apex_radius_m: float = 0.0,
    ) -> Int64[np.ndarray, "selected"]:
        """Select triangles of bodies whose bounding spheres intersect a cone, if they face a point near its apex.

        Returns their numbers; `apex_radius_m` is the maximum distance of that point from the apex.
        """
        is_selected = spheres_in_cone(self.spheres, apex, axis, half_angle_rad)
        normals, offsets, lengths = (values[is_selected[self.body_of_triangle]] for values in self._planes)
        numbers = self._triangles_of(is_selected)
        return numbers[normals @ apex - offsets + apex_radius_m * lengths > 0.0]

    @cached_property
    def _planes(self) -> tuple[np.ndarray, ...]:
        """Normals of the triangles, their products with a corner, and their lengths."""
        a, b, c = (self.triangles[:, corner] for corner in range(3))
        normals = np.cross(b - a, c - a)
        return normals, np.einsum("na,na->n", normals, a), np.linalg.norm(normals, axis=1)

    def select(
        self, is_selected: Bool[np.ndarray, "bodies"], hides_sky: Bool[np.ndarray, "bodies"] | None = None
    ) -> Objects:
        """Return the selected bodies, renumbered, and the mounds of the other bodies in `hides_sky`."""
        triangles = self._triangles_of(is_selected)
        unseen = np.zeros(len(self), dtype=np.bool_) if hides_sky is None else hides_sky & ~is_selected
        return self._of_bodies(
            np.take(self.triangles, triangles, axis=0),
            np.take(self.normals, triangles, axis=0),
            np.diff(self.first_triangle)[is_selected],
            self.albedo[is_selected],
            self.names[is_selected],
            self.shelter,
            np.concatenate([self.unseen_mounds, self._mounds_of(unseen)]),
            bounds=self.bounds[is_selected],
            spheres=self.spheres[is_selected],
        )

    def _triangles_of(self, is_selected: Bool[np.ndarray, "bodies"]) -> Int64[np.ndarray, "selected"]:
        return np.flatnonzero(np.repeat(is_selected, np.diff(self.first_triangle)))

    def hierarchy(self, numbers: Int64[np.ndarray, "selected"], centre: Float64[np.ndarray, "3"]) -> Hierarchy | None:
        """Build the hierarchy of the triangles with these numbers for rays from near a centre; None without any."""
        if len(numbers) == 0:
            return None
        is_selected = np.zeros(len(self.triangles), dtype=np.bool_)
        is_selected[numbers] = True
        order = self._morton_order[is_selected[self._morton_order]]
        # near triangles first: a hit then excludes all farther ones
        squared_distance = np.square(self.triangles[order, 0] - centre).sum(axis=1)
        order = order[np.argsort(np.frexp(squared_distance)[1], kind="stable")]
        return Hierarchy.build(self.corners, order, centre)

    @cached_property
    def corners(self) -> Values:
        """Corners of all triangles on the device."""
        return vectors_to_device(Array3f64, self.triangles.reshape(-1, 3))

    @cached_property
    def _morton_order(self) -> Int64[np.ndarray, "triangles"]:
        return np.argsort(morton_codes(self.triangles), kind="stable")


def may_cast_shadow(
    spheres: Float64[np.ndarray, "bodies 4"],
    sun_direction: Float64[np.ndarray, "3"],
    position_m: Float64[np.ndarray, "3"],
    radius_m: float,
) -> bool:
    """Return False if bodies in these spheres cannot hide the sun from any point within a radius of a position."""
    offset = spheres[:, :3] - position_m
    along_sun = offset @ sun_direction
    max_distance = spheres[:, 3] + radius_m
    perpendicular = np.linalg.norm(offset - along_sun[:, None] * sun_direction, axis=1)
    return bool(np.any((perpendicular <= max_distance) & (along_sun >= -max_distance)))
