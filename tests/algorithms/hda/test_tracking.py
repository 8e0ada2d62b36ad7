"""Tests of feature selection and tracking: Eqs. 1-5 of the landing paper, and tracks against the exact scene."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import HdaOptions, TrackSeed
from marsyard.algorithms.hda.kernels import matching
from marsyard.algorithms.hda.scene import CameraView
from marsyard.algorithms.hda.tracking import (
    LevelSize,
    eigenvalue_test,
    level_sizes,
    select_features,
    track_features,
    window_half_px,
)
from marsyard.algorithms.image.correlation import pseudo_normalized_correlation
from marsyard.algorithms.image.peaks import biquadratic_offset, highest_peak
from marsyard.sim.frames import rigid
from tests.algorithms.hda.relief_scene import Pass, make_bumps, make_camera, make_plane, make_pose, render_image

OPTIONS = HdaOptions(block_px=32, align=True)


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (120, 160)).astype(np.uint16)


def test_interest_is_product_of_eigenvalue_excesses(noise: np.ndarray) -> None:
    image = noise.astype(np.float32)
    interest = eigenvalue_test(image, 11, 300.0)
    # Independent computation: loops over one template for gradients and sums.
    for row, column in ((20, 30), (60, 81), (100, 140)):
        patch = image[row - 6 : row + 7, column - 6 : column + 7].astype(np.float64)
        smooth_rows = patch[:-2] + 2.0 * patch[1:-1] + patch[2:]
        gradient_u = (smooth_rows[:, 2:] - smooth_rows[:, :-2]) / 8.0
        smooth_columns = patch[:, :-2] + 2.0 * patch[:, 1:-1] + patch[:, 2:]
        gradient_v = (smooth_columns[2:] - smooth_columns[:-2]) / 8.0
        gradients = np.stack([gradient_u.ravel(), gradient_v.ravel()])
        tensor = gradients @ gradients.T / gradients.shape[1]
        excess = np.linalg.eigvalsh(tensor) - 300.0
        expected = excess.prod() if excess.min() > 0.0 else -np.inf
        assert interest[row, column] == pytest.approx(expected, rel=1e-3)


def test_two_small_eigenvalues_are_not_a_feature() -> None:
    # The interest is P = (a - l)(c - l) - b^2 for the structure tensor [[a, b], [b, c]] and the threshold l (landing
    # paper, Eq. 2). P is also positive if both eigenvalues are below l; the condition a > l excludes this case.
    low_contrast = np.random.default_rng(2).integers(0, 3, (60, 60)).astype(np.float32)
    assert not np.any(np.isfinite(eigenvalue_test(low_contrast, 11, 50.0)))


def test_straight_edges_and_uniform_images_have_no_features() -> None:
    edge = np.tile((np.arange(160) // 20 % 2 * 200).astype(np.uint16), (120, 1))
    assert len(select_features(edge, OPTIONS)) == 0
    assert len(select_features(np.full((120, 160), 77, dtype=np.uint16), OPTIONS)) == 0


@pytest.mark.parametrize("seed", range(8))
def test_best_feature_of_each_block_is_selected(seed: int) -> None:
    """In some of the images a better feature lies just outside of the border."""
    counts = np.random.default_rng(seed).integers(0, 256, (150, 200)).astype(np.uint16)
    options = HdaOptions(block_px=40, align=True)
    features = select_features(counts, options)
    border = options.template_half_px + 1
    interest = eigenvalue_test(counts.astype(np.float32), 11, options.min_eigenvalue)
    expected = []
    for top in range(0, 150, 40):
        for left in range(0, 200, 40):
            rows = slice(max(top, border), min(top + 40, 150 - border))
            columns = slice(max(left, border), min(left + 40, 200 - border))
            block = interest[rows, columns]
            if block.size:
                row, column = np.unravel_index(int(block.argmax()), block.shape)
                expected.append((columns.start + column, rows.start + row))
    np.testing.assert_array_equal(features, expected)


def test_pyramid_levels_of_the_papers_window() -> None:
    # Landing paper, Table I: half widths of template t = 5 and window w = 40. Eq. 4 gives log2(40) - 2 = 3.3 levels
    # below full resolution. Half widths on the coarsest level by Eq. 5: 5 / 8 + 0.5 < 2 and 40 / 8 + 0.5 = 5.5.
    assert level_sizes(5, 40, (640, 480)) == (LevelSize(5, 2), LevelSize(3, 2), LevelSize(2, 2), LevelSize(2, 5))
    # A window that fits on one level is searched at full resolution.
    assert level_sizes(5, 6, (640, 480)) == (LevelSize(5, 6),)
    # Eq. 4 gives 7 levels for a window of 640 px; from level 5, with 15 rows, a template of 5 px exceeds a quarter.
    sizes = level_sizes(5, 640, (640, 480))
    assert sizes == (LevelSize(5, 2), LevelSize(3, 2), *[LevelSize(2, 2)] * 2, LevelSize(2, 40))


def make_view(columns: int = 320) -> CameraView:
    camera = make_camera(columns)
    counts = np.zeros(camera.size[::-1], dtype=np.uint16)
    return CameraView(counts, camera, rigid(Rotation.identity(), np.zeros(3)))


def test_window_contains_the_expected_displacement() -> None:
    """Baseline of 0.2 of the range and tilt of 3 deg: f (0.2 + tan 3 deg) on the axis."""
    options = HdaOptions(max_tilt_change_rad=np.deg2rad(3.0), max_roll_change_rad=0.0, max_height_change_fraction=0.0)
    view = make_view()
    expected = view.focal_px * (0.2 + np.tan(np.deg2rad(3.0)))
    assert window_half_px(view, options) == pytest.approx(expected, abs=1.0)
    assert window_half_px(make_view(640), options) == pytest.approx(2.0 * expected, abs=1.0)
    # a descent by a fifth magnifies the image by 1.25, which moves its corners by a quarter of their distance
    descent = replace(options, max_height_change_fraction=0.2, max_tilt_change_rad=0.0)
    assert window_half_px(view, descent) == pytest.approx(view.focal_px * 0.25 + 0.25 * np.hypot(160.0, 120.0), abs=1.0)
    # the paper's limits of rotation exceed the image
    assert window_half_px(make_view(640), HdaOptions()) == 640
    # from the poses, the parallax of ground that is higher by the depth margin: f 0.2 (1 / 0.8 - 1)
    from_poses = HdaOptions(track_seed=TrackSeed.POSE, depth_margin=0.2)
    assert window_half_px(view, from_poses) == pytest.approx(0.05 * view.focal_px, abs=1.0)
    assert window_half_px(view, replace(options, window_half_px=40)) == 40


def render_features(scene: Pass) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Render both images of a pass; also return the features of the first one, and their pixels in the second one."""
    first, second = (render_image(scene, i).counts for i in (0, 1))
    features = select_features(first, OPTIONS)
    return first, second, features, scene.camera(1).project(scene.ground(0, features))[0]


