"""Tests of complete localisation cases on a small terrain: repeatability, accuracy, faults, and invalid parameters.

The rows of all cases are checked against the declared columns (tests/scenarios/conftest.py).
"""

from functools import cache
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.scenarios.condition_columns import contrast_columns, off_nadir_deg
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.scenarios.localisation.scenario import LocalisationScenario
from marsyard.scenarios.localisation.score import conditions
from marsyard.scenarios.localisation.simulation import INERTIAL_LEAD_S, LocalisedDescent
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.instrument import Clock, ClockParameters
from marsyard.sim.streams import Streams

#: A terrain of 4.1 km, a map of 2.7 km, and five seconds from 1600 to 1150 m with four images of 10 to 14 m per pixel.
SMALL: dict[str, Any] = {
    "site": "crater-floor",
    "location": {"bank": 2, "east_m": 2048.0, "north_m": 2048.0},
    "terrain": {"samples": 1024},
    "map": {"side_px": 448},
    "camera": {"pixels": 192, "pixel_mrad": 8.9},
    "flight": {"altitude_start_m": 1600.0, "altitude_separation_m": 1100.0, "altitude_end_m": 1050.0},
    "images": {"coarse_interval_s": 1.5, "interval_s": 2.5},
    "initial": {"horizontal_sd_m": 100.0, "horizontal_max_m": 300.0},
}
#: A smaller map and camera, for tests that do not need an accurate position.
COARSE: dict[str, Any] = {"map": {"side_px": 64}, "camera": {"pixels": 64, "pixel_mrad": 26.0}}
#: A map without errors of position and elevation.
EXACT_MAP = {"registration_sd_m": 0.0, "distortion_sd_m": 0.0, "elevation_sd_m": 0.0, "elevation_post_m": 0.0}


def _make_parameters(**changes: Any) -> LocalisationScenarioParameters:
    return LocalisationScenarioParameters.model_validate({**SMALL, **changes})


def _run(case: int = 0, **changes: Any) -> CaseResult:
    return LocalisationScenario().run(_make_parameters(**changes), Streams(1, "loc tests", case))


@cache
def _simulate_fault(name: str, size: float) -> LocalisedDescent:
    parameters = _make_parameters(**COARSE, faults={name: size} if name else {})
    return LocalisedDescent.simulate(parameters, Streams(1, "loc tests", 0))


def _simulate(**fault: float) -> LocalisedDescent:
    """Simulate case 0 with small images and a small map, and a fault (name and size)."""
    name, size = next(iter(fault.items()), ("", 0.0))
    return _simulate_fault(name, size)


@cache
def _nominal() -> CaseResult:
    return _run(compared=("inertial",))


def test_small_case_is_located_on_the_map() -> None:
    result = _nominal()
    row: Any = result.row
    assert (result.outcome, result.answered, result.failure) == ("VALID", True, None)
    assert (row["images"], row["valid_images"], row["fault"], row["false_fix"]) == (4, 2, "none", False)
    # the third image, 0.5 s + 2 x 1.5 s after the start, completes the coarse stage; clock errors are milliseconds
    assert row["fix_after_s"] == pytest.approx(3.5, abs=0.01)
    # two pixels of the image
    assert row["position_error_m"] <= row["position_error_max_m"] < 20.0
    assert row["position_error_m"] == pytest.approx(
        np.hypot(row["position_error_east_m"], row["position_error_north_m"])
    )
    # relative to the world, the map's shift and its distortion (6 m, 4 standard deviations) are added
    assert abs(row["position_error_world_m"] - row["map_shift_m"]) < row["position_error_m"] + 4.0 * 6.0
    # inertial navigation has the initial position error, plus that of a velocity error of 1 m/s per axis over 5 s
    assert row["inertial.position_error_m"] == pytest.approx(row["initial_error_m"], abs=25.0)
    assert row["inertial.fix_after_s"] < 0.6


def test_case_repeats_after_another_case() -> None:
    """A case depends neither on an earlier case in the same scenario, nor on the other algorithms of the case."""
    scenario, parameters = LocalisationScenario(), _make_parameters()
    other = scenario.run(_make_parameters(algorithm="inertial", **COARSE), Streams(1, "loc tests", 1))
    repeated = scenario.run(parameters, Streams(1, "loc tests", 0))
    row, nominal = (
        {name: value for name, value in result.row.items() if "_time_" not in name and not name.startswith("inertial.")}
        for result in (repeated, _nominal())
    )
    assert row == pytest.approx(nominal, abs=0.0, nan_ok=True)
    assert row["image_hash"] != other.row["image_hash"]
    np.testing.assert_array_equal(repeated.products["track"], _nominal().products["track"])


