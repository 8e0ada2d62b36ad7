"""Whether the rover's own shadow lies on what is tracked."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.rover.points import distances, sight_axes
from marsyard.sim.dynamics import RoverParameters, Stance
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render import may_shade, rover_objects, rover_sphere

#: Directions about a point's own in which its template is looked at, and shares of the way to its corners.
_AROUND, _SHARES = 8, (0.5, 1.0)


def shades(
    rover: RoverParameters,
    stance: Stance,
    mast: MastGeometry,
    angles_rad: tuple[float, float],
    patch_m: Float64[np.ndarray, "places 3"],
    sun_direction: Float64[np.ndarray, "3"],
) -> bool:
    """Whether the rover as it stands, its mast as it points, hides the sun from any of some places, world, metres."""
    middle = patch_m.mean(axis=0)
    radius = float(np.linalg.norm(patch_m - middle, axis=1).max())
    # the rover is put together only where what holds it may matter
    if not may_shade(rover_sphere(rover, stance, mast), sun_direction, middle, radius):
        return False
    triangles = rover_objects(rover, stance, mast, *angles_rad).triangles
    return any(np.isfinite(distances(triangles, place, sun_direction[None])[0]) for place in patch_m)


def template_patch(
    eye: Float64[np.ndarray, "3"], point: Float64[np.ndarray, "3"], reach_rad: float
) -> Float64[np.ndarray, "places 3"]:
    """A point, and places around it on rings up to an angle from it as seen from a place, across the line of sight."""
    _, right, up = sight_axes(point - eye)
    turns = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    reach_m = float(np.tan(reach_rad) * np.linalg.norm(point - eye))
    ring = reach_m * (np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * up)
    return np.vstack([point, *(point + share * ring for share in _SHARES)])
