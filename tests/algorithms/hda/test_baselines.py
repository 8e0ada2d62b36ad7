"""The rectification that semi-global matching needs, and OpenCV's motion, against the exact scene."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import HdaOptions
from marsyard.algorithms.hda.baselines import (
    SemiGlobalEstimator,
    essential_motion,
    rectify_views,
    semi_global_structure,
)
from marsyard.algorithms.hda.estimator import motion_from_tracks
from marsyard.algorithms.hda.motion import LandingScene, build_scene
from marsyard.algorithms.hda.tracking import select_features, track_features
from marsyard.algorithms.interface import SiteOutcome
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import LandingMeasurements
from tests.algorithms.hda.relief_scene import Pass, bumps, measured, plane, pose

OPTIONS = HdaOptions(block_px=32, grid_px=8)


def scene(second: tuple[float, ...] = (0.25, -0.65, 10.1, 23.0, 1.0, -1.5)) -> Pass:
    relief = bumps((1.2, 0.8, 0.4, 0.3), (-1.5, -1.0, 0.3, 0.2), base=plane(0.05, 0.02))
    return Pass(relief, (pose(0.0, 0.0, 10.0, 20.0), pose(*second)))


@pytest.fixture(scope="module")
def exact() -> LandingMeasurements:
    return measured(scene())


@pytest.fixture(scope="module")
def seen(exact: LandingMeasurements) -> LandingScene:
    return build_scene(exact)


def test_rectified_pictures_share_rows_and_disparity_is_inverse_depth(seen: LandingScene) -> None:
    moved = scene().second_from_first
    pair = rectify_views(seen.views, moved)
    assert pair is not None
    rng = np.random.default_rng(1)
    points = rng.uniform([-2.0, -2.0, 8.0], [2.0, 2.0, 12.0], (50, 3))
    first = pair.rectified_from_first.apply(points)
    # The second camera has the same axes and lies a baseline along the columns.
    second = pair.rectified_from_first.apply(moved.inv().apply(moved.apply(points)) - moved.inv().translation)
    (u1, v1), (u2, v2) = (pair.camera.project(p)[0].T for p in (first, second))
    np.testing.assert_allclose(v1, v2, atol=1e-9)
    np.testing.assert_allclose(u1 - u2, pair.focal_px * pair.baseline_m / first[:, 2], rtol=1e-9)


def test_semi_global_depths_are_those_of_the_exact_scene(seen: LandingScene) -> None:
    features = select_features(seen.views[0].counts, OPTIONS)
    tracks = track_features(seen.views[0].counts, seen.views[1].counts, features, features, OPTIONS)
    motion = motion_from_tracks(seen, tracks, OPTIONS)
    true = scene()
    motion = motion.scaled(
        float(np.linalg.norm(true.second_from_first.translation))
        / float(np.linalg.norm(motion.second_from_first.translation))
    )
    matches = semi_global_structure(seen, motion, OPTIONS)
    one = true.camera(0)
    depths = (true.ground(0, matches.first) - one.c) @ one.a
    assert matches.accepted.mean() > 0.9
    # 33 px of disparity at 10 m: a third of a pixel is 0.1 m; a grid pixel takes the nearest rectified one's disparity.
    assert np.sqrt(np.mean((matches.depths - depths)[matches.accepted] ** 2)) < 0.1


def test_the_essential_matrix_gives_the_motion_that_least_squares_gives(seen: LandingScene) -> None:
    features = select_features(seen.views[0].counts, OPTIONS)
    tracks = track_features(seen.views[0].counts, seen.views[1].counts, features, features, OPTIONS)
    found = essential_motion(seen, tracks, OPTIONS)
    assert found is not None
    true = scene().second_from_first
    assert np.rad2deg((found.second_from_first.rotation * true.rotation.inv()).magnitude()) < 0.2
    ours, theirs = (t / np.linalg.norm(t) for t in (found.second_from_first.translation, true.translation))
    assert ours @ theirs > np.cos(np.deg2rad(2.0))


def test_motion_along_the_axis_cannot_be_rectified(seen: LandingScene) -> None:
    ahead = rigid(Rotation.identity(), np.array([0.0, 0.0, -1.0]))
    assert rectify_views(seen.views, ahead) is None


def test_a_straight_descent_has_no_semi_global_structure() -> None:
    given = measured(scene((0.0, 0.0, 8.6, 20.0)))
    found = SemiGlobalEstimator(OPTIONS).estimate(given)
    assert found.outcome in (SiteOutcome.NO_STRUCTURE, SiteOutcome.NO_MOTION)
    np.testing.assert_array_equal(found.site_world, given.apriori_site_world)
