"""A rover as an object on the ground, with the parts that hazard images and its shadow show."""

from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.dynamics.rover import RoverParameters, Stance, compute_bogie_pivots, compute_wheel_centres
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render.objects import Objects

#: Albedo of the deck with its solar cells, of other parts of body and arm, of the wheels, and of the mast, without
#: dust: matt, assumed; dark, because parts do not hide the light of the sky from each other.
ALBEDOS = {"deck": 0.1, "body": 0.09, "wheel": 0.08, "mast": 0.25}
#: Identifier of the rover in `names`: rocks have numbers from 0; truth layers use -1 for ground and -2 for sky.
ROVER_NAME = -3
#: Width of the legs, thickness of the deck, m, assumed; length and width of the body as fractions of those of the deck.
_LEG_M, _DECK_M, _BODY_FRACTION = 0.05, 0.04, (0.58, 0.4)
#: Radius of the mast, m (from its shadow in a hazard image of Opportunity, 1F483288473, accurate to about 30 %).
_MAST_RADIUS_M = 0.028
#: The head: depth, height, width minus the cameras' baseline; distance of its front behind the cameras' centres, m.
_HEAD_M, _BEHIND_M = (0.1, 0.08, 0.08), 0.04
#: Sides of the bottom of the frustum that hides the sky, as a fraction of those of a rectangle around the wheels. Ray
#: casting of all parts (`benchmarks.validation.sky_checks`) asks for less; shadows are as dark as those of flown ones.
_SHELTER_BOTTOM = 0.85
#: Left half of the deck's outline from front to rear, x and y as fractions of half its length and width: the solar
#: panels of MER, with gaps between them (read from drawings of the press kit, accurate to about 5 %).
_OUTLINE = (
    *((0.78, 0.0), (0.78, 0.3), (0.71, 0.3), (0.71, 0.34), (0.75, 0.36), (0.62, 0.62), (0.5, 0.62), (0.53, 0.69)),
    *((0.3, 1.0), (-0.3, 1.0), (-0.43, 0.8), (-0.37, 0.74), (-0.47, 0.74), (-0.8, 0.55), (-1.0, 0.4)),
)
#: Equipment on the deck: start and end (x, y as fractions of half the deck's length and width, height above the deck in
#: m) and radius, m. Base of the mast's deployment drive, low-gain antenna, post and dish (0.28 m, press kit) of the
#: high-gain antenna, UHF antenna, calibration target, and brackets at the front edge; positions assumed.
_EQUIPMENT = (
    *(((0.52, -0.08, 0.0), (0.52, 0.06, 0.14), 0.07), ((-0.4, -0.3, 0.0), (-0.4, -0.3, 0.55), 0.025)),
    *(((0.05, -0.38, 0.0), (0.05, -0.38, 0.28), 0.03), ((0.06, -0.4, 0.3), (0.09, -0.39, 0.32), 0.14)),
    *(((-0.55, 0.3, 0.0), (-0.55, 0.3, 0.25), 0.015), ((-0.3, 0.5, 0.0), (-0.3, 0.5, 0.06), 0.04)),
    *(((0.72, 0.2, 0.0), (0.72, 0.2, 0.06), 0.03), ((0.74, -0.24, 0.0), (0.74, -0.24, 0.04), 0.045)),
    *(((0.5, 0.58, 0.0), (0.5, 0.58, 0.05), 0.03), ((0.36, -0.85, 0.0), (0.36, -0.85, 0.035), 0.05)),
)
#: Small parts along the edge of the deck (connectors, brackets, hinges, ties of cables): their number, minimum and
#: maximum length and radius, m (assumed). They make the edge of the rover's shadow as irregular as on Mars.
_EDGE_PARTS, _EDGE_LENGTH_M, _EDGE_RADIUS_M = 96, (0.01, 0.07), (0.005, 0.03)
#: Number of cleats of a wheel, their height, and radii of rim and hub, as fractions of the wheel's radius; number of
#: spokes. Read from images of MER's wheels, accurate to about 10 %.
_CLEATS, _CLEAT_HEIGHT, _RIM, _HUB, _SPOKES = 20, 0.05, 0.84, 0.3, 6
#: Height of the steering motors above the wheels' centres, in radii; gap between bracket and wheel, m; radius of a
#: bracket divided by that of a leg; sag of the cable along a leg, m; assumed.
_STEERING_HEIGHT, _BRACKET_GAP_M, _BRACKET_RADIUS, _LEG_SAG_M = 1.6, 0.03, 0.7, 0.03
#: Number of sides of the prism that represents a cylinder, and of segments of a cable.
_SIDES, _SEGMENTS = 12, 6
#: The stowed instrument arm, assumed: joints relative to the front edge of the body at the height of the deck, m (x
#: forward, y left, z up); radii of the links and of the instrument turret, and length of the turret, m.
_ARM_JOINTS_M = ((0.05, 0.3, -0.33), (0.042, -0.32, -0.34), (0.06, 0.34, -0.36))
_ARM_RADIUS_M, _TURRET_RADIUS_M, _TURRET_M = 0.016, 0.03, 0.1
#: Cables at the front, relative to the same point: start, end, and how far they hang forward and down, m; their radius.
_CABLES_M = (
    ((0.02, 0.4, -0.3), (0.02, -0.38, -0.28), (0.05, -0.06)),
    ((0.03, 0.36, -0.31), (0.0, -0.42, -0.3), (0.03, -0.05)),
    ((0.06, 0.42, -0.33), (0.05, 0.02, -0.33), (0.02, 0.02)),
    ((0.08, 0.34, -0.36), (0.0, 0.1, -0.3), (0.05, 0.03)),
    ((0.08, -0.4, -0.25), (0.05, 0.05, -0.33), (-0.02, -0.03)),
    ((0.05, -0.3, -0.34), (0.02, -0.5, -0.1), (0.06, -0.05)),
    ((0.05, 0.3, -0.3), (0.02, 0.5, -0.12), (0.08, -0.03)),
)
_CABLE_RADIUS_M = 0.006

