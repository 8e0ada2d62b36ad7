"""Rocks in a view: those that a camera resolves become objects of the scene, all smaller ones occlude some ground.

`smallest_rock_rad` is the limit between both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from marsyard.scenarios.viewpoint import Viewpoint
from marsyard.sim.render import Frame, Objects, Scene
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.terrain import RockField, RockMesh
from marsyard.sim.terrain.rocks.field import ROCK_ARRAYS, find_periods
from marsyard.sim.terrain.rocks.shapes import FINEST, max_pixels, rock_shapes

#: Smallest rendered rocks, pixels.
SMALLEST_ROCK_PX = 1.5
#: Approximate maximum number of triangles of coarse rocks in a scene; smaller rocks are omitted to satisfy it.
ROCK_TRIANGLES = 600_000
#: Maximum number of additional triangles of detailed rocks in the viewpoint's sector; to satisfy it, all rocks are
#: rendered with less detail than the camera resolves.
DETAIL_TRIANGLES = 1_200_000
#: Number of triangles of a coarse rock.
_COARSE_TRIANGLES = 20
#: Ratio of the diameters of neighbouring size classes of rocks; rocks of one class are selected up to one distance.
_CLASS_RATIO = float(np.sqrt(2.0))
#: Margin for rounding, and smallest divisor.
_ROUNDING = 1e-9
#: Smallest sine of the elevation of a line of sight, and of its angle from the vertical, for its tangent.
_MIN_SINE = 1e-4
#: Mean width of a rock's silhouette divided by its diameter and height: between an ellipse (pi/4) and a rectangle.
_SILHOUETTE_FRACTION = 0.85


def select_rocks(
    field: RockField | None, rock_albedo: float, viewpoint: Viewpoint, farthest_m: float = np.inf
) -> Objects:
    """Select the rocks of a field that a camera resolves (`viewpoint`), and near rocks for their shadows.

    `rock_albedo` is the site's mean albedo of rocks, which multiplies the relative albedo of each rock.

    The names of the objects are the rocks' numbers in the field; each periodic copy of a rock is a body of its own. If
    rocks of `SMALLEST_ROCK_PX` need more than about `ROCK_TRIANGLES`, only larger rocks are selected. The level of
    detail is high enough that a rock cannot be distinguished from its finest mesh
    (`marsyard.sim.terrain.rocks.shapes.DEVIATION_PX`), within the limit of `DETAIL_TRIANGLES`.
    """
    if field is None or len(field) == 0:
        return Objects.none()
    smallest_rad, pixel_rad = smallest_rock_rad(field, viewpoint), _detail_pixel_rad(field, viewpoint)
    smallest_m = float(field.diameter_m.min())
    size_class = np.floor(np.log(field.diameter_m / smallest_m) / np.log(_CLASS_RATIO) + _ROUNDING)
    # maximum distance of each size class, and its horizontal part
    distance_m = smallest_m * _CLASS_RATIO ** (size_class + 0.5) / smallest_rad
    radius_m = np.sqrt(np.maximum(distance_m**2 - viewpoint.height_m**2, 0.0))
    radius_m = np.minimum(radius_m, min(farthest_m, viewpoint.max_distance_m))
    near = np.flatnonzero(_find_near_rocks(field, viewpoint, radius_m))
    subset = replace(field, names={}, **{name: getattr(field, name)[near] for name in ROCK_ARRAYS})
    mesh = subset.near(
        viewpoint.east_m, viewpoint.north_m, radius_m[near], above_m=viewpoint.height_m, pixel_rad=pixel_rad
    )
    # keep only triangles in the viewpoint's sector or near the viewpoint
    visible = _find_visible_triangles(mesh, viewpoint)
    return Objects.of_mesh(
        mesh.vertices,
        mesh.vertex_normals,
        mesh.faces[visible],
        near[mesh.rock_of_face[visible]].astype(np.int32),
        np.minimum(rock_albedo * field.albedo, 1.0),
        mesh.body_of_face[visible],
    )


def smallest_rock_rad(field: RockField, viewpoint: Viewpoint) -> float:
    """Return the angular size of the smallest rocks in a scene.

    Rocks of diameter D are rendered up to the distance D / angle. With n rocks per square metre and a sector of half
    width w, they have ``20 w D**2 n / angle**2`` triangles. The result limits this number to `ROCK_TRIANGLES`.
    """
    if np.isfinite(viewpoint.max_distance_m):
        return SMALLEST_ROCK_PX * viewpoint.pixel_rad
    squared_diameters_per_m2 = float(np.sum(field.diameter_m**2)) / field.period_m**2
    limit_rad = np.sqrt(_COARSE_TRIANGLES * viewpoint.half_width_rad * squared_diameters_per_m2 / ROCK_TRIANGLES)
    return float(max(SMALLEST_ROCK_PX * viewpoint.pixel_rad, limit_rad))


def _detail_pixel_rad(field: RockField, viewpoint: Viewpoint) -> float:
    """Return the pixel angle for the detail of rocks, at least the smallest that `DETAIL_TRIANGLES` allows.

    Detail level k of a rock of diameter D is sufficient up to a size of p_k pixels. The additional triangles of the
    next level are therefore needed up to the distance ``D / (p_k * pixel angle)``.
    """
    triangles = np.array([rock_shapes(detail).faces.shape[0] for detail in range(FINEST + 1)])
    added_triangles = (np.diff(triangles) / max_pixels() ** 2).sum(axis=1)
    per_m2 = float(np.sum(field.diameter_m**2 * added_triangles[field.shape])) / field.period_m**2
    return float(max(viewpoint.pixel_rad, np.sqrt(viewpoint.half_width_rad * per_m2 / DETAIL_TRIANGLES)))


def _find_near_rocks(
    field: RockField, viewpoint: Viewpoint, radius_m: Float64[np.ndarray, "rocks"]
) -> Bool[np.ndarray, "rocks"]:
    """Select rocks of which a copy is within their radius of the viewpoint; the rock field repeats with its period.

    All rocks with triangles of `_find_visible_triangles` are among them.
    """
    is_selected = np.zeros(len(field), dtype=np.bool_)
    # larger than any shape on the steepest ground
    extent = field.diameter_m + field.height_m
    for corner_m in find_periods(viewpoint.east_m, viewpoint.north_m, float(radius_m.max()), field.period_m):
        east, north = (field.position_m[:, :2] + (corner_m - (viewpoint.east_m, viewpoint.north_m))).T
        distance = np.hypot(east, north)
        within = np.flatnonzero(distance <= radius_m)
        distance, extent_within = distance[within], extent[within]
        bearing = np.arctan2(east[within], north[within]) - viewpoint.azimuth_rad
        bearing = np.abs((bearing + np.pi) % (2.0 * np.pi) - np.pi)
        widening = np.arcsin(np.minimum(extent_within / np.maximum(distance, _ROUNDING), 1.0))
        is_in_sector = bearing <= viewpoint.half_width_rad + widening
        is_selected[within] |= is_in_sector | (distance <= viewpoint.near_m + extent_within)
    return is_selected


def _find_visible_triangles(mesh: RockMesh, viewpoint: Viewpoint) -> Bool[np.ndarray, "triangles"]:
    """Select the triangles whose first corner is in the viewpoint's sector or near the viewpoint."""
    offsets = mesh.vertices[:, :2] - (viewpoint.east_m, viewpoint.north_m)
    distance = np.hypot(*offsets.T)
    forward = offsets @ (np.sin(viewpoint.azimuth_rad), np.cos(viewpoint.azimuth_rad))
    # with a margin, so that a half width of pi selects all
    min_cosine = np.cos(viewpoint.half_width_rad) - _ROUNDING
    is_selected = (forward >= min_cosine * distance) | (distance <= viewpoint.near_m)
    return np.asarray(is_selected[mesh.faces[:, 0]])