@pytest.mark.parametrize(
    ("second_pose", "window_half", "min_inside", "fraction"),
    [
        # A baseline of 0.2 of the range, that of the campaigns, moves the image by 81 of 320 px.
        ((0.0, -2.0, 10.0, 20.0), 102, 20, 0.8),
        ((0.0, -2.0, 10.0, 20.0), 320, 20, 0.7),
        # A pitch of 15 deg moves the image by 100 to 120 of its 240 rows; the search window is the whole image. From a
        # level at which the template covers most of the image, 0 and 0.6 of the features are tracked.
        ((0.0, -0.6, 10.0, 20.0, 15.0), 320, 30, 0.8),
        ((0.0, -0.6, 10.0, 20.0, -15.0), 320, 30, 0.8),
    ],
)
def test_large_displacements_are_tracked(
    second_pose: tuple[float, ...], window_half: int, min_inside: int, fraction: float
) -> None:
    """The search starts at the first position."""
    scene = make_pass(second_pose)
    first, second, features, true_pixels = render_features(scene)
    is_inside = np.all((true_pixels > 12) & (true_pixels < np.array([307, 227])), axis=1)
    tracks = track_features(first, second, features, features, window_half, replace(OPTIONS, align=False))
    is_correct = tracks.accepted & (np.hypot(*(tracks.second - true_pixels).T) < 1.0)
    assert is_inside.sum() >= min_inside
    assert np.mean(is_correct[is_inside]) >= fraction
    narrow = track_features(first, second, features, features, 40, replace(OPTIONS, align=False))
    assert np.sum(narrow.accepted & (np.hypot(*(narrow.second - true_pixels).T) < 1.0)) < 0.2 * is_inside.sum()