#: Position and normal of each corner of each triangle.
Solid = Float64[np.ndarray, "triangles 3 2 3"]
Point = Float64[np.ndarray, "3"]
Cylinder = tuple[Point, Point, float]


def rover_objects(
    rover: RoverParameters,
    stance: Stance,
    mast: MastGeometry,
    azimuth_rad: float,
    elevation_rad: float,
    baseline_m: float = 0.3,
    steering_rad: float = 0.0,
) -> Objects:
    """Build the rover with the pose and joint angles of `stance` and the mast at these true angles.

    Its bodies are deck, body with arm and legs, each wheel, and mast. To add it to the rocks of a scene:
    ``Objects.join([scene.objects, rover_objects(...)])``. `baseline_m` is the baseline of the widest stereo pair; the
    head is slightly wider. `steering_rad` is the angle by which the front wheels are turned to the left.
    """
    centres = compute_wheel_centres(rover, stance.differential_rad, stance.bogies_rad)
    size = np.array([rover.wheel_radius_m, rover.wheel_radius_m, rover.wheel_width_m])
    # the axis of a wheel is y; normals are stretched by the inverse of the size
    wheel = (_unit_wheel() * np.stack([size, 1.0 / size]))[..., [1, 2, 0]]
    wheel[:, :, 1] /= np.linalg.norm(wheel[:, :, 1], axis=2, keepdims=True)
    parts = {
        "deck": [_build_deck(rover)],
        "body": [_build_body(rover, stance)],
        "wheel": [
            _transform(wheel, rigid(Rotation.from_euler("z", steering_rad if wheel_number % 3 == 0 else 0.0), centre))
            for wheel_number, centre in enumerate(centres)
        ],
        "mast": [_build_mast(rover, mast, mast.rover_from_head(azimuth_rad, elevation_rad), baseline_m)],
    }
    bodies = [
        _create_body(_transform(solid, stance.world_from_rover), ALBEDOS[material])
        for material, solids in parts.items()
        for solid in solids
    ]
    # The sky is hidden by a frustum, from a rectangle within the wheels at the body's bottom to one around the deck.
    # Parts outside of it (wheels, arm, equipment) hide about as much as its corners beyond body and panels.
    corners = 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    deck_size = np.array([rover.body_length_m, rover.body_width_m])
    wheels = np.array([rover.front_m + rover.rear_m, 2.0 * rover.half_track_m]) + size[[0, 2]] * (2.0, 1.0)
    wheels *= _SHELTER_BOTTOM
    bottom = np.column_stack([corners * wheels, np.full(4, rover.clearance_m)])
    top = np.column_stack([corners * deck_size, np.full(4, rover.deck_m + 0.5 * _DECK_M)])
    shelter = np.asarray(stance.world_from_rover.apply(np.concatenate([bottom, top])))
    return replace(Objects.join(bodies), shelter=shelter)


