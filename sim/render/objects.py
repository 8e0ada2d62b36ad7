"""Objects on the ground, as triangles: rocks, rovers, landers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.spatial.transform import RigidTransform

from marsyard.sim.dynamics.rover import RoverParameters, Stance, compute_bogie_pivots, compute_wheel_centres
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render.kernels.hierarchy import Hierarchy, body_spheres, morton_codes, node_boxes, select_facing

#: Triangle numbers are rendered as 24-bit colours; 0 is the ground.
MAX_TRIANGLES = 2**24 - 2


@dataclass(frozen=True)
class Objects:
    """Triangles of bodies in world axes, in contiguous ranges, one per body.

    - normals: unit normals of the smooth surface at the triangles' corners
    - body_of_triangle: number of each triangle's body: row of `albedo`
    - first_triangle: first triangle of each body, and the number of triangles at the end
    - names: identifier of each body, a number that its creator defines: a rock has its number in the rock field; a
      user's mesh has a number from 2^30; rover and hills have negative numbers
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
        """Create bodies with `counts` triangles each; without `spheres`, bounding spheres are computed when needed."""
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
        """Bounding sphere of each body, centred at the centre of its bounding box: centre and radius."""
        return np.asarray(body_spheres(self.triangles, self.first_triangle))

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
        return np.asarray(select_facing(self.triangles, self._triangles_of(is_selected), *apex, apex_radius_m))

    def select(self, is_selected: Bool[np.ndarray, "bodies"]) -> Objects:
        """Return the selected bodies, renumbered."""
        triangles = self._triangles_of(is_selected)
        return self._of_bodies(
            np.take(self.triangles, triangles, axis=0),
            np.take(self.normals, triangles, axis=0),
            np.diff(self.first_triangle)[is_selected],
            self.albedo[is_selected],
            self.names[is_selected],
            self.spheres[is_selected],
        )

    def _triangles_of(self, is_selected: Bool[np.ndarray, "bodies"]) -> Int64[np.ndarray, "selected"]:
        return np.flatnonzero(np.repeat(is_selected, np.diff(self.first_triangle)))

    def hierarchy(self, numbers: Int64[np.ndarray, "selected"]) -> Hierarchy:
        """Build the bounding volume hierarchy of the triangles with these numbers."""
        is_selected = np.zeros(len(self.triangles), dtype=np.bool_)
        is_selected[numbers] = True
        order = self._morton_order[is_selected[self._morton_order]]
        return self.triangles, order, node_boxes(self.triangles, order)

    @cached_property
    def _morton_order(self) -> Int64[np.ndarray, "triangles"]:
        return np.argsort(morton_codes(self.triangles), kind="stable")


def spheres_in_cone(
    spheres: Float64[np.ndarray, "bodies 4"],
    apex: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    half_angle_rad: float,
) -> Bool[np.ndarray, "bodies"]:
    """Select the spheres that intersect a cone."""
    offset, radius = spheres[:, :3] - apex, spheres[:, 3]
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    off_axis = np.arccos(np.clip(offset @ axis / distance, -1.0, 1.0))
    angular_radius = np.where(distance <= radius, np.pi, np.arcsin(np.clip(radius / distance, 0.0, 1.0)))
    return np.asarray(off_axis <= half_angle_rad + angular_radius)


#: Albedo of all rover parts, assumed: dusty bright metal and glass.
ALBEDO = 0.25
#: Identifier of the rover in `names`: rocks have numbers from 0; truth layers use -1 for ground and -2 for sky.
ROVER_NAME = -3
#: Dimensions that affect shadows only, assumed: width of the legs, radius of the mast and thickness of the deck, m;
#: length and width of the body as fractions of those of the deck.
_LEG_M, _MAST_RADIUS_M, _DECK_M, _BODY_FRACTION = 0.05, 0.05, 0.04, (0.65, 0.4)
#: The head: depth, height, width minus the cameras' baseline; distance of its front behind the cameras' centres, m.
_HEAD_M, _BEHIND_M = (0.12, 0.12, 0.12), 0.04
#: Number of sides of the prism that represents a cylinder.
_SIDES = 24
#: The stowed instrument arm, assumed: joints relative to the front edge of the body at the height of the deck, m (x
#: forward, y left, z up); radii of the links and of the instrument turret, and length of the turret, m.
_ARM_JOINTS_M = ((0.06, 0.30, -0.02), (0.20, -0.30, 0.0), (0.22, 0.06, -0.01))
_ARM_RADIUS_M, _TURRET_RADIUS_M, _TURRET_M = 0.025, 0.06, 0.18

Triangles = Float64[np.ndarray, "triangles 3 3"]
Point = Float64[np.ndarray, "3"]