def test_exact_instruments_and_map_give_a_small_error() -> None:
    result = _run(exact_instruments=True, map={"side_px": 448, **EXACT_MAP})
    row: Any = result.row
    assert result.outcome == "VALID"
    assert row["map_shift_m"] == 0.0
    assert row["initial_attitude_error_deg"] == pytest.approx(0.0, abs=1e-6)
    # a fifth of an image pixel
    assert row["position_error_max_m"] < 2.0
    assert row["position_error_world_m"] == pytest.approx(row["position_error_m"], abs=1e-6)
    assert row["velocity_error_m_s"] < 0.5
    assert row["attitude_error_deg"] < 0.1


def test_initial_error_is_the_drawn_one() -> None:
    """With an exact map the column is the drawn error; otherwise the map's local shift is added to the drawn error."""
    exact = _run(algorithm="inertial", exact_instruments=True, **{**COARSE, "map": {"side_px": 64, **EXACT_MAP}})
    descent = _simulate()
    p, truth = descent.p, descent.flight.state(-INERTIAL_LEAD_S)
    # the drawn position depends neither on the time of 0 s nor on the gravity of 3.71 m/s2
    drawn = p.initial.draw(truth, 0.0, 3.71, Streams(1, "loc tests", 0).generator("initial state"))
    error = truth.position_m[:2] - drawn.position_m[:2]
    assert 0.0 < np.hypot(*error) <= p.initial.horizontal_max_m
    # tolerance: rounding of coordinates of kilometres
    assert exact.row["initial_error_m"] == pytest.approx(np.hypot(*error), abs=1e-9)
    shifted: Any = _run(algorithm="inertial", **COARSE).row
    on_map = descent.map_truth.map_position(truth.position_m[:2]) - truth.position_m[:2]
    assert shifted["initial_error_m"] == pytest.approx(np.hypot(*(error + on_map)), abs=1e-9)
    attitude_error_rad = (truth.attitude * drawn.world_from_body.inv()).magnitude()
    assert shifted["initial_attitude_error_deg"] == pytest.approx(np.degrees(attitude_error_rad), abs=1e-9)


def test_lost_images_are_missing_in_the_measurements() -> None:
    complete, half = _simulate(), _simulate(lost_images=0.5)
    assert len(complete.images) == len(half.states) == 4
    assert 0 < len(half.images) < 4
    # losses have a random stream of their own: the remaining images do not change
    counts = {image.time_s: image.counts for image in complete.images}
    for image in half.images:
        np.testing.assert_array_equal(image.counts, counts[image.time_s])
    # conditions are those of the delivered images
    flights = half.image_states
    assert flights != half.states
    assert conditions(half)["off_nadir_max_deg"] == max(map(off_nadir_deg, flights))
    last_m = flights[-1].position_m
    assert conditions(half)["altitude_last_m"] == last_m[2] - half.world.surface.height(*last_m[:2])
    result = _run(faults={"lost_images": 1.0}, **COARSE)
    row: Any = result.row
    assert (result.outcome, result.answered, result.failure) == ("NO_COARSE_FIX", False, None)
    assert (row["images"], row["valid_images"], row["fixed_in_time"], row["false_fix"]) == (0, 0, False, False)
    assert np.isnan(row["position_error_m"])
    assert np.isnan([row[name] for name in ("altitude_last_m", "off_nadir_max_deg", "attitude_rate_max_deg_s")]).all()
    assert np.isnan(row["inliers_min"])
    assert result.products["track"].shape == (1, 7)


def test_black_image_is_delivered_and_causes_no_false_fix() -> None:
    result = _run(faults={"black_image": 2})
    assert (result.row["fault"], result.row["fault_size"]) == ("black_image", 2.0)
    assert result.row["images"] == 4
    assert result.failure is None
    assert result.row["false_fix"] is False
    clean, faulty = _simulate(), _simulate(black_image=2)
    for number, (image, expected) in enumerate(zip(faulty.images, clean.images, strict=True), start=1):
        np.testing.assert_array_equal(image.counts, 0 if number == 2 else expected.counts)


def test_wrong_map_gives_no_position() -> None:
    result = _run(faults={"wrong_map": 1})
    assert result.failure is None
    assert result.answered is False
    assert (result.row["valid_images"], result.row["false_fix"]) == (0, False)
    assert "VALID" not in result.products["outcomes"]
    # the images are those of the nominal case
    assert result.row["image_hash"] == _nominal().row["image_hash"]


def test_wrong_map_needs_another_terrain() -> None:
    scenario = LocalisationScenario()
    assert scenario.case_inputs(_make_parameters(), 0) == (0,)
    assert scenario.case_inputs(_make_parameters(faults={"wrong_map": 1}), 0) == (0, 1)
    with pytest.raises(ValidationError, match=r"faults.wrong_map needs another terrain; allowed: a location.bank"):
        _make_parameters(faults={"wrong_map": 1}, location={"bank": 1})


