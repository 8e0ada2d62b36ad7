"""From a point cloud to a landing site: surface frame, maps, site (sections II.D and III).

The surface frame is level, with its origin at the first camera: z is up, x runs along the image columns as seen from
above, y = z x x. Only its azimuth in the world comes from the on-board pose; the options choose the source of the
vertical.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda.details import Ground
from marsyard.algorithms.hda.hazards import Resolution, check_footprints, elevation_map, hazard_maps, safe_site
from marsyard.algorithms.hda.options import HdaOptions, SurfaceFrame
from marsyard.algorithms.hda.view import LandingScene, View

#: Trials of the robust plane through all points.
PLANE_TRIALS = 200


def up_direction(
    first: View, up_camera: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 3"], options: HdaOptions
) -> Float[np.ndarray, "3"]:
    """Unit vector upwards in the first camera's frame, from the source in the options.

    `up_camera` is the inclinometers' measurement, `points` are in the first camera's frame.
    """
    if options.surface_frame is SurfaceFrame.INCLINOMETER:
        return up_camera
    if options.surface_frame is SurfaceFrame.STATE:
        return np.asarray(first.world_from_camera.rotation.inv().apply(np.array([0.0, 0.0, 1.0])))
    return plane_normal(points, options.seed)


def plane_normal(points: Float[np.ndarray, "n 3"], seed: int) -> Float[np.ndarray, "3"]:
    """Unit normal, towards the origin, of the least-median-of-squares plane through at least four points.

    The best of planes through random triples, refined by least squares over the points within 2.5 standard deviations
    (Rousseeuw & Leroy 1987).
    """
    rng = np.random.default_rng(seed)
    corners = points[rng.integers(0, len(points), (PLANE_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    real = lengths > 1e-9 * float(np.mean(points**2))
    normals, corners = normals[real] / lengths[real, None], corners[real]
    if len(normals) == 0:
        return np.array([0.0, 0.0, -1.0])
    distances = np.abs(points @ normals.T - np.sum(normals * corners[:, 0], axis=1))
    medians = np.median(distances, axis=0)
    best = int(np.argmin(medians))
    near = points[distances[:, best] <= 2.5 * 1.4826 * (1.0 + 5.0 / max(len(points) - 3, 1)) * medians[best]]
    normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2] if len(near) >= 3 else normals[best]
    return np.asarray(-np.sign(normal @ points.mean(axis=0)) * normal)


def surface_from_camera(up_camera: Float[np.ndarray, "3"]) -> Rotation:
    """The rotation from the camera's frame to the surface frame; up must not be parallel to the columns."""
    x = np.array([1.0, 0.0, 0.0]) - up_camera[0] * up_camera
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.stack([x, np.cross(up_camera, x), up_camera]))


def world_from_surface(world_from_camera: Rotation, surface_from_first: Rotation) -> Rotation:
    """The rotation about the vertical that aligns the surface frame's azimuth with the on-board pose."""
    x = (world_from_camera * surface_from_first.inv()).apply(np.array([1.0, 0.0, 0.0]))
    return Rotation.from_euler("z", float(np.arctan2(x[1], x[0])))


def map_ground(
    scene: LandingScene, points_camera: Float[np.ndarray, "n 3"], resolution: Resolution, options: HdaOptions
) -> Ground | None:
    """The maps of points in the first camera's frame, and the site; None if the points cover no area."""
    first = scene.views[0]
    to_surface = surface_from_camera(up_direction(first, scene.up_camera, points_camera, options))
    points = to_surface.apply(points_camera)
    elevation = elevation_map(points)
    if elevation is None:
        return None
    hazards = hazard_maps(elevation, options)
    if options.check_footprints:
        hazards = replace(hazards, safety=check_footprints(hazards.safety, elevation, resolution, options))
    to_world = world_from_surface(first.world_from_camera.rotation, to_surface)
    apriori = to_world.inv().apply(scene.apriori_site_world - first.world_from_camera.translation)
    apriori_cell = elevation.cells(apriori[:2])
    return Ground(
        to_surface, to_world, points, elevation, hazards, apriori_cell, safe_site(hazards.safety, apriori_cell)
    )


def site_world(scene: LandingScene, ground: Ground) -> Float[np.ndarray, "3"] | None:
    """The site in the world frame, metres, on the smooth surface; None if no cell is safe."""
    if ground.site_cell is None:
        return None
    x, y = ground.elevation.places(np.array(ground.site_cell, dtype=np.float64))
    site = np.array([x, y, ground.hazards.smooth_m[ground.site_cell]])
    return np.asarray(scene.views[0].world_from_camera.translation + ground.world_from_surface.apply(site))
