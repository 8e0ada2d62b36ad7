"""Distant hills, and occlusion of the ground at grazing view by rocks below the rendering resolution."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from marsyard.sim.render import Frame, Objects, Scene
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.terrain import RockField
from marsyard.sim.terrain.sites import Hill

#: Identifier of hills in `Objects.names`; identifiers of rocks are 0 or greater.
HILL_NAME = -4
#: Number of mesh lines of the hills in azimuth and in distance, and of azimuth lines per body.
_AZIMUTHS, _DISTANCES, _LINES_PER_BODY = 1440, 64, 60
#: Sizes of the ridges in lines of the mesh, and RMS height of the largest ridges relative to the hill's; assumed.
_RIDGE_SIZES, _RIDGE_HEIGHT = (12.0, 6.0, 3.0), 0.25
#: Minimum height of a face above the plain, metres, and albedo relative to the plain's; assumed.
_MIN_FACE_HEIGHT_M, _HILL_ALBEDO = 1.0, 0.85
_MARS_RADIUS_M = 3.39e6
#: Mean width of a rock's silhouette divided by its diameter and height: between an ellipse (pi/4) and a rectangle.
_SILHOUETTE_FRACTION = 0.85


def hill_objects(hills: Sequence[Hill], ground_m: float, albedo: float) -> Objects:
    """Build the mesh of the hills around the origin of a site's terrain, without the part below the curved horizon.

    The hills are Gaussian domes with ridges of three sizes, on a mesh of lines of azimuth and distance; `ground_m` is
    the mean height of the terrain, `albedo` that of the plain.
    """
    azimuth = np.linspace(-np.pi, np.pi, _AZIMUTHS, endpoint=False)
    nearest, farthest = (
        min(hill.distance_m - hill.depth_m for hill in hills),
        max(hill.distance_m + hill.depth_m for hill in hills),
    )
    distance = np.geomspace(max(nearest, 1.0), farthest, _DISTANCES)[:, None]
    height = np.zeros((_DISTANCES, _AZIMUTHS))
    for hill in hills:
        angle = azimuth - np.radians(hill.azimuth_deg)
        along, across = distance * np.cos(angle) - hill.distance_m, distance * np.sin(angle)
        # a Gaussian of standard deviation depth / 4 and width / 4
        dome = np.exp(-2.0 * ((2.0 * along / hill.depth_m) ** 2 + (2.0 * across / hill.width_m) ** 2))
        height += hill.height_m * np.where(np.cos(angle) > 0.0, dome, 0.0)
    rng = np.random.default_rng(0)
    for size in _RIDGE_SIZES:
        noise = gaussian_filter(rng.standard_normal(height.shape), (size / 3.0, size), mode=("nearest", "wrap"))
        height *= np.maximum(1.0 + _RIDGE_HEIGHT * size / _RIDGE_SIZES[0] * noise / noise.std(), 0.0)
    x, y = distance * np.sin(azimuth), distance * np.cos(azimuth)
    # the plain curves away from its tangent plane by distance^2 / (2 radius)
    height_above_plain = height - distance**2 / (2.0 * _MARS_RADIUS_M)
    vertices = np.stack([x, y, ground_m + height_above_plain], axis=-1)
    azimuth_tangents = np.roll(vertices, -1, axis=1) - np.roll(vertices, 1, axis=1)
    normals = np.cross(azimuth_tangents, np.gradient(vertices, axis=0))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    indices = np.arange(height.size, dtype=np.int32).reshape(height.shape)
    right = np.roll(indices, -1, axis=1)
    quads = np.stack([indices[:-1], right[:-1], right[1:], indices[1:]], axis=-1)
    # omit faces below `_MIN_FACE_HEIGHT_M`: they would intersect the terrain; bodies are sectors of azimuth
    row, column = np.nonzero(np.all(height_above_plain.reshape(-1)[quads] > _MIN_FACE_HEIGHT_M, axis=-1))
    order = np.argsort(column // _LINES_PER_BODY, kind="stable")
    quad, body = quads[row, column][order], (column // _LINES_PER_BODY)[order]
    faces = np.stack([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    bodies = np.repeat(body, 2).astype(np.int32)
    names = np.full(bodies.size, HILL_NAME, dtype=np.int32)
    return Objects.of_mesh(vertices.reshape(-1, 3), normals.reshape(-1, 3), faces, names, _HILL_ALBEDO * albedo, bodies)


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
    up = frame.rays.directions.reshape(*frame.range_m.shape, 3) @ frame.world_from_body.rotation.as_matrix()[2]
    tan_elevation = np.maximum(-up, 1e-4) / np.sqrt(np.maximum(1.0 - up**2, 1e-8))
    occluded_fraction = -np.expm1(-area_below[unresolved_counts] / np.hypot(tan_elevation, rms_slope)).astype(
        np.float32
    )
    rock_radiance = frame.radiance[is_rock].mean()
    blended = frame.radiance + occluded_fraction * (rock_radiance - frame.radiance)
    return replace(frame, radiance=np.where(frame.body == -1, blended, frame.radiance))
