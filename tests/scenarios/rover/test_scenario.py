"""Tests of closed-loop rover runs: drive, images, tracking, scores and stored products."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.rover.closed_loop import run_case
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.scenario import RoverScenario
from marsyard.scenarios.rover.shared_drive import DriveKey, SharedDriveScenario, render_drive, track_views
from marsyard.scenarios.rover.shared_drive_parameters import SharedDriveParameters
from marsyard.sim.render import PixelRays, process_renderer
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN


def make_parameters(**changes: object) -> RoverScenarioParameters:
    return RoverScenarioParameters.model_validate({**SHORT_RUN, **changes})


def make_streams(case: int = 0) -> Streams:
    return Streams(1, "rover tests", case)


def drop_times(row: Mapping[str, Scalar]) -> dict[str, Scalar]:
    """Remove the columns of run times, which differ between runs."""
    return {name: value for name, value in row.items() if "time" not in name}


def test_run_is_tracked_scored_and_deterministic() -> None:
    scenario, parameters = RoverScenario(), make_parameters(score={"stored_updates": 2})
    result = scenario.run(parameters, make_streams())
    row: dict[str, Any] = dict(result.row)
    assert (result.outcome, result.answered) == ("COMPLETED", True)
    assert row["tracked"]
    # the metric of requirements on targets that must be lost
    assert not row["not_tracked"]
    assert row["no_false_track"]
    # One pixel of disparity is 5 cm of range at 3.5 m (Eq. 1 of the tracking paper). The calibration error is at most
    # half a pixel.
    assert 0.0 < row["position_error_m"] < 0.04
    assert row["position_error_m"] ** 2 == pytest.approx(row["range_error_m"] ** 2 + row["cross_error_m"] ** 2)
    assert row["drift_px"] < 1.0
    assert row["range_end_m"] < row["range_start_m"] < 4.1
    assert abs(row["disparity_error_goal_px"]) <= 0.55
    assert row["update_2_magnification"] == pytest.approx(row["magnification_max"], rel=0.05)
    repeated_row = scenario.run(parameters, make_streams()).row
    assert drop_times(repeated_row) == pytest.approx(drop_times(row), abs=0.0, nan_ok=True)
    stops = int(row["updates"])
    products = result.products
    assert products["rover_true_m"].shape == (stops, 3)
    assert products["stop_1_left"].dtype == np.uint16
    assert products["figures"]["match_score"].shape == (stops,)


def test_designated_point_agrees_with_rendered_pixels() -> None:
    """The designated point, projected by the score, agrees with the 3-D points of the rendered pixels."""
    parameters = make_parameters(camera={"detector_noise": False})
    run = run_case(parameters, make_streams(1))
    stop = run.stops[-1]
    column, row = (round(value) for value in stop.point_px)
    camera = run.setup.rig.left.crop(column - 4, row - 4, (9, 9))
    frame = process_renderer(parameters.backend).render(
        run.setup.world.base, PixelRays.from_camera(camera), stop.world_from_head
    )
    surface_points = frame.points_world()[3:6, 3:6].reshape(-1, 3)
    # The central pixel shows an object, not ground or sky.
    assert frame.body[4, 4] >= 0
    # A pixel covers 3 mm, and more on the oblique face.
    assert np.linalg.norm(surface_points - run.target.point_world, axis=1).min() < 0.008


@pytest.mark.parametrize("diameter_m", [0.07, 1.2])
def test_start_and_goal_have_the_specified_distance(diameter_m: float) -> None:
    """The distances from the mast to the designated point at start and goal do not depend on the rock size."""
    target = {**SHORT_RUN["target"], "diameter_m": diameter_m, "across": 0.3, "up": 0.5}
    run = run_case(make_parameters(target=target), make_streams(4))
    first, last = run.stops[0], run.stops[-1]
    mast = first.stance.world_from_rover.apply(np.append(run.setup.rig.calibrated.geometry.base_m[:2], 0.0))
    # Tolerance: lateral offset of the point.
    assert np.hypot(*(run.target.point_world - mast)[:2]) == pytest.approx(3.6, abs=0.06)
    assert np.hypot(*(run.target.point_world - last.stance.world_from_rover.translation)[:2]) == pytest.approx(
        3.3, abs=0.06
    )


def test_template_is_on_an_occluding_edge_only_at_the_top_of_a_large_rock() -> None:
    """Only at the top of a large rock a template contains distant background.

    A template on a rock of 7 cm, or at the foot of a large rock, contains the adjacent ground.
    """
    is_on_edge = {
        (diameter, up): run_case(
            make_parameters(target={**SHORT_RUN["target"], "diameter_m": diameter, "up": up}), make_streams(5)
        ).target.on_edge
        for diameter, up in ((0.07, 0.5), (1.2, 0.5), (1.2, 0.97), (1.2, 0.03))
    }
    assert is_on_edge == {(0.07, 0.5): False, (1.2, 0.5): False, (1.2, 0.97): True, (1.2, 0.03): False}


def test_ideal_instruments_have_only_match_errors() -> None:
    exact_instruments = {
        "camera": {"detector_noise": False},
        "stereo": dict.fromkeys(
            ("disparity_error_px", "epipolar_error_px", "alignment_deg", "roll_deg", "focal_error"), 0.0
        ),
        "pointing": dict.fromkeys(("zero_deg", "backlash_deg", "settling_deg", "count_deg"), 0.0),
    }
    row: Mapping[str, Any] = (
        RoverScenario().run(make_parameters(algorithm="vtt-plus", **exact_instruments), make_streams(2)).row
    )
    assert row["disparity_error_goal_px"] == 0.0
    # Tolerance: a tenth of a pixel of disparity and of lateral position.
    assert row["position_error_m"] < 0.008
    assert row["drift_px"] < 0.3


@pytest.mark.parametrize("designation", ["rover", "site"])
def test_targets_can_be_designated_by_position(designation: str) -> None:
    run = run_case(make_parameters(target={**SHORT_RUN["target"], "designation": designation}), make_streams(3))
    assert run.outcome.name == "COMPLETED"
    # The mast points at the position. The backlash of 0.1 deg causes an error of 2.1 px per axis. Half the epipolar
    # error is 0.2 px.
    assert np.linalg.norm(run.stops[0].reported_px(run.setup.rig.calibrated) - run.stops[0].point_px) < 3.5


def run_custom_tracker(name: str) -> CaseResult:
    parameters = make_parameters(algorithm=f"tests.scenarios.rover.trackers:{name}", executable={"isolated": False})
    return RoverScenario().run(parameters, make_streams())


#: Requirements of Monte Carlo runs by their identifiers.
REQUIREMENTS = {entry.id: entry for entry in load_campaign("vtt-montecarlo").definition.requirements}


@pytest.mark.parametrize(("tracker", "error_m"), [("OffsetTracker", 0.3), ("BehindTracker", 5.3)])
def test_wrong_target_reported_as_tracked_is_a_false_track(tracker: str, error_m: float) -> None:
    """The reported position counts, not the match in the tracker's details; also if no camera can see the position."""
    result = run_custom_tracker(tracker)
    assert result.answered
    assert (result.row["tracked"], result.row["target_held"], result.row["handed_off"]) == (False, False, False)
    assert not result.row["no_false_track"]
    assert result.row["false_updates"] == result.row["updates"]
    # the rock's face is 3.3 m ahead of the rover's origin at the goal, and a mast's length farther at the start
    assert result.row["position_error_m"] == pytest.approx(error_m, abs=0.04 if error_m < 1.0 else 0.9)
    row = {**result.row, "outcome": result.outcome, "answered": result.answered}
    assert all(compute_margin(row, REQUIREMENTS[name]) < 0.0 for name in ("VTT-TRACK", "VTT-HARM", "VTT-DRIFT"))
    if tracker == "BehindTracker":
        assert (row["max_error_px"], row["drift_px"], row["track_margin_px"]) == (np.inf, np.inf, -np.inf)


