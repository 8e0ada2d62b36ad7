"""Tests of the map-relative estimator and baselines on a descent: sequence of stages, refusals and restart.

The matching stages are replaced by functions with given results (`Stages`), or run on a small synthetic map.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation import estimator as estimator_module
from marsyard.algorithms.localisation.baselines import FeatureEstimator, InertialEstimator
from marsyard.algorithms.localisation.coarse import CoarseFix, CoarseRefusal
from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.estimator import MapRelativeEstimator
from marsyard.algorithms.localisation.fine import LandmarkMatches
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import AltitudeMeasurement
from tests.algorithms.localisation.synthetic_flight import (
    ATTITUDE,
    ERROR_M,
    FLAT_MAP,
    START_M,
    descend,
    list_outcomes,
    make_image,
    make_images,
    make_increments,
    make_initial,
    position_error_m,
    true_position,
)

NO_COARSE_FIX, INCONSISTENT = PositionOutcome.NO_COARSE_FIX, PositionOutcome.INCONSISTENT
UNCERTAIN, VALID = PositionOutcome.UNCERTAIN, PositionOutcome.VALID


# --- stages with given results -----------------------------------------------------------------------------------


def _rotation(vector: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(vector)


class Stages:
    """Replacements of both matching stages: they return the next result of a list, and record their inputs.

    - coarse: offsets (east, north) of the coarse fixes, or refusals
    - fine: whether landmarks are found; or the attitude error (rotation vector) with which they are projected
    """

    def __init__(self, coarse: list[np.ndarray | CoarseRefusal], fine: list[bool | np.ndarray]) -> None:
        self.coarse, self.fine = coarse, fine
        self.coarse_images: list[tuple[PosedImage, ...]] = []
        self.heights_m: list[tuple[float, ...]] = []

    def find_coarse_position(
        self, images: tuple[PosedImage, ...], heights_m: tuple[float, ...], *_: object
    ) -> CoarseFix | CoarseRefusal:
        """Return the next coarse fix with a standard deviation of 10 m, or refusal."""
        self.coarse_images.append(images)
        self.heights_m.append(heights_m)
        result = self.coarse.pop(0)
        if isinstance(result, CoarseRefusal):
            return result
        return CoarseFix(result, 100.0 * np.eye(2))

    def match_landmarks(self, image: PosedImage, *_: object) -> LandmarkMatches:
        """Return the exact pixels of a grid of points on the flat map, or no match."""
        lines = np.arange(-600.0, 601.0, 200.0)
        east, north = np.meshgrid(START_M[0] + lines, START_M[1] + lines)
        points = np.stack([east.ravel(), north.ravel(), np.zeros(east.size)], axis=-1)
        result = self.fine.pop(0)
        turn, is_found = (Rotation.identity(), result) if isinstance(result, bool) else (_rotation(result), True)
        camera = image.camera.transform(rigid(turn * ATTITUDE, true_position(image.time_s)))
        pixels, visible = camera.project(points)
        found = visible & camera.in_frame(pixels) & is_found
        points, pixels = points[found], pixels[found]
        count, zero = len(points), np.zeros(3)
        return LandmarkMatches(points, pixels, np.ones(count), np.zeros((count, 2)), 1, 49, count, zero, zero)


@pytest.fixture
def make_stages(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Stages]:
    """Return a function that replaces the stages of the estimator."""

    def make(coarse: list[np.ndarray | CoarseRefusal], fine: list[bool | np.ndarray]) -> Stages:
        stages = Stages(coarse, fine)
        monkeypatch.setattr(estimator_module, "find_coarse_position", stages.find_coarse_position)
        monkeypatch.setattr(estimator_module, "match_landmarks", stages.match_landmarks)
        return stages

    return make


def _horizontal_sd_m(estimate: PositionEstimate) -> float:
    assert estimate.covariance is not None
    return float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1]))


def _check_error(estimate: PositionEstimate) -> None:
    """Exact landmarks: the error, from the weight of the prior, is below the reported deviation.

    A pixel of the small image is 40 m on the ground, with a standard deviation of 0.3 pixels for some 40 landmarks.
    """
    assert estimate.covariance is not None
    assert position_error_m(estimate) < min(np.sqrt(np.trace(estimate.covariance[:3, :3])), 2.0)


def test_no_position_before_three_images(make_stages: Callable[..., Stages]) -> None:
    stages = make_stages([ERROR_M[:2]], [True, True])
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(4)))
    assert list_outcomes(estimates) == [NO_COARSE_FIX, NO_COARSE_FIX, VALID, VALID, VALID]
    assert [estimate.time_s for estimate in estimates] == [1.0, 2.0, 3.0, 4.0, 4.0]
    assert [image.time_s for image in stages.coarse_images[0]] == [1.0, 2.0, 3.0]
    for estimate in estimates[2:]:
        _check_error(estimate)
    details = estimates[2].details
    assert isinstance(details, LocalisationDetails)
    assert details.inliers is not None
    assert details.inliers > 20
    assert details.coarse_position_m is not None
    np.testing.assert_allclose(details.coarse_position_m, true_position(3.0)[:2], atol=1e-6)


def test_altitudes_before_the_fix_refer_to_the_ground_below_the_fix(make_stages: Callable[..., Stages]) -> None:
    """A step of 100 m lies between the initial and the true positions."""
    elevation = np.zeros((300, 300), np.float32)
    east_m = FLAT_MAP.origin_m[0] + FLAT_MAP.pixel_m * np.arange(300)
    elevation[:, east_m < START_M[0] - 0.5 * ERROR_M[0]] = 100.0
    make_stages([ERROR_M[:2]], [True])
    estimator = MapRelativeEstimator()
    list(descend(estimator, replace(FLAT_MAP, elevation_m=elevation), make_images(3)))
    state = estimator._filter.state_at(2.0)
    # the altitudes reduce the initial height error of 15 m; at the initial position they would be 100 m too large
    assert abs(state.position_m[2] - true_position(2.0)[2]) < 15.0


def test_coarse_stage_is_not_run_without_an_altitude(make_stages: Callable[..., Stages]) -> None:
    make_stages([], [])
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(4), with_altitudes=False))
    assert set(list_outcomes(estimates)) == {NO_COARSE_FIX}


def test_refused_coarse_stage_is_repeated_with_the_last_three_images(make_stages: Callable[..., Stages]) -> None:
    stages = make_stages([CoarseRefusal.AMBIGUOUS, CoarseRefusal.NO_CONSENSUS, ERROR_M[:2]], [True])
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(5)))
    assert list_outcomes(estimates) == [NO_COARSE_FIX] * 4 + [VALID] * 2
    times = [[image.time_s for image in images] for images in stages.coarse_images]
    assert times == [[1.0, 2.0, 3.0], [2.0, 3.0, 4.0], [3.0, 4.0, 5.0]]


def test_position_is_uncertain_between_coarse_fix_and_first_match(make_stages: Callable[..., Stages]) -> None:
    make_stages([ERROR_M[:2]], [False, True, False, False])
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(6)))
    # after a match, two images without one: the state is propagated
    assert list_outcomes(estimates) == [NO_COARSE_FIX, NO_COARSE_FIX, UNCERTAIN, VALID, VALID, VALID, VALID]
    assert all(estimate.position_m is None for estimate in estimates[:3])
    for estimate in estimates[3:]:
        _check_error(estimate)


def test_wrong_fix_is_discarded_and_the_coarse_stage_restarts(make_stages: Callable[..., Stages]) -> None:
    wrong = ERROR_M[:2] + np.array([-160.0, 90.0])
    stages = make_stages([wrong, ERROR_M[:2]], [False, False, False, True])
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(8)))
    expected = [NO_COARSE_FIX, NO_COARSE_FIX, UNCERTAIN, UNCERTAIN, INCONSISTENT, NO_COARSE_FIX, NO_COARSE_FIX, VALID]
    assert list_outcomes(estimates) == [*expected, VALID]
    # the images of the second search are those after the wrong fix, at the positions of inertial navigation
    assert [image.time_s for image in stages.coarse_images[1]] == [6.0, 7.0, 8.0]
    for image in stages.coarse_images[1]:
        # tolerance: rounding of the sums of 800 increments
        np.testing.assert_allclose(image.position_m, true_position(image.time_s) - ERROR_M, atol=1e-6)
    _check_error(estimates[-1])


@pytest.mark.parametrize(("error_m", "fine"), [([-160.0, 0.0], True), ([0.0, 150.0], np.radians([5.0, 0.0, 0.0]))])
def test_contradicting_landmarks_are_failures(
    error_m: list[float], fine: bool | np.ndarray, make_stages: Callable[..., Stages]
) -> None:
    """Exact landmarks after a coarse fix that is wrong by 16 standard deviations: no position is reported.

    Or all landmarks show a tilt of 5 deg, 87 standard deviations; a subset near the nadir fits the wrong state.
    """
    make_stages([ERROR_M[:2] + np.array(error_m)], [fine] * 3)
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(5)))
    assert list_outcomes(estimates) == [NO_COARSE_FIX] * 2 + [INCONSISTENT] * 3 + [NO_COARSE_FIX]


def test_no_position_after_contradicting_landmarks_until_the_next_update(make_stages: Callable[..., Stages]) -> None:
    """The covariance is below the limit throughout, and the last update is recent: only the contradiction matters."""
    turned = np.radians([5.0, 0.0, 0.0])
    make_stages([ERROR_M[:2]], [True, True, turned, False, True])
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(7)))
    assert list_outcomes(estimates) == [NO_COARSE_FIX] * 2 + [VALID] * 2 + [INCONSISTENT] * 2 + [VALID] * 2
    assert estimates[4].position_m is None
    _check_error(estimates[6])


def test_position_without_a_recent_update_is_uncertain(make_stages: Callable[..., Stages]) -> None:
    """The last update is at 3 s: the position is reported until 8 s, with any number of images without a match."""
    make_stages([ERROR_M[:2]], [True, *[False] * 6])
    options = LvsOptions(max_failures=100, max_position_sd_m=1000.0)
    estimates = list(descend(MapRelativeEstimator(options), FLAT_MAP, make_images(9)))
    assert [estimate.time_s for estimate in estimates[-3:]] == [8.0, 9.0, 9.0]
    assert list_outcomes(estimates) == [NO_COARSE_FIX] * 2 + [VALID] * 6 + [UNCERTAIN] * 2


def test_position_whose_covariance_grows_above_the_limit_is_uncertain(make_stages: Callable[..., Stages]) -> None:
    """Without a match the standard deviation of the position grows by that of the velocity, 0.1 m/s before updates."""
    make_stages([ERROR_M[:2]], [True, *[False] * 5])
    estimates = list(descend(MapRelativeEstimator(LvsOptions(max_failures=100)), FLAT_MAP, make_images(8)))
    assert set(list_outcomes(estimates[2:])) == {VALID}
    deviations = [_horizontal_sd_m(estimate) for estimate in estimates[2:]]
    assert np.all(np.diff(deviations[:-1]) > 0.0)
    make_stages([ERROR_M[:2]], [True, *[False] * 5])
    options = LvsOptions(max_failures=100, max_position_sd_m=0.5 * (deviations[2] + deviations[3]))
    limited = list(descend(MapRelativeEstimator(options), FLAT_MAP, make_images(8)))
    assert list_outcomes(limited[2:]) == [VALID] * 3 + [UNCERTAIN] * 4


@pytest.mark.parametrize("make_estimator", [MapRelativeEstimator, InertialEstimator, FeatureEstimator])
@pytest.mark.parametrize("has_fix", [False, True])
def test_measurements_outside_of_the_inertial_data_are_not_used(
    make_estimator: type[InertialEstimator | MapRelativeEstimator], has_fix: bool, make_stages: Callable[..., Stages]
) -> None:
    """Time tags before the initial state, older than the filter's memory of 5 s, and after the last increment."""
    make_stages([ERROR_M[:2]], [True, True])
    estimator = make_estimator()
    estimator.start(make_initial(), FLAT_MAP)
    images = [1.0, 2.0, 3.0] if has_fix else [1.0]
    previous_s = 0.0
    for time_s in images:
        estimator.process_increments(make_increments(previous_s, time_s))
        previous_s = time_s
        estimator.process_altitude(AltitudeMeasurement(float(true_position(time_s)[2]), time_s))
        estimator.process_image(make_image(time_s, np.ones((64, 64))))
    estimator.process_increments(make_increments(previous_s, 8.0))
    before = estimator.finish()
    for time_s in (-0.5, 1.5, 8.5):
        # an altitude of 1 m would give a wrong scale and a wrong height
        estimator.process_altitude(AltitudeMeasurement(1.0, time_s))
        answer = estimator.process_image(make_image(time_s, np.ones((64, 64))))
        assert answer.outcome is PositionOutcome.OUTSIDE_INERTIAL_DATA
        assert answer.position_m is None
        assert answer.time_s == 8.0
    after = estimator.finish()
    assert after.outcome is before.outcome
    if before.position_m is not None:
        np.testing.assert_array_equal(after.position_m, before.position_m)