def rover_objects(
    rover: RoverParameters,
    stance: Stance,
    mast: MastGeometry,
    azimuth_rad: float,
    elevation_rad: float,
    baseline_m: float = 0.3,
) -> Objects:
    """Build the rover as one body, with the pose and joint angles of `stance` and the mast at these true angles.

    To add it to the rocks of a scene: ``Objects.join([scene.objects, rover_objects(...)])``. `baseline_m` is the
    baseline of the widest stereo pair; the head is slightly wider.
    """
    length, width = _BODY_FRACTION[0] * rover.body_length_m, _BODY_FRACTION[1] * rover.body_width_m
    x, y, z = mast.base_m
    parts = [
        # body and deck
        _box((length, width, rover.deck_m - rover.clearance_m), (0.0, 0.0, 0.5 * (rover.deck_m + rover.clearance_m))),
        _box((rover.body_length_m, rover.body_width_m, _DECK_M), (0.0, 0.0, rover.deck_m)),
    ]
    # start, end and radius, first of the mast up to the elbow
    cylinders = [(np.array([x, y, rover.deck_m]), np.array([x, y, z + mast.elbow_m[2]]), _MAST_RADIUS_M)]
    shoulder, elbow, wrist = np.array([0.5 * length, 0.0, rover.deck_m]) + np.array(_ARM_JOINTS_M)
    turret = np.array([0.0, 0.5 * _TURRET_M, 0.0])
    cylinders += [(shoulder, elbow, _ARM_RADIUS_M), (elbow, wrist, _ARM_RADIUS_M)]
    cylinders.append((wrist - turret, wrist + turret, _TURRET_RADIUS_M))
    centres = compute_wheel_centres(rover, stance.differential_rad, stance.bogies_rad)
    for side, bogie in enumerate(compute_bogie_pivots(rover, stance.differential_rad)):
        front, middle, rear = centres[3 * side : 3 * side + 3]
        rocker = np.array([rover.rocker_pivot_x_m, bogie[1], rover.rocker_pivot_z_m])
        legs = ((rocker, front), (rocker, bogie), (bogie, middle), (bogie, rear))
        cylinders += [(start, end, 0.5 * _LEG_M) for start, end in legs]
    half_axle = np.array([0.0, 0.5 * rover.wheel_width_m, 0.0])
    cylinders += [(centre - half_axle, centre + half_axle, rover.wheel_radius_m) for centre in centres]
    # camera bar behind the cameras' centres, which lie on the y axis of the head's frame
    depth, height, extra_width = _HEAD_M
    rover_from_head = mast.rover_from_head(azimuth_rad, elevation_rad)
    middle_of_head = (-_BEHIND_M - 0.5 * depth, 0.0, 0.0)
    parts.append(_transform(_box((depth, baseline_m + extra_width, height), middle_of_head), rover_from_head))
    # the elevation axis, from the mast's elbow to the head's middle
    top, end = rover_from_head.apply(np.array([-mast.head_m, middle_of_head]))
    cylinders.append((top, end, _MAST_RADIUS_M))
    triangles = _transform(np.concatenate([*parts, _make_cylinders(cylinders)]), stance.world_from_rover)
    face_normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals = face_normals / np.linalg.norm(face_normals, axis=1, keepdims=True)
    faces = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
    names = np.full(len(triangles), ROVER_NAME, dtype=np.int32)
    return Objects.of_mesh(triangles.reshape(-1, 3), np.repeat(normals, 3, axis=0), faces, names, ALBEDO)


def rover_sphere(
    rover: RoverParameters, stance: Stance, mast: MastGeometry, baseline_m: float = 0.3
) -> Float64[np.ndarray, "1 4"]:
    """Bounding sphere of `rover_objects` for all angles of suspension and mast: centre and radius.

    Its centre is the origin of the rover frame. The links from there to a wheel or to the head may have any angles: the
    sum of their lengths bounds the distance of each part.
    """
    front, middle, rear = compute_wheel_centres(rover, 0.0, (0.0, 0.0))[:3]
    bogie = compute_bogie_pivots(rover, 0.0)[0]
    rocker = np.array([rover.rocker_pivot_x_m, bogie[1], rover.rocker_pivot_z_m])
    wheel = rover.wheel_radius_m + 0.5 * rover.wheel_width_m + _LEG_M
    rear_chain = _length(bogie - rocker) + max(_length(middle - bogie), _length(rear - bogie))
    legs = _length(rocker) + max(_length(front - rocker), rear_chain) + wheel
    depth, height, extra_width = _HEAD_M
    head = _length(_BEHIND_M + depth, 0.5 * (baseline_m + extra_width), 0.5 * height)
    top = _length(mast.base_m) + _length(mast.elbow_m) + _length(mast.head_m) + head + _MAST_RADIUS_M
    body = _length(0.5 * rover.body_length_m, 0.5 * rover.body_width_m, rover.deck_m + _DECK_M)
    return np.array([[*stance.world_from_rover.translation, max(legs, top, body)]])


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


def _length(*components: float | Float64[np.ndarray, "3"]) -> float:
    """Compute the length of a vector with these components."""
    return float(np.linalg.norm(np.hstack(components)))


def _box(size_m: tuple[float, float, float], middle_m: tuple[float, float, float]) -> Triangles:
    """Create a box with edges along the axes."""
    return np.asarray(_unit_box() * np.array(size_m) + np.array(middle_m))


@cache
def _unit_box() -> Triangles:
    import trimesh  # imported at the first use, here and below, because the import is slow

    return np.asarray(trimesh.creation.box().triangles, dtype=np.float64)


@cache
def _unit_cylinder() -> Triangles:
    """Return a cylinder of radius 1 around the z axis from z = 0 to z = 1."""
    import trimesh

    cylinder = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=_SIDES)
    return np.asarray(cylinder.triangles + np.array([0.0, 0.0, 0.5]), dtype=np.float64)


def _make_cylinders(cylinders: list[tuple[Point, Point, float]]) -> Triangles:
    """Create cylinders between the centres of their ends, with these radii."""
    starts, ends = (np.array([cylinder[end] for cylinder in cylinders]) for end in (0, 1))
    radii = np.array([radius for _, _, radius in cylinders])[:, None]
    axes = ends - starts
    x = np.cross(np.eye(3)[np.argmin(np.abs(axes), axis=1)], axes)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(axes / np.linalg.norm(axes, axis=1, keepdims=True), x)
    scaled_axes = np.stack([radii * x, radii * y, axes], axis=1)
    return np.asarray(starts[:, None, None] + _unit_cylinder() @ scaled_axes[:, None]).reshape(-1, 3, 3)


def _transform(triangles: Triangles, new_from_old: RigidTransform) -> Triangles:
    return np.asarray(new_from_old.apply(triangles.reshape(-1, 3))).reshape(-1, 3, 3)