def test_lost_target_is_not_a_valid_answer() -> None:
    result = run_custom_tracker("LosingTracker")
    assert (result.outcome, result.answered) == ("LOST", False)
    assert np.isnan(result.row["position_error_m"])
    assert result.row["no_false_track"]
    assert result.row["losses"] == "LOW_MATCH_SCORE"


def test_run_without_stops_remains_in_the_population_of_visible_targets() -> None:
    """A tracker that never aims has lost sight of nothing: its run counts, as a failure."""
    result = run_custom_tracker("UnaimedTracker")
    assert not result.answered
    assert (result.row["updates"], result.row["tracked"]) == (0, False)
    assert result.row["point_in_view"]


def test_visibility_on_a_commanded_path_does_not_depend_on_the_tracker() -> None:
    """A tracker that loses the target, or never aims, ends the run; the commanded path has all stops."""
    start = {"distance_m": 3.6, "target_azimuth_deg": 25.0}
    # the rover passes the rock on its left, so that it sees the point on the right side more obliquely
    target = {**SHORT_RUN["target"], "across": 0.5}
    drive = {"start": start, "target": target, "legs": [{"motion": "straight", "step_m": 0.5, "steps": 3}]}
    drive["executable"] = {"isolated": False}
    rows = [
        RoverScenario().run(make_parameters(algorithm=name, **drive), make_streams()).row
        for name in ("vtt", *(f"tests.scenarios.rover.trackers:{name}" for name in ("LosingTracker", "UnaimedTracker")))
    ]
    assert [row["updates"] for row in rows] == [4, 2, 0]
    for name in ("point_in_view", "obliquity_start_deg", "obliquity_max_deg"):
        assert len({row[name] for row in rows}) == 1
    assert float(str(rows[0]["obliquity_max_deg"])) > float(str(rows[0]["obliquity_start_deg"]))