def test_correlation_peak_matches_shared_operators(noise: np.ndarray) -> None:
    first = noise.astype(np.float32)
    second = 0.8 * np.roll(first, (2, -3), axis=(0, 1)) + 31.0
    template, window = first[40:51, 60:71], second[32:63, 50:77]
    surface = pseudo_normalized_correlation(template, window)
    actual = [
        [matching.correlation(first, second, 45, 65, 37 + row, 55 + column, 5) for column in range(surface.shape[1])]
        for row in range(surface.shape[0])
    ]
    np.testing.assert_allclose(actual, surface, atol=1e-6)
    peak = highest_peak(surface)
    z = surface[peak.row - 1 : peak.row + 2, peak.column - 1 : peak.column + 2]
    np.testing.assert_allclose(matching.fit_biquadratic_peak(z)[:2], biquadratic_offset(surface, peak), atol=1e-12)


def make_pass(second: tuple[float, ...] = (0.2, -0.6, 10.05, 21.5, 0.5, -0.8)) -> Pass:
    """Create a pass at 10 m over a slope with a bump; `second` contains the arguments of `make_pose`."""
    return Pass(
        make_bumps((1.2, 0.8, 0.4, 0.3), base=make_plane(0.05, 0.02)),
        (make_pose(0.0, 0.0, 10.0, 20.0), make_pose(*second)),
    )


def test_tracks_over_relief_match_exact_scene() -> None:
    scene = make_pass()
    first, second, features, true_pixels = render_features(scene)
    unaligned, aligned = (
        track_features(first, second, features, features, 40, replace(OPTIONS, align=align)) for align in (False, True)
    )
    assert aligned.accepted.sum() >= 40
    is_correct = aligned.accepted & (np.hypot(*(unaligned.second - true_pixels).T) < 1.0)
    assert is_correct.sum() >= 0.95 * aligned.accepted.sum()
    # The biquadratic fit is biased by up to 0.09 px. After alignment, the remaining errors come from rounding to
    # counts and from relief.
    assert np.sqrt(np.mean((unaligned.second - true_pixels)[is_correct] ** 2)) < 0.1
    assert np.sqrt(np.mean((aligned.second - true_pixels)[is_correct] ** 2)) < 0.015


@pytest.mark.slow
@pytest.mark.parametrize(
    "second",
    [
        (0.0, -0.6, 7.7, 20.0),
        (0.0, -0.6, 12.0, 20.0),
        (0.0, -0.6, 10.0, 30.0),
        (0.0, -0.6, 10.0, 20.0, 20.0),
        (0.0, -0.6, 10.0, 20.0, 0.0, 20.0),
    ],
    ids=["lower by 23 %", "higher by 20 %", "yaw + 10 deg", "pitch + 20 deg", "roll + 20 deg"],
)
def test_largest_changes_of_the_paper_are_tracked(second: tuple[float, ...]) -> None:
    """At least 90 % of the features in both images are tracked for the pose changes of section II.A, landing paper."""
    rng = np.random.default_rng(5)
    boulders = [(*rng.uniform(-3.0, 3.0, 2), rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.3)) for _ in range(30)]
    scene = Pass(make_bumps(*boulders), (make_pose(0.0, 0.0, 10.0, 20.0), make_pose(*second)))
    first, second_image, features, true_pixels = render_features(scene)
    # at least 12 px inside the second image of 320 x 240 pixels
    is_visible = np.all((true_pixels >= 12.0) & (true_pixels <= np.array([307.0, 227.0])), axis=1)
    tracks = track_features(first, second_image, features, true_pixels + 3.0, 40, OPTIONS)
    is_correct = tracks.accepted & (np.hypot(*(tracks.second - true_pixels).T) < 1.0)
    assert is_visible.sum() >= 15
    assert np.mean(is_correct[is_visible]) >= 0.9
    # One or two features that left the image may match similar ground.
    assert np.sum(tracks.accepted & ~is_correct) <= 2