def _create_body(solid: Solid, albedo: float) -> Objects:
    """Create one body."""
    faces = np.arange(3 * len(solid), dtype=np.int32).reshape(-1, 3)
    names = np.full(len(solid), ROVER_NAME, dtype=np.int32)
    points, normals = (solid[:, :, k].reshape(-1, 3) for k in (0, 1))
    return Objects.of_mesh(points, normals, faces, names, albedo)


def _build_deck(rover: RoverParameters) -> Solid:
    """Build the deck, which is star-shaped, with its equipment."""
    size = np.array([0.5 * rover.body_length_m, 0.5 * rover.body_width_m, 1.0])
    above = np.array([0.0, 0.0, rover.deck_m])
    equipment = [(size * start + above, size * end + above, radius) for start, end, radius in _EQUIPMENT]
    equipment += _draw_edge_parts(above, size)
    left, half = np.array(_OUTLINE), 0.5 * _DECK_M
    outline = np.concatenate([left, left[:0:-1] * (1.0, -1.0)]) * size[:2]
    profile = [(rover.deck_m + z, factor) for z, factor in ((-half, 0.0), (-half, 1.0), (half, 1.0), (half, 0.0))]
    return np.concatenate([_shade_flat(_stack_rings(profile, outline)), _make_cylinders(equipment)])


def _draw_edge_parts(above: Point, size: Point) -> list[Cylinder]:
    """Return small parts along the deck's outline, which point outwards and up.

    Positions, lengths, radii and directions are a low-discrepancy sequence (Roberts 2018: powers of the real root of
    x**5 = x + 1). `above` is the middle of the deck, `size` half its length and width, metres.
    """
    left = np.array(_OUTLINE)
    outline = np.concatenate([left, left[:0:-1] * (1.0, -1.0), left[:1]]) * size[:2]
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    place, turn, length, radius = (
        np.mod(np.arange(1, _EDGE_PARTS + 1) * 1.1673039783**-power, 1.0) for power in (1.0, 2.0, 3.0, 4.0)
    )
    points = np.column_stack([np.interp(place * distance[-1], distance, outline[:, k]) for k in (0, 1)])
    outwards = points / np.linalg.norm(points, axis=1, keepdims=True)
    elevation = 0.5 * np.pi * turn
    directions = np.column_stack([np.cos(elevation)[:, None] * outwards, np.sin(elevation)])
    lengths, radii = (
        low + fraction * (high - low)
        for fraction, (low, high) in ((length, _EDGE_LENGTH_M), (np.square(radius), _EDGE_RADIUS_M))
    )
    starts = np.column_stack([points, np.zeros(_EDGE_PARTS)]) + above
    ends = starts + lengths[:, None] * directions
    return list(zip(starts, ends, radii.tolist(), strict=True))


def _build_body(rover: RoverParameters, stance: Stance) -> Solid:
    """Build the body with the stowed arm, cables, and the legs with steering motors."""
    length, width = _BODY_FRACTION[0] * rover.body_length_m, _BODY_FRACTION[1] * rover.body_width_m
    middle = (0.0, 0.0, 0.5 * (rover.deck_m + rover.clearance_m))
    front = np.array([0.5 * length, 0.0, rover.deck_m])
    shoulder, elbow, wrist = front + np.array(_ARM_JOINTS_M)
    turret = np.array([0.0, 0.5 * _TURRET_M, 0.0])
    cylinders = [(shoulder, elbow, _ARM_RADIUS_M), (elbow, wrist, _ARM_RADIUS_M)]
    # the turret carries instruments on two crossed axes
    cylinders += [(wrist - axis, wrist + axis, _TURRET_RADIUS_M) for axis in (turret, turret[[1, 0, 2]])]
    for start, end, sag in _CABLES_M:
        cylinders += _hang_cable(front + start, front + end, np.array([sag[0], 0.0, sag[1]]))
    centres = compute_wheel_centres(rover, stance.differential_rad, stance.bogies_rad)
    for side, bogie in enumerate(compute_bogie_pivots(rover, stance.differential_rad)):
        rocker = np.array([rover.rocker_pivot_x_m, bogie[1], rover.rocker_pivot_z_m])
        cylinders.append((rocker, bogie, 0.5 * _LEG_M))
        for wheel, pivot in enumerate((rocker, bogie, bogie)):
            cylinders += _build_leg(rover, pivot, centres[3 * side + wheel], steers=wheel != 1)
    box = _box((length, width, rover.deck_m - rover.clearance_m), middle)
    return np.concatenate([box, _make_cylinders(cylinders)])


