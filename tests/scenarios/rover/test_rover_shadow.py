"""Position of the shadow of the rover."""

import numpy as np
import pytest

from marsyard.scenarios.rover.points import rover_shades_patch, template_patch
from marsyard.sim.dynamics import ROCKY_8, settle
from marsyard.sim.frames import direction
from marsyard.sim.sensor.mast import RESEARCH_MAST
from tests.sim.dynamics.grounds import Plane

EAST = 0.5 * np.pi


@pytest.mark.parametrize("elevation_deg", [25.0, 40.0])
def test_the_head_s_shadow_falls_where_the_sun_s_ray_meets_the_ground(elevation_deg: float) -> None:
    """The rover looks east, the sun stands in the west: its head shades the ground h / tan(elevation) ahead of it."""
    stance = settle(ROCKY_8, Plane(), 0.0, 0.0, EAST)
    sun = direction(-EAST, float(np.radians(elevation_deg)))
    head = stance.world_from_rover.apply(RESEARCH_MAST.base_m + RESEARCH_MAST.elbow_m + RESEARCH_MAST.head_m)
    shadow = head - head[2] / sun[2] * sun

    def shaded(east_m: float, north_m: float) -> bool:
        position = shadow + np.array([east_m, north_m, 0.0])
        patch = template_patch(head, position, 0.002)
        return rover_shades_patch(ROCKY_8, stance, RESEARCH_MAST, (0.0, 0.0), patch, sun)

    assert shaded(0.0, 0.0)
    # the head is half a metre wide at most; beyond it, and to the side of the mast, there is light
    assert not shaded(0.6, 0.0)
    assert not shaded(0.0, 0.6)
    assert not shaded(0.0, -0.6)
    # further back the shadow is the mast's
    assert shaded(-0.4, 0.0)


def test_a_template_s_edge_counts() -> None:
    eye, point = np.array([0.0, 0.0, 1.5]), np.array([2.0, 0.0, 0.2])
    patch = template_patch(eye, point, 0.02)
    away = patch - eye
    angles = np.arccos(away @ (point - eye) / np.linalg.norm(away, axis=1) / np.linalg.norm(point - eye))
    np.testing.assert_allclose(sorted(set(np.round(angles, 4))), [0.0, 0.01, 0.02], atol=2e-4)
