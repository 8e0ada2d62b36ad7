"""Viewpoint of a camera over ground, which determines the extent and the detail of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.sim.render import PixelRays
from marsyard.sim.terrain import Surface

#: Margin of a viewpoint's sector on each side, and depression of the image's upper edge above which the horizon is
#: assumed visible, radians.
_SECTOR_MARGIN_RAD, _MIN_DEPRESSION_RAD = np.radians(3.0), np.radians(5.0)
#: Radius of nearby objects: times the viewpoint's height, and at least this radius, m (assumed).
_NEAR_HEIGHTS, _NEAR_M = 3.0, 5.0


@dataclass(frozen=True)
class Viewpoint:
    """Viewpoint of a camera: position, visible sector and resolution, which determine the detail of a scene.

    - east_m, north_m, height_m: position, and height above the ground
    - pixel_rad: angle of a pixel
    - azimuth_rad, half_width_rad: centre, clockwise from north, and half width of the visible sector; a half width of
      pi is the full circle
    - max_distance_m: maximum horizontal distance of visible ground; infinite if the horizon is visible
    """

    east_m: float
    north_m: float
    height_m: float
    pixel_rad: float
    azimuth_rad: float = 0.0
    half_width_rad: float = np.pi
    max_distance_m: float = np.inf

    @property
    def near_m(self) -> float:
        """Radius in which the shadows of objects outside of the sector can be visible, m."""
        return max(_NEAR_HEIGHTS * self.height_m, _NEAR_M)

    @classmethod
    def from_pose(cls, rays: PixelRays, world_from_body: RigidTransform, surface: Surface) -> Viewpoint:
        """Compute the viewpoint of a camera at a pose."""
        east, north, up = (float(value) for value in world_from_body.apply(rays.centre))
        height = up - float(surface.height(east, north))
        axis = world_from_body.rotation.apply(rays.axis)
        elevation, half_angle = float(np.arcsin(np.clip(axis[2], -1.0, 1.0))), rays.half_angle_rad
        # the azimuths of a cone around the axis; all if it contains the nadir or the zenith
        horizontal = float(np.cos(elevation))
        is_full_circle = np.sin(half_angle) >= horizontal or half_angle >= np.pi / 2
        half_width = np.pi if is_full_circle else np.arcsin(np.sin(half_angle) / horizontal)
        half_width = float(min(half_width + _SECTOR_MARGIN_RAD, np.pi))
        upper_edge = elevation + half_angle
        # twice the maximum distance on level ground, because slopes may descend; unlimited near the horizon
        max_distance_m = 2.0 * height / np.tan(-upper_edge) + _NEAR_M if upper_edge < -_MIN_DEPRESSION_RAD else np.inf
        return cls(
            east, north, height, rays.pixel_rad, float(np.arctan2(axis[0], axis[1])), half_width, float(max_distance_m)
        )
