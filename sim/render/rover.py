"""A rover as an object on the ground: body, wheels, legs, mast and arm, built from boxes and cylinders."""

from functools import cache

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.sim.dynamics.rover import RoverParameters, Stance, compute_bogie_pivots, compute_wheel_centres
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render.objects import Objects

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
    objects = Objects.of_mesh(triangles.reshape(-1, 3), np.repeat(normals, 3, axis=0), faces, names, ALBEDO)
    # the sky is hidden by a frustum from the bottom of the body to the deck; wheels and legs are below the deck
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    bottom = np.column_stack([0.5 * corners * (length, width), np.full(4, rover.clearance_m)])
    deck_size = (rover.body_length_m, rover.body_width_m)
    top = np.column_stack([0.5 * corners * deck_size, np.full(4, rover.deck_m + 0.5 * _DECK_M)])
    return objects.with_shelter(np.asarray(stance.world_from_rover.apply(np.concatenate([bottom, top]))))


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
