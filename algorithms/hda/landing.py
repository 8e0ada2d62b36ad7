"""From a point cloud to a landing site: surface frame, maps, site, hand-over in map coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.hda.details import Ground
from marsyard.algorithms.hda.elevation import elevation_map
from marsyard.algorithms.hda.footprints import Resolution, checked
from marsyard.algorithms.hda.hazards import hazard_maps, safe_site
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.sighting import Sighting
from marsyard.algorithms.hda.surface import surface_from_camera, upwards, world_from_surface


def map_ground(
    sighting: Sighting, points_camera: Float[np.ndarray, "n 3"], resolution: Resolution, options: HdaOptions
) -> Ground | None:
    """The maps of points in the first camera's frame, and the site; None where the points cover no area."""
    first = sighting.views[0]
    to_surface = surface_from_camera(upwards(first, sighting.up_camera, points_camera, options))
    points = to_surface.apply(points_camera)
    elevation = elevation_map(points)
    if elevation is None:
        return None
    hazards = hazard_maps(elevation, options)
    if options.check_footprints:
        hazards = replace(hazards, safety=checked(hazards.safety, elevation, resolution, options))
    to_world = world_from_surface(first.world_from_camera.rotation, to_surface)
    apriori = to_world.inv().apply(sighting.apriori_site_world - first.world_from_camera.translation)
    apriori_cell = elevation.cells(apriori[:2])
    return Ground(
        to_surface, to_world, points, elevation, hazards, apriori_cell, safe_site(hazards.safety, apriori_cell)
    )


def site_world(sighting: Sighting, ground: Ground) -> Float[np.ndarray, "3"] | None:
    """The chosen site in the world frame, metres, on the smooth surface; None if nothing is safe."""
    if ground.site_cell is None:
        return None
    x, y = ground.elevation.places(np.array(ground.site_cell, dtype=np.float64))
    site = np.array([x, y, ground.hazards.smooth_m[ground.site_cell]])
    return np.asarray(sighting.views[0].world_from_camera.translation + ground.world_from_surface.apply(site))