@pytest.mark.parametrize("fault", ["altitude_error", "attitude_error_deg"])
def test_exact_instruments_have_no_faults(fault: str) -> None:
    with pytest.raises(ValidationError, match=rf"faults.{fault} has no effect with exact_instruments; allowed: 0"):
        _make_parameters(faults={fault: 0.5}, exact_instruments=True)
    _make_parameters(faults={fault: 0.5})


def test_attitude_error_tilts_the_initial_attitude() -> None:
    """The fault is an additional rotation about a horizontal axis; the drawn initial errors are the same."""
    clean, tilted = (descent.measurements.initial for descent in (_simulate(), _simulate(attitude_error_deg=2.0)))
    rotation_deg = np.degrees((tilted.world_from_body * clean.world_from_body.inv()).as_rotvec())
    assert np.hypot(*rotation_deg[:2]) == pytest.approx(2.0, abs=1e-9)
    assert rotation_deg[2] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(tilted.position_m, clean.position_m)
    np.testing.assert_array_equal(tilted.covariance, clean.covariance)


@pytest.mark.slow
@pytest.mark.parametrize("error_deg", [2.0, 5.0, 6.0, 7.0, 10.0])
def test_wrong_attitude_gives_no_position(error_deg: float) -> None:
    """The error is 20 to 100 times the standard deviation in the covariance: 50 to 280 m on the ground.

    A search that ignores the covariance would find a consistent position that is wrong by this distance.
    """
    result = _run(faults={"attitude_error_deg": error_deg})
    assert result.row["initial_attitude_error_deg"] == pytest.approx(error_deg, abs=0.5)
    assert result.failure is None
    assert result.row["valid_images"] == 0
    assert result.row["false_fix"] is False


@pytest.mark.parametrize("key", ["clock", "altimeter"])
@pytest.mark.parametrize("offset_s", [-0.95, 0.95])
def test_inertial_data_contain_the_tags_of_a_wrong_clock(key: str, offset_s: float) -> None:
    """The inertial data, nominally from 0.2 s before the start, are extended if a clock error exceeds this margin."""
    clock = {"offset_s": offset_s}
    parameters = _make_parameters(**COARSE, **{key: clock if key == "clock" else {"clock": clock}})
    descent = LocalisedDescent.simulate(parameters, Streams(1, "loc tests", 0))
    tags = [event.time_s for event in descent.measurements.events() if not isinstance(event, ImuIncrements)]
    first, last = descent.measurements.increments.times_s[[0, -1]]
    assert first <= min(tags)
    assert max(tags) <= last
    # the initial state is that of the first increment
    initial = descent.measurements.initial
    assert initial.time_s == first
    error = initial.position_m - descent.initial_truth.position_m
    assert np.hypot(*error[:2]) <= parameters.initial.horizontal_max_m


@pytest.mark.parametrize("offset_s", [-1.0, 0.3, 1.0])
def test_wrong_image_clock_does_not_crash(offset_s: float) -> None:
    """Offsets above 0.2 s exceed the margins of the inertial data before the start and after the last image."""
    result = _run(clock=ClockParameters(offset_s=offset_s), compared=("inertial", "sift"), **COARSE)
    assert result.failure is None
    assert result.row["images"] == 4
    assert len(result.products["outcomes"]) == 5


def test_image_tagged_after_the_flight_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """There are no inertial data at the time tag of this image; the other images are answered."""
    monkeypatch.setattr(Clock, "tags", _late_tags)
    result = _run(algorithm="inertial", compared=("lvs", "sift"), **COARSE)
    assert result.failure is None
    assert result.products["outcomes"] == ["VALID", "VALID", "VALID", "OUTSIDE_INERTIAL_DATA", "VALID"]


def _late_tags(_: Clock, times_s: np.ndarray, __: np.random.Generator) -> np.ndarray:
    """Return exact tags, except that of the last of four images, which is 60 s late."""
    return times_s + (60.0 * (np.arange(times_s.size) == 3) if times_s.size == 4 else 0.0)


def test_altitude_error_scales_all_altitudes() -> None:
    clean, wrong = (
        np.array([event.altitude_m for event in descent.measurements.events() if hasattr(event, "altitude_m")])
        for descent in (_simulate(), _simulate(altitude_error=0.1))
    )
    assert clean.size >= 8
    np.testing.assert_allclose(wrong, 1.1 * clean)