def test_unknown_trackers_and_cameras_are_rejected() -> None:
    with pytest.raises(ValueError, match=r"unknown algorithm 'vt'.*did you mean 'vtt'"):
        make_parameters(algorithm="vt")
    with pytest.raises(ValueError, match="no mast has the camera preset 'xc-55'"):
        make_parameters(camera={"preset": "xc-55"})


def test_step_of_a_shared_drive_is_that_of_its_leg() -> None:
    """A leg with a fixed step ignores `step_fraction`; every third stop triples the step."""
    steps = {
        "approach": ({"step_fraction": 0.1}, 1.0 - 0.9**3),
        "straight": ({"step_m": -0.2}, 0.6),
        "circle": ({"step_deg": -5.0}, 15.0),
    }
    for motion, (leg, step) in steps.items():
        parameters = SharedDriveParameters.model_validate(
            {"drive": {"legs": [{"motion": motion, **leg}]}, "variants": [{}], "targets": [{}], "skipped_stops": 2}
        )
        assert parameters.step == pytest.approx(step)


def test_terrains_of_a_shared_drive_are_in_the_bank() -> None:
    values = {"drive": {"world": {"bank": 2}}, "variants": [{"terrain": 1}, {"terrain": 2}], "targets": [{}]}
    with pytest.raises(ValueError, match=r"variants\[1\].terrain is 2; allowed: 0 to 1"):
        SharedDriveParameters.model_validate(values)


def test_runs_of_the_other_scenario_are_rejected() -> None:
    """A shared drive would ignore them."""
    values = {"drive": {"variants": [{"diameter_m": 0.2}]}, "variants": [{}], "targets": [{}]}
    with pytest.raises(ValueError, match="allowed in a shared drive: variants"):
        SharedDriveParameters.model_validate(values)


@pytest.mark.slow
def test_trackers_share_the_images_of_a_drive() -> None:
    scenario = SharedDriveScenario()
    values: dict[str, Any] = {
        "drive": {**SHORT_RUN, "legs": [{"motion": "circle", "step_deg": 5.0, "steps": 2}]},
        "variants": [{"diameter_m": 0.8, "height_m": 0.5, "shape": 8, "yaw_deg": 30.0, "sun_azimuth_deg": 260.0}],
        "targets": [{"across": 0.0, "up": 0.5}, {"across": 0.4, "up": 0.5}],
        "step_ranges": [{"name": "at_10_deg", "min": 10.0, "max": 10.0}],
    }
    silent_tracker = "tests.scenarios.rover.trackers:SilentTracker"
    values["drive"] = {**values["drive"], "compared": ["pure-ncc", silent_tracker]}
    small_steps, large_steps = (
        SharedDriveParameters.model_validate({**values, "skipped_stops": skipped_stops}) for skipped_stops in (0, 1)
    )
    assert (small_steps.step, large_steps.step) == (5.0, 10.0)
    results = [scenario.run(p, make_streams(case)) for case, p in enumerate((small_steps, large_steps))]
    assert [result.row["updates"] for result in results] == [3, 2]
    assert [result.row["at_10_deg"] for result in results] == [False, True]
    assert all(result.row["tracked"] for result in results)
    assert all(result.row["pure_ncc.updates"] == result.row["updates"] for result in results)
    assert all(result.row["SilentTracker.outcome"] == "BAD_ANSWER" for result in results)
    assert [result.failure for result in results] == [None, None]
    # A new scenario object without a cached drive gives the same row.
    uncached_row = SharedDriveScenario().run(small_steps, make_streams(0)).row
    assert drop_times(uncached_row) == pytest.approx(drop_times(results[0].row), abs=0.0, nan_ok=True)
    # Small and large steps cover the same arc. A target is on the face if no stop exceeds the allowed viewing angle.
    row = results[0].row
    assert [result.row["obliquity_max_deg"] for result in results] == [row["obliquity_max_deg"]] * 2
    assert isinstance(row["obliquity_max_deg"], float)
    row_within_limit, row_above_limit = (
        scenario.run(SharedDriveParameters.model_validate({**values, "max_obliquity_deg": limit}), make_streams(0)).row
        for limit in (row["obliquity_max_deg"] + 0.1, row["obliquity_max_deg"] - 0.1)
    )
    assert [(columns["in_view"], columns["on_face"]) for columns in (row, row_within_limit, row_above_limit)] == [
        (True, True),
        (True, True),
        (True, False),
    ]
    drive = render_drive(DriveKey.from_parameters(small_steps, make_streams(0)))
    second_target = track_views(SharedDriveParameters.model_validate({**values, "target": 1}), drive)
    assert second_target.stops[0].point_px[0] > drive.views[0].images.left.corner[0]
    assert second_target.stops[0].images is drive.views[0].images
    # The camera circles the centre of the targets at a constant distance.
    ranges = [stop.range_m for stop in second_target.stops]
    assert np.ptp(ranges) < 0.15


def test_target_behind_the_camera_has_an_infinite_error() -> None:
    row = run_custom_tracker("BehindTracker").row
    assert (row["max_error_px"], row["drift_px"], row["track_margin_px"]) == (np.inf, np.inf, -np.inf)