def _build_leg(rover: RoverParameters, pivot: Point, centre: Point, *, steers: bool) -> list[Cylinder]:
    """Build a leg from a pivot to a wheel's hub: to its inner side, with the motor of a steered wheel above it."""
    inwards = np.array([0.0, -np.sign(centre[1]), 0.0])
    hub = centre + (0.5 * rover.wheel_width_m + _BRACKET_GAP_M) * inwards
    radius = 0.5 * _LEG_M
    if not steers:
        return [(pivot, hub, radius), (hub, centre, radius)]
    motor = hub + np.array([0.0, 0.0, _STEERING_HEIGHT * rover.wheel_radius_m])
    down = np.array([0.0, 0.0, 0.5 * rover.wheel_radius_m])
    cable = _hang_cable(pivot, motor, np.array([0.0, 0.0, -_LEG_SAG_M]))
    bracket = [(motor, hub, _BRACKET_RADIUS * radius), (hub, centre, radius)]
    return [(pivot, motor, radius), *bracket, (motor, motor - down, _LEG_M), *cable]


def _hang_cable(start: Point, end: Point, sag: Point) -> list[Cylinder]:
    """Approximate a cable by a parabola whose middle is displaced by `sag`."""
    t = np.linspace(0.0, 1.0, _SEGMENTS + 1)[:, None]
    points = start + t * (end - start) + 4.0 * t * (1.0 - t) * sag
    return [(points[k], points[k + 1], _CABLE_RADIUS_M) for k in range(_SEGMENTS)]


def _build_mast(
    rover: RoverParameters, mast: MastGeometry, rover_from_head: RigidTransform, baseline_m: float
) -> Solid:
    """Build the mast up to the elbow, and the head: a bar behind the cameras' centres, with a camera at each end."""
    x, y, z = mast.base_m
    depth, height, extra_width = _HEAD_M
    middle = np.array([-_BEHIND_M - 0.5 * depth, 0.0, 0.0])
    ends = [middle + np.array([0.0, side * 0.5 * baseline_m, 0.0]) for side in (-1.0, 1.0)]
    head = [_box((0.6 * depth, baseline_m, 0.6 * height), middle)]
    head += [_box((depth, extra_width, height), end) for end in ends]
    lens = np.array([0.5 * depth, 0.0, 0.0])
    # camera centres lie on the y axis of the head's frame, in front of the lenses
    lenses = [(end + lens, end + lens + np.array([0.5 * _BEHIND_M, 0.0, 0.0]), 0.25 * height) for end in ends]
    post = [(np.array([x, y, rover.deck_m]), np.array([x, y, z + mast.elbow_m[2]]), _MAST_RADIUS_M)]
    # the elevation axis, from the mast's elbow to the head's middle
    top, end = rover_from_head.apply(np.array([-mast.head_m, middle]))
    solids = _transform(np.concatenate([*head, _make_cylinders(lenses)]), rover_from_head)
    return np.concatenate([solids, _make_cylinders([*post, (top, end, _MAST_RADIUS_M)])])


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
    motor = _length(_STEERING_HEIGHT * rover.wheel_radius_m, 0.5 * rover.wheel_width_m + _BRACKET_GAP_M)
    wheel = max(rover.wheel_radius_m + 0.5 * rover.wheel_width_m, motor) + _LEG_M
    rear_chain = _length(bogie - rocker) + max(_length(middle - bogie), _length(rear - bogie))
    legs = _length(rocker) + max(_length(front - rocker), rear_chain) + wheel
    depth, height, extra_width = _HEAD_M
    head = _length(_BEHIND_M + depth, 0.5 * (baseline_m + extra_width), 0.5 * height)
    top = _length(mast.base_m) + _length(mast.elbow_m) + _length(mast.head_m) + head + _MAST_RADIUS_M
    body = _length(
        0.5 * rover.body_length_m, 0.5 * rover.body_width_m, rover.deck_m + max(end[2] for _, end, _ in _EQUIPMENT)
    )
    return np.array([[*stance.world_from_rover.translation, max(legs, top, body)]])


def _length(*components: float | Float64[np.ndarray, "3"]) -> float:
    """Compute the length of a vector with these components."""
    return float(np.linalg.norm(np.hstack(components)))


