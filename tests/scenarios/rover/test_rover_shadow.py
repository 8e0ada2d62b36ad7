"""Tests of the shadow of rover and mast on a template patch, the surface around a target that the tracker matches."""

import numpy as np
import pytest

from marsyard.scenarios.rover.points import rover_shades_patch, sample_template
from marsyard.sim.dynamics import ROCKY_8, settle
from marsyard.sim.frames import direction
from marsyard.sim.sensor.mast import RESEARCH_MAST
from tests.sim.dynamics.grounds import Plane

EAST = 0.5 * np.pi


@pytest.mark.parametrize("elevation_deg", [25.0, 40.0])
def test_head_shadow_is_at_the_sun_ray_intersection(elevation_deg: float) -> None:
    """The rover faces east and the sun is in the west: the head's shadow is height / tan(elevation) ahead."""
    stance = settle(ROCKY_8, Plane(), 0.0, 0.0, EAST)
    sun = direction(-EAST, float(np.radians(elevation_deg)))
    head = stance.world_from_rover.apply(RESEARCH_MAST.base_m + RESEARCH_MAST.elbow_m + RESEARCH_MAST.head_m)
    shadow = head - head[2] / sun[2] * sun

    def is_shaded(east_m: float, north_m: float) -> bool:
        # The patch has a half angle of 2 mrad, seen from the head. The mast points ahead.
        position = shadow + np.array([east_m, north_m, 0.0])
        patch = sample_template(head, position, 0.002)
        return rover_shades_patch(ROCKY_8, stance, RESEARCH_MAST, (0.0, 0.0), patch, sun)

    assert is_shaded(0.0, 0.0)
    # The head is at most half a metre wide. The ground 0.6 m ahead or to the side is sunlit.
    assert not is_shaded(0.6, 0.0)
    assert not is_shaded(0.0, 0.6)
    assert not is_shaded(0.0, -0.6)
    # Closer to the rover, the mast shades the ground.
    assert is_shaded(-0.4, 0.0)


def test_template_patch_has_points_at_centre_half_and_full_radius() -> None:
    eye, point = np.array([0.0, 0.0, 1.5]), np.array([2.0, 0.0, 0.2])
    patch = sample_template(eye, point, 0.02)
    ray_vectors = patch - eye
    angles = np.arccos(ray_vectors @ (point - eye) / np.linalg.norm(ray_vectors, axis=1) / np.linalg.norm(point - eye))
    np.testing.assert_allclose(sorted(set(np.round(angles, 4))), [0.0, 0.01, 0.02], atol=2e-4)