def add_unresolved_rocks(
    frame: Frame, scene: Scene, rocks: RockField | None, smallest_rad: float, rms_slope: float
) -> Frame:
    """Blend the mean radiance of the rendered rocks into ground pixels that rocks below the resolution occlude.

    Rocks with diameters below ``smallest_rad x range`` are not rendered. At grazing view they hide the ground. The
    visible fraction of the ground is ``exp(-A / t)`` with ``t**2 = tan(e)**2 + rms_slope**2``. Here A is the frontal
    area of these rocks per square metre, and e is the angle between the line of sight and level ground. Range and
    normals are not changed.
    """
    # bodies -1 (ground) and -2 (sky) select the two appended numbers, which are negative, as no rock's number is
    numbers = np.append(scene.objects.names, [-2, -1])[frame.body]
    is_rock = (numbers >= 0) & (numbers < FIRST_MESH_NUMBER)
    if rocks is None or len(rocks) == 0 or not np.any(is_rock):
        return frame
    order = np.argsort(rocks.diameter_m)
    areas = _SILHOUETTE_FRACTION * (rocks.diameter_m * rocks.height_m)[order] / rocks.period_m**2
    area_below = np.concatenate([[0.0], np.cumsum(areas)])
    unresolved_counts = np.searchsorted(
        rocks.diameter_m[order], smallest_rad * np.where(frame.body == -1, frame.range_m, 0.0)
    )
    _, _, up_in_body = frame.world_from_body.rotation.as_matrix()
    up = frame.rays.directions.reshape(*frame.range_m.shape, 3) @ up_in_body
    tan_elevation = np.maximum(-up, _MIN_SINE) / np.sqrt(np.maximum(1.0 - up**2, _MIN_SINE**2))
    occluded_fraction = -np.expm1(-area_below[unresolved_counts] / np.hypot(tan_elevation, rms_slope)).astype(
        np.float32
    )
    rock_radiance = frame.radiance[is_rock].mean()
    blended = frame.radiance + occluded_fraction * (rock_radiance - frame.radiance)
    return replace(frame, radiance=np.where(frame.body == -1, blended, frame.radiance))