def _box(size_m: tuple[float, float, float], middle_m: Point | tuple[float, float, float]) -> Solid:
    """Create a box with edges along the axes."""
    half = 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return _shade_flat(_stack_rings([(-0.5, 0.0), (-0.5, 1.0), (0.5, 1.0), (0.5, 0.0)], half) * size_m + middle_m)


def _stack_rings(
    profile: list[tuple[float, float]], outline: Float64[np.ndarray, "corners 2"]
) -> Float64[np.ndarray, "triangles 3 3"]:
    """Return the triangles between copies of a closed outline around the z axis: heights, and factors of its size."""
    rings = np.stack([np.column_stack([factor * outline, np.full(len(outline), z)]) for z, factor in profile])
    a, b = rings, np.roll(rings, -1, axis=1)
    quads = np.stack([a[:-1], b[:-1], b[1:], a[:-1], b[1:], a[1:]], axis=2).reshape(-1, 3, 3)
    # a factor of 0 gives triangles without area
    return np.asarray(quads[np.linalg.norm(_face_normals(quads), axis=1) > 0.0])


def _face_normals(triangles: Float64[np.ndarray, "triangles 3 3"]) -> Float64[np.ndarray, "triangles 3"]:
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _shade_flat(triangles: Float64[np.ndarray, "triangles 3 3"]) -> Solid:
    """Return triangles with the normals of their planes."""
    normals = _face_normals(triangles)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.stack([triangles, np.broadcast_to(normals[:, None], triangles.shape)], axis=2)


@cache
def _unit_cylinder() -> Solid:
    """Return a cylinder of radius 1 around the z axis from z = 0 to z = 1; its side is smooth."""
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    outline = np.column_stack([np.cos(angles), np.sin(angles)])
    solid = _shade_flat(_stack_rings([(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)], outline))
    is_side = np.abs(solid[:, 0, 1, 2]) < 0.5
    solid[is_side, :, 1] = solid[is_side, :, 0] * (1.0, 1.0, 0.0)
    return solid


@cache
def _unit_wheel() -> Solid:
    """Return a wheel of radius 1 and width 1 around the z axis: crowned tread with cleats, rim, hub and spokes."""
    # a cleat is a narrow ridge: two corners at its top, one between cleats
    radii = np.tile([1.0, 1.0, 1.0 - _CLEAT_HEIGHT], _CLEATS)
    angles = 2.0 * np.pi / _CLEATS * (np.arange(_CLEATS)[:, None] + np.array([-0.1, 0.1, 0.5])).ravel()
    outline = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    # heights and radii: over the crowned tread from one edge to the other, and back along the inside of the rim
    tread = [(-0.5, 0.9), (-0.36, 1.0), (0.36, 1.0), (0.5, 0.9), (0.42, _RIM), (-0.42, _RIM), (-0.5, 0.9)]
    axis = np.array([0.0, 0.0, 0.45])
    radial = [np.array([np.cos(a), np.sin(a), 0.0]) for a in 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES]
    # from the middle of the hub into the rim, slightly off its middle
    spokes = [(_HUB * d, (_RIM + 0.03) * d + 0.3 * axis, 0.07) for d in radial]
    return np.concatenate([_shade_flat(_stack_rings(tread, outline)), _make_cylinders([(-axis, axis, _HUB), *spokes])])


def _make_cylinders(cylinders: list[Cylinder]) -> Solid:
    """Create cylinders between the centres of their ends, with these radii."""
    starts, ends = (np.array([cylinder[end] for cylinder in cylinders]) for end in (0, 1))
    radii = np.array([radius for _, _, radius in cylinders])[:, None]
    axes = ends - starts
    x = np.cross(np.eye(3)[np.argmin(np.abs(axes), axis=1)], axes)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    z = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    stretched = np.stack([radii * rotation[:, 0], radii * rotation[:, 1], axes], axis=1)
    unit = _unit_cylinder()
    points = starts[:, None, None] + unit[:, :, 0] @ stretched[:, None]
    return np.stack([points, unit[:, :, 1] @ rotation[:, None]], axis=3).reshape(-1, 3, 2, 3)


def _transform(solid: Solid, new_from_old: RigidTransform) -> Solid:
    points, normals = solid[:, :, 0].reshape(-1, 3), solid[:, :, 1].reshape(-1, 3)
    moved = [new_from_old.apply(points), new_from_old.rotation.apply(normals)]
    return np.stack(moved, axis=1).reshape(-1, 3, 2, 3)