def test_tracks_near_boulders_are_correct_or_rejected() -> None:
    rng = np.random.default_rng(5)
    boulders = [(*rng.uniform(-3.0, 3.0, 2), rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.3)) for _ in range(20)]
    scene = Pass(make_bumps(*boulders), (make_pose(0.0, 0.0, 10.0, 20.0), make_pose(0.1, -0.7, 10.1, 21.0, 1.0, 1.0)))
    first, second, features, true_pixels = render_features(scene)
    unaligned, aligned = (
        track_features(first, second, features, features, 40, replace(OPTIONS, align=align)) for align in (False, True)
    )
    is_wrong = np.hypot(*(aligned.second - true_pixels).T) > 0.5
    # Correlation alone would accept features that left the image and occluding edges.
    assert np.sum(unaligned.accepted & is_wrong) >= 3
    assert np.sum(aligned.accepted & is_wrong) <= 1
    assert np.sum(aligned.accepted) > 40


def test_positions_whose_window_leaves_an_image_are_not_refined() -> None:
    image = np.random.default_rng(3).integers(0, 255, (40, 40)).astype(np.uint16)
    positions, shifts = np.array([[2, 20], [20, 37], [20, 20]]), np.array([[10, 0], [0, -10], [0, 0]])
    pixels, correlations = matching.refine_positions(image, image, positions, shifts, 5)
    assert np.isnan(pixels[:2]).all()
    assert np.isnan(correlations[:2]).all()
    np.testing.assert_allclose(pixels[2], [20.0, 20.0], atol=0.5)


def test_biquadratic_peak_is_exact_for_a_quadric() -> None:
    row, column = np.mgrid[-1.0:2.0, -1.0:2.0]
    z = 0.9 - 0.3 * (row - 0.2) ** 2 - 0.2 * (column + 0.35) ** 2 - 0.1 * (row - 0.2) * (column + 0.35)
    np.testing.assert_allclose(matching.fit_biquadratic_peak(z), (0.2, -0.35, 0.9), atol=1e-12)


def test_features_leaving_the_image_are_rejected() -> None:
    scene = make_pass((0.0, -1.0, 10.0, 20.0))
    first, second, features, true_pixels = render_features(scene)
    tracks = track_features(first, second, features, features, 60, OPTIONS)
    is_outside = ~make_camera().in_frame(true_pixels)
    assert is_outside.sum() >= 3
    assert not np.any(tracks.accepted & is_outside)


@pytest.mark.parametrize("shift", [(0, 0), (7, -4), (-38, 33), (40, 40)])
def test_integer_shifts_within_the_window_are_recovered(shift: tuple[int, int]) -> None:
    # Coarse levels need image content at all scales.
    rng = np.random.default_rng(4)
    spectrum = np.fft.rfft2(rng.standard_normal((240, 320)))
    frequency = np.hypot(np.fft.fftfreq(240)[:, None], np.fft.rfftfreq(320)[None])
    frequency[0, 0] = np.inf
    values = np.fft.irfft2(spectrum / frequency, (240, 320))
    first = np.rint(500.0 + 100.0 * values / values.std()).clip(0, 4095).astype(np.uint16)
    second = np.roll(first, shift[::-1], axis=(0, 1))
    features = select_features(first, OPTIONS)
    # Only features that are not affected by the periodic border.
    features = features[np.all((features > 60) & (features < np.array([260, 180])), axis=1)]
    tracks = track_features(first, second, features, features, 40, replace(OPTIONS, align=False))
    assert len(features) > 10
    # The biquadratic fit is biased on texture as fine as pixels.
    is_correct = np.all(np.abs(tracks.second - features - shift) < 0.3, axis=1)
    assert is_correct.mean() > 0.9
    assert np.all(tracks.correlations[is_correct] > 0.98)


def test_search_starts_at_predicted_positions() -> None:
    scene = make_pass((0.0, -1.8, 10.0, 20.0))
    first, second, features, true_pixels = render_features(scene)
    is_inside = np.all((true_pixels > 30) & (true_pixels < np.array([290, 210])), axis=1)
    # Features move by at least 70 px: without a prediction they leave the search window.
    unpredicted = track_features(first, second, features, features, 40, OPTIONS)
    predicted = track_features(first, second, features, true_pixels + 9.0, 40, OPTIONS)
    assert np.mean(np.hypot(*(unpredicted.second - true_pixels).T)[is_inside] < 1.0) < 0.1
    assert np.mean(np.hypot(*(predicted.second - true_pixels).T)[is_inside] < 1.0) > 0.9
