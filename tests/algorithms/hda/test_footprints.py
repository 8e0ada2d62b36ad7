"""The check of a place's own footprint: what a map's resolution leaves of a hazard, and what fails."""

import numpy as np
import pytest

from marsyard.algorithms.hda import HdaOptions, Safety
from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.hazards import Resolution, check_footprints, roughness_limit_m

SHARP = Resolution(window_m=0.0, noise_m=0.0)


def test_the_limit_is_what_the_window_leaves_of_a_paraboloid() -> None:
    """The mean of 1 - 4 r^2 / D^2 over a window of side w about its top, worked out on a grid."""
    options = HdaOptions(max_roughness_m=0.2, narrowest_hazard=2.0)
    x = np.linspace(-0.05, 0.05, 401)
    mean = float(np.mean(1.0 - 4.0 * (x[:, None] ** 2 + x**2) / 0.4**2))
    assert roughness_limit_m(Resolution(0.1, 0.0), 1e-9, options) == pytest.approx(0.2 * mean, rel=1e-2)
    noisy = roughness_limit_m(Resolution(0.0, 0.01), 1e-9, options)
    assert noisy == pytest.approx(0.2 - options.margin_deviations * 0.01)


def test_a_curved_place_that_interpolated_planes_call_safe_is_a_hazard() -> None:
    """A ridge 0.3 m over its feet 1 m away: no plane over 2 m comes within 0.1 m of all of it."""
    x = 0.05 * (np.arange(121) - 60)
    ground = ElevationMap(np.tile(-0.3 * np.abs(x), (121, 1)), np.zeros(2), 0.05)
    all_safe = np.full((121, 121), Safety.SAFE, dtype=np.uint8)
    options = HdaOptions(max_roughness_m=0.1, narrowest_hazard=100.0, max_slope_rad=float(np.radians(20.0)))
    result = check_footprints(all_safe, ground, SHARP, options)
    assert np.all(result[40:80, 58:63] == Safety.HAZARD)
    # where the footprint lies on one flank the ground is a plane
    assert np.all(result[40:80, 85:95] == Safety.SAFE)


def test_a_map_that_cannot_tell_calls_nothing_safe() -> None:
    ground = ElevationMap(np.zeros((60, 60)), np.zeros(2), 0.1)
    all_safe = np.full((60, 60), Safety.SAFE, dtype=np.uint8)
    options = HdaOptions(max_roughness_m=0.2, narrowest_hazard=2.0)
    coarse = Resolution(window_m=1.0, noise_m=0.0)
    # in the corners most of a footprint is off the map
    inside = (slice(10, 50), slice(10, 50))
    assert np.all(check_footprints(all_safe, ground, SHARP, options)[inside] == Safety.SAFE)
    assert np.all(check_footprints(all_safe, ground, coarse, options) == Safety.HAZARD)