def test_haze_reduces_the_contrast() -> None:
    clear, hazy = (
        float(contrast_columns(descent.images[0].counts, descent.p.detector)["image_contrast"])
        for descent in (_simulate(), _simulate(haze=1.0))
    )
    # the air's transmission over 1600 m is exp(-0.8) = 0.45 at nadir; the noise of the detector remains
    assert hazy < 0.8 * clear


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"map": {"side_px": 1024}}, r"the map of 6144 m is larger than the terrain, which repeats after 4096 m"),
        ({"site": "gusev"}, r"no localisation site is called 'gusev'; allowed: crater-floor, dunes"),
        ({"terrain_site": "dunes"}, r"site is crater-floor, but terrain is of dunes"),
        ({"algorithm": "lsv"}, r"lsv"),
        ({"compared": ["lvs"]}, r"the algorithm 'lvs' is listed twice"),
        ({"images": {"first_s": 0.0}}, r"images.first_s"),
        ({"camera": {"pixels": 192}}, r"field_deg of 90 with 192 pixels of 1.67 mrad is not a one-to-one image"),
        (
            {"flight": {"altitude_start_m": 1600.0, "altitude_separation_m": 1700.0}},
            r"altitudes of start, separation and end are 1600, 1700 and 500 m; allowed: decreasing",
        ),
        ({"location": {"bank": 2, "terrain": 2}}, r"terrain 2 is not in the bank; allowed: 0 to 1"),
        ({"lvs": {"template_px": 8}}, r"template_px is 8; it must be odd and at least 5"),
        ({"sun": {"elevation_deg": 0.0}}, r"sun.elevation_deg"),
        ({"fault": {}}, r"fault"),
        ({"clock": ClockParameters(offset_s=1.5)}, r"tags of clock are wrong by up to 1.5 s .* allowed: up to 1 s"),
        ({"clock": ClockParameters(jitter_sd_s=0.25)}, r"time tags of clock are wrong by up to 1.25 s"),
        ({"altimeter": {"clock": ClockParameters(offset_s=-2.0)}}, r"tags of altimeter.clock are wrong by up to 2 s"),
    ],
)
def test_invalid_parameters_have_one_clear_message(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message) as caught:
        _make_parameters(**changes)
    assert caught.value.error_count() == 1


def test_first_image_after_the_end_of_the_flight_has_a_clear_message() -> None:
    with pytest.raises(ValueError, match=r"images.first_s is 60 s; allowed: before the end of the flight, 6"):
        _run(images={"first_s": 60.0, "coarse_images": 0}, **COARSE)


def test_late_answer_is_a_bad_answer() -> None:
    """The answer of an estimator is validated: a wrong one is the outcome of the case, with the reason."""
    result = _run(algorithm="tests.scenarios.localisation.test_scenario:LateEstimator", **COARSE)
    assert result.outcome == "BAD_ANSWER"
    assert "answer to image 1 is 1000000.0 s; allowed: 0.5" in result.failure.error
    assert result.row["images"] == 4
    assert "position_error_m" not in result.row


class LateEstimator:
    """A position estimator whose answers have times after the end of the descent."""

    def _ignore(self, *_: object) -> None:
        pass

    start = imu = altitude = _ignore

    def process_image(self, _: object) -> Any:
        """Answer without a position."""
        return self.finish()

    def finish(self) -> Any:
        """Answer without a position."""
        return PositionEstimate(PositionOutcome.UNCERTAIN, 1e6)


def test_products_belong_to_the_row() -> None:
    result = _nominal()
    products, row = result.products, dict[str, Any](result.row)
    assert products["track"].shape == (5, 7)
    assert products["outcomes"] == ["NO_COARSE_FIX", "NO_COARSE_FIX", *["VALID"] * 3]
    np.testing.assert_array_equal(np.isnan(products["track"][:, 0]), [True, True, False, False, False])
    np.testing.assert_allclose(np.hypot(*products["track"][-1, 1:3]), row["position_error_m"])
    assert products["inliers"].shape == (5,)
    assert np.nanmedian(products["inliers"]) == row["inliers_median"]
    assert (products["true_xy_m"].shape, products["estimated_xy_m"].shape) == ((4, 2), (5, 2))
    # image 4 is the last one with an estimate before the final one; both refer to the map
    error = products["estimated_xy_m"][3] - products["true_xy_m"][3]
    np.testing.assert_allclose(error, products["track"][3, 1:3], atol=0.5)
    west, east, south, north = products["map_extent_m"]
    assert (east - west, north - south) == (pytest.approx(448 * 6.0), pytest.approx(448 * 6.0))
    assert 0.5 * (west + east) == pytest.approx(2048.0)
    assert products["landmarks_px"].shape == products["landmarks_residual_px"].shape
    assert np.count_nonzero(products["landmarks_used"]) == products["inliers"][3]
