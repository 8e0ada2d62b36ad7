"""Checks of target tracking on rendered rocks: drift without noise, and range error of stereo.

The tracking paper is Kim et al., "Targeted Driving Using Visual Tracking". Its Eq. 1 is the range error of stereo,
proportional to the disparity error and the square of the range.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from typing import Any

import numpy as np

from benchmarks.validation.records import Check, Measure
from marsyard.algorithms.vtt.accuracy import stereo_range_error_m
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.validation_rows import Conditions
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.rover.closed_loop import run_case
from marsyard.scenarios.rover.conditions import fixed_conditions, run_conditions
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun
from marsyard.scenarios.rover.score import score_run
from marsyard.sim.sensor.odometry import EXACT
from marsyard.sim.streams import Streams

#: Seed of the random streams; the choice is arbitrary.
SEED = 20061108
#: Limits of the drift (rms, maximum), and of the relative deviation of the range error from Eq. 1.
DRIFT_RMS_LIMIT_PX, DRIFT_MAX_LIMIT_PX, RANGE_LIMIT = 1.0, 2.5, 0.15
#: Maximum fraction of lost targets: 2 of 100 were lost, plus three standard deviations of this number, 4 of 100.
LOST_LIMIT = 0.06
CAMERAS = ("research-navcam", "research-pancam")
#: Parameters of a run without errors of cameras, mast and odometry.
NO_ERRORS: dict[str, Any] = {
    "stereo": dict.fromkeys(
        ("disparity_error_px", "epipolar_error_px", "alignment_deg", "roll_deg", "focal_error"), 0.0
    ),
    "pointing": dict.fromkeys(("zero_deg", "backlash_deg", "settling_deg", "count_deg"), 0.0),
    "odometry": EXACT.model_dump(),
}


def draw_exact_parameters(number: int, camera: str) -> RoverScenarioParameters:
    """Draw the parameters of a run of `vtt-montecarlo` with exact pose, cameras and mast, without noise."""
    campaign = load_campaign("vtt-montecarlo")
    case_parameters = campaign.with_values(
        {**campaign.draws(number), "camera.preset": camera, "world.terrain": number % 8}
    )
    values = case_parameters.model_dump()
    (leg,) = values["legs"]
    return RoverScenarioParameters.model_validate(
        values
        | NO_ERRORS
        # error-free visual odometry measures the slip; it takes no time, so that the sun moves as in the campaign
        | {"navigation": values["navigation"] | {"odometry": "oracle-motion"}}
        | {"legs": [leg | {"visual_odometry": True}], "timing": values["timing"] | {"visual_odometry_s": 0.0}}
        | {"camera": values["camera"] | {"detector_noise": False}}
    )


def simulate_run(number: int, camera: str) -> dict[str, Scalar]:
    """Simulate a run without errors; return its row: score and conditions."""
    parameters = draw_exact_parameters(number, camera)
    run = run_case(parameters, Streams(SEED, "validation tracking", number))
    return {**score_run(parameters, run), **fixed_conditions(parameters, run), **run_conditions(parameters, run)}


def check_drift(quick: bool) -> Iterator[Measure]:
    """Measure the drift at 2 m of selectable targets (unoccluded and lit) that are designated at 10 m."""
    targets = 3 if quick else 50
    all_rows: list[dict[str, Scalar]] = []
    for camera in CAMERAS:
        rows = (simulate_run(number, camera) for number in count(1000))
        selectable = list(islice((row for row in rows if row["selectable"]), targets))
        yield from _measure_drifts(selectable, camera, has_limit=False)
        all_rows += selectable
    yield from _measure_drifts(all_rows, "both cameras", has_limit=True)


def _measure_drifts(rows: list[dict[str, Scalar]], name: str, *, has_limit: bool) -> Iterator[Measure]:
    """Measure the drift in pixels of the tracked targets, and the fraction of lost targets."""
    drifts_px = np.array([float(row["drift_px"]) for row in rows])
    how = (
        f"{len(rows)} targets on rendered rocks, 10 m to 2 m in steps of 10 %, no noise, exact pose and cameras, "
        f"sun motion {_median_sun_motion_deg(rows):.0f} deg; "
        f"{np.count_nonzero(np.isnan(drifts_px))} not tracked to the end"
    )
    if has_limit:
        yield _measure_losses(f"targets lost before 2 m: {name}", int(np.isnan(drifts_px).sum()), len(drifts_px), how)
    tracked_px = drifts_px[~np.isnan(drifts_px)]
    rms, maximum = float(np.sqrt(np.mean(tracked_px**2))), float(tracked_px.max())
    yield Measure(f"drift of the tracked point, rms: {name}", rms, "px", DRIFT_RMS_LIMIT_PX if has_limit else None, how)
    yield Measure(
        f"drift of the tracked point, maximum: {name}", maximum, "px", DRIFT_MAX_LIMIT_PX if has_limit else None, how
    )


def _measure_losses(claim: str, lost: int, cases: int, how: str) -> Measure:
    """Return the fraction of lost cases, which the other rows exclude; one lost case is always allowed."""
    return Measure(claim, lost / cases, "", max(LOST_LIMIT, 1.0 / cases), how)


def _median_sun_motion_deg(rows: list[dict[str, Scalar]]) -> float:
    return float(np.median([float(row["sun_motion_deg"]) for row in rows]))


def check_stereo(quick: bool) -> Iterator[Measure]:
    """Compare the range error of the first pair at 10 m with Eq. 1 (tracking paper) for the true disparity errors."""
    for camera in CAMERAS:
        simulations = [_simulate_designation(number, camera) for number in range(10 if quick else 60)]
        selectable_errors = [errors_m for errors_m in simulations if errors_m is not None]
        measured_errors = [errors_m for errors_m in selectable_errors if np.isfinite(errors_m[0])]
        errors, expected_errors = np.array(measured_errors).reshape(-1, 2).T
        ratio = float(np.sqrt(np.mean(errors**2) / np.mean(expected_errors**2)))
        how = f"first pairs of {len(errors)} runs of vtt-accuracy at rocks of 1.5 m, disparity error 1/3 px rms"
        yield Measure(
            f"stereo range error at 10 m divided by that of Eq. 1, minus 1: {camera}",
            abs(ratio - 1.0),
            "",
            RANGE_LIMIT,
            how,
        )
        how = f"of {len(selectable_errors)} selectable targets; the row above excludes these pairs"
        yield _measure_losses(
            f"first stereo pairs in which the target is not found: {camera}",
            len(selectable_errors) - len(measured_errors),
            len(selectable_errors),
            how,
        )


def _simulate_designation(number: int, camera: str) -> tuple[float, float] | None:
    """Simulate a first pair; return its range error and the error by Eq. 1 of the tracking paper, metres.

    The range error is NaN if the target is not found. The result is None if the target is not selectable.
    """
    campaign = load_campaign("vtt-accuracy")
    # large rock: the template contains only the rock and no ground behind it
    rock = {"target.diameter_m": 1.5, "target.up": 0.5, "camera.preset": camera, "world.terrain": number % 8}
    case_parameters = campaign.with_values(campaign.draws(number) | rock)
    parameters = RoverScenarioParameters.model_validate(
        case_parameters.model_dump() | {"legs": [{"motion": "stay", "steps": 1}]}
    )
    run = run_case(parameters, Streams(SEED, "validation stereo", number))
    row = fixed_conditions(parameters, run)
    if not row["selectable"]:
        return None
    error = _range_error_m(run) if run.stops[0].update.tracked else float("nan")
    return error, _expected_range_error_m(run, float(row["disparity_error_start_px"]))


def _range_error_m(run: RoverRun) -> float:
    """First reported position minus the designated point, along the line of sight."""
    stop = run.stops[0]
    eye = stop.stance.world_from_rover.inv().apply(run.setup.rig.camera_positions(stop.world_from_head)[0])
    line_of_sight = (stop.point_rover - eye) / np.linalg.norm(stop.point_rover - eye)
    return float(stop.error_m() @ line_of_sight)


def _expected_range_error_m(run: RoverRun, disparity_error_px: float) -> float:
    """Compute the range error of the first pair by Eq. 1 of the tracking paper, metres."""
    rig = run.setup.rig.calibrated
    return stereo_range_error_m(run.stops[0].range_m, disparity_px_m(rig.left, rig.right), 1.0, disparity_error_px)


#: The dispersions of vtt-montecarlo and vtt-accuracy.
_CONDITIONS = Conditions(
    "*",
    ("vtt",),
    site=("mars-yard",),
    camera=CAMERAS,
    sun_elevation_deg=(25.0, 65.0),
    slope_deg=(2.0, 2.0),
    optical_depth=(0.2, 0.6),
    range_m=(2.0, 10.0),
)


def _by_camera(conditions: Conditions) -> tuple[Conditions, ...]:
    """Conditions of the rows on each camera, then of those on both."""
    return (*(replace(conditions, rows=f"*{camera}", camera=(camera,)) for camera in CAMERAS), conditions)


CHECKS = (
    Check("tracking-drift", "Tracking", check_drift, conditions=_by_camera(_CONDITIONS)),
    Check(
        "tracking-stereo", "Tracking", check_stereo, conditions=_by_camera(replace(_CONDITIONS, range_m=(10.0, 10.0)))
    ),
)