@pytest.mark.parametrize("name", ["coarse_images", "coarse_altitudes", "acquisition_landmarks"])
def test_numbers_of_images_altitudes_and_landmarks_are_positive(name: str) -> None:
    options: dict[str, Any] = {name: 0}
    with pytest.raises(ValueError, match=f"{name} is 0; it must be at least 1"):
        LvsOptions(**options)


@pytest.mark.parametrize("make_estimator", [MapRelativeEstimator, InertialEstimator, FeatureEstimator])
@pytest.mark.parametrize("altitude_m", [0.0, -3.0, np.nan])
def test_altitudes_that_are_not_positive_give_no_fix(
    make_estimator: type[InertialEstimator | MapRelativeEstimator], altitude_m: float
) -> None:
    estimator = make_estimator()
    estimator.start(make_initial(), FLAT_MAP)
    for number, image in enumerate(make_images(4)):
        estimator.process_increments(make_increments(float(number), image.time_s))
        estimator.process_altitude(AltitudeMeasurement(altitude_m, image.time_s))
        expected = VALID if make_estimator is InertialEstimator else NO_COARSE_FIX
        assert estimator.process_image(image).outcome is expected


def test_ignored_altitude_does_not_set_the_scale_of_the_coarse_stage(make_stages: Callable[..., Stages]) -> None:
    stages = make_stages([CoarseRefusal.NO_CONSENSUS], [])
    estimator = MapRelativeEstimator()
    estimator.start(make_initial(), FLAT_MAP)
    previous_s = 0.0
    for image in make_images(3):
        estimator.process_increments(make_increments(previous_s, image.time_s))
        previous_s = image.time_s
        estimator.process_altitude(AltitudeMeasurement(float(true_position(image.time_s)[2]), image.time_s))
        estimator.process_altitude(AltitudeMeasurement(1.0, image.time_s + 0.5))
        estimator.process_image(image)
    expected = [true_position(image.time_s)[2] for image in make_images(3)]
    np.testing.assert_allclose(stages.heights_m[0], expected, atol=1e-6)


