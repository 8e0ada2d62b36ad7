"""Tests of the baselines of hazard detection: rectification, semi-global matching, and OpenCV's essential matrix."""

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
from marsyard.algorithms.hda.scene import LandingScene, build_scene
from marsyard.algorithms.hda.tracking import Tracks, select_features, track_features
from marsyard.algorithms.interface import SiteOutcome
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import LandingMeasurements
from tests.algorithms.hda.relief_scene import Pass, make_bumps, make_plane, make_pose, measure_pass

OPTIONS = HdaOptions(block_px=32, grid_px=8, align=True, refine_planes=True)


def make_scene(second: tuple[float, ...] = (0.25, -0.65, 10.1, 23.0, 1.0, -1.5)) -> Pass:
    """Create a pass at 10 m over a slope with two bumps; `second` contains the arguments of `make_pose`."""
    relief = make_bumps((1.2, 0.8, 0.4, 0.3), (-1.5, -1.0, 0.3, 0.2), base=make_plane(0.05, 0.02))
    return Pass(relief, (make_pose(0.0, 0.0, 10.0, 20.0), make_pose(*second)))


@pytest.fixture(scope="module")
def measurements() -> LandingMeasurements:
    return measure_pass(make_scene())


@pytest.fixture(scope="module")
def landing_scene(measurements: LandingMeasurements) -> LandingScene:
    return build_scene(measurements)


@pytest.fixture(scope="module")
def tracks(landing_scene: LandingScene) -> Tracks:
    features = select_features(landing_scene.views[0].counts, OPTIONS)
    first, second = (view.counts for view in landing_scene.views)
    return track_features(first, second, features, features, 40, OPTIONS)


@pytest.mark.slow
def test_rectified_points_have_equal_rows_and_inverse_depth_disparity(landing_scene: LandingScene) -> None:
    true_motion = make_scene().second_from_first
    pair = rectify_views(landing_scene.views, true_motion)
    rng = np.random.default_rng(1)
    points = rng.uniform([-2.0, -2.0, 8.0], [2.0, 2.0, 12.0], (50, 3))
    first = pair.rectified_from_first.apply(points)
    # Both cameras have the same axes; the baseline is along the columns.
    second = pair.rectified_from_first.apply(points - true_motion.inv().translation)
    (u1, v1), (u2, v2) = (pair.camera.project(p)[0].T for p in (first, second))
    np.testing.assert_allclose(v1, v2, atol=1e-9)
    np.testing.assert_allclose(u1 - u2, pair.focal_px * pair.baseline_m / first[:, 2], rtol=1e-9)


@pytest.mark.slow
def test_semi_global_depths_match_exact_scene(landing_scene: LandingScene, tracks: Tracks) -> None:
    motion = motion_from_tracks(landing_scene, tracks, OPTIONS)
    scene = make_scene()
    # Scale the baseline, whose length is not determined by images, to its true length.
    motion = motion.scale(
        float(np.linalg.norm(scene.second_from_first.translation))
        / float(np.linalg.norm(motion.second_from_first.translation))
    )
    matches = semi_global_structure(landing_scene, motion, OPTIONS)
    first_camera = scene.camera(0)
    depths = (scene.ground(0, matches.first) - first_camera.c) @ first_camera.a
    assert matches.accepted.mean() > 0.9
    # The disparity is 33 px at 10 m: a third of a pixel is 0.1 m. Grid pixels use the disparity of the nearest
    # rectified pixel.
    assert np.sqrt(np.mean((matches.depths - depths)[matches.accepted] ** 2)) < 0.1


@pytest.mark.slow
def test_essential_matrix_motion_matches_exact_scene(landing_scene: LandingScene, tracks: Tracks) -> None:
    result = essential_motion(landing_scene, tracks, OPTIONS)
    true_motion = make_scene().second_from_first
    assert np.rad2deg((result.second_from_first.rotation * true_motion.rotation.inv()).magnitude()) < 0.2
    actual, expected = (t / np.linalg.norm(t) for t in (result.second_from_first.translation, true_motion.translation))
    assert actual @ expected > np.cos(np.deg2rad(2.0))


def test_motion_along_optical_axis_cannot_be_rectified(landing_scene: LandingScene) -> None:
    axial_motion = rigid(Rotation.identity(), np.array([0.0, 0.0, -1.0]))
    assert rectify_views(landing_scene.views, axial_motion) is None


@pytest.mark.slow
def test_vertical_descent_has_no_semi_global_structure() -> None:
    measurements = measure_pass(make_scene((0.0, 0.0, 8.6, 20.0)))
    result = SemiGlobalEstimator(OPTIONS).estimate(measurements)
    assert result.outcome in (SiteOutcome.NO_STRUCTURE, SiteOutcome.NO_MOTION)
    np.testing.assert_array_equal(result.site_world, measurements.apriori_site_world)