def test_max_failures_sets_the_number_of_images(make_stages: Callable[..., Stages]) -> None:
    make_stages([ERROR_M[:2]], [True, False])
    estimates = list(descend(MapRelativeEstimator(LvsOptions(max_failures=1)), FLAT_MAP, make_images(5)))
    assert list_outcomes(estimates) == [NO_COARSE_FIX, NO_COARSE_FIX, VALID, INCONSISTENT, NO_COARSE_FIX, NO_COARSE_FIX]


def test_improbable_coarse_fix_does_not_change_the_state(make_stages: Callable[..., Stages]) -> None:
    """The filter rejects a fix 8 standard deviations from the narrow axis of the prior; later images are processed."""
    initial = make_initial(covariance=np.diag([1e4, 100.0, 400.0, *[0.01] * 3, *[1e-6] * 3]))
    stages = make_stages([np.array([0.0, 120.0]), np.array([30.0, 120.0]), np.array([110.0, -10.0])], [False])
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(5), initial))
    assert list_outcomes(estimates) == [NO_COARSE_FIX] * 4 + [UNCERTAIN] * 2
    assert estimates[-1].time_s == 5.0
    np.testing.assert_allclose(stages.coarse_images[2][-1].position_m, true_position(5.0) - ERROR_M, atol=1e-6)


def test_start_resets_the_estimator(make_stages: Callable[..., Stages]) -> None:
    estimator = MapRelativeEstimator()
    make_stages([ERROR_M[:2]], [True])
    first = list(descend(estimator, FLAT_MAP, make_images(3)))
    make_stages([ERROR_M[:2]], [True])
    second = list(descend(estimator, FLAT_MAP, make_images(3)))
    assert list_outcomes(second) == list_outcomes(first)
    assert first[-1].position_m is not None
    np.testing.assert_array_equal(second[-1].position_m, first[-1].position_m)


def test_landmarks_of_a_wrong_attitude_never_update_the_state(make_stages: Callable[..., Stages]) -> None:
    """All landmarks show a tilt of 5 deg, 87 standard deviations; a subset near the nadir fits the wrong state."""
    make_stages([ERROR_M[:2] + np.array([0.0, 150.0])], [np.radians([5.0, 0.0, 0.0])] * 3)
    estimates = list(descend(MapRelativeEstimator(), FLAT_MAP, make_images(5)))
    assert list_outcomes(estimates) == [NO_COARSE_FIX] * 2 + [INCONSISTENT] * 3 + [NO_COARSE_FIX]
