"""Tests of navigation from rendered stereo pairs, and of custom mast cameras and detectors."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from marsyard.scenarios.rover.closed_loop import map_terrain, prepare_run, run_case
from marsyard.scenarios.rover.parameters import MastCameraParameters, RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun
from marsyard.scenarios.rover.scenario import RoverScenario
from marsyard.sim.camera import write_cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.sensor import preset
from marsyard.sim.sensor.mast import stereo_mast
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN

#: A rover with 30 % wheel slip on ground with rocks.
SLIPPING_ROVER: dict[str, Any] = {
    **SHORT_RUN,
    "world": {"samples": 1024, "bank": 1},
    "start": {"distance_m": 5.0},
    "slip": {"flat": 0.3, "soil_spread": 0.0, "step_spread": 0.0},
}
OBSTACLE = {"towards_start_m": 3.0, "right_m": 0.4, "diameter_m": 0.5, "height_m": 0.3}


def run_slipping_rover(seed: int = 4, **changes: Any) -> RoverRun:
    parameters = RoverScenarioParameters.model_validate({**SLIPPING_ROVER, **changes})
    return run_case(parameters, Streams(seed, "rover tests", 0))


def _position_error_m(run: RoverRun) -> float:
    """Compute the horizontal distance between estimated and true final position."""
    vehicle = run.setup.vehicle
    return float(np.linalg.norm((vehicle.estimated_pose.translation - vehicle.stance.world_from_rover.translation)[:2]))


@pytest.mark.slow
def test_visual_odometry_measures_slip_and_wheel_odometry_does_not() -> None:
    leg = {"motion": "approach", "goal_m": 3.6, "step_fraction": 0.1}
    errors = {
        visual: _position_error_m(run_slipping_rover(legs=[leg | {"visual_odometry": visual}]))
        for visual in (False, True)
    }
    # The rover drives 1.4 m, and the wheel odometry measures about 2 m.
    assert errors[False] > 0.4
    # The bound is 2 % of the distance (tracking paper, section 4.2), plus a constant error per step.
    assert errors[True] < 0.02 * 1.4 + 0.03


def test_wheel_odometry_replaces_visual_odometry_without_image_overlap() -> None:
    leg = {"motion": "straight", "step_m": 3.0, "steps": 1, "visual_odometry": True, "visual_odometry_step_m": 3.0}
    run = run_slipping_rover(legs=[leg], slip={"flat": 0.01})
    assert run.visual_odometry_updates == run.visual_odometry_failures == 1
    assert _position_error_m(run) < 0.15


@pytest.mark.parametrize("map_by", ["mast", "body"])
def test_stereo_map_agrees_with_true_heights(map_by: str) -> None:
    leg = {"motion": "approach", "goal_m": 2.0, "autonav": True, "map_by": map_by}
    maps = {}
    for terrain in ("stereo", "oracle-heights"):
        changes = {"legs": [leg], "navigation": {"terrain": terrain}, "obstacles": [OBSTACLE]}
        parameters = RoverScenarioParameters.model_validate({**SLIPPING_ROVER, **changes})
        run = prepare_run(parameters, Streams(4, "rover tests", 0))
        target = run.setup.vehicle.stance.world_from_rover.inv().apply(run.target.point_world.copy())
        map_terrain(parameters, run, parameters.legs[0], run.create_target_estimate(target))
        assert run.navigator.terrain is not None
        maps[terrain] = run.navigator.terrain
    stereo, oracle = maps["stereo"].median_m, maps["oracle-heights"].median_m
    is_in_both = np.isfinite(stereo) & np.isfinite(oracle)
    assert np.count_nonzero(is_in_both) > 100
    error_m = stereo[is_in_both] - oracle[is_in_both]
    assert abs(np.median(error_m)) < 0.02
    assert np.percentile(np.abs(error_m), 80.0) < 0.06
    # The oracle maps all ground within its range; the images show only a part of it.
    assert np.count_nonzero(np.isfinite(oracle) & ~np.isfinite(stereo)) > 0


@pytest.mark.slow
def test_rover_drives_around_an_obstacle_in_its_images() -> None:
    """No rover comes near the obstacle; holes of the map stop most of them in front of it (NO_PATH)."""
    leg = {"motion": "approach", "goal_m": 2.0, "autonav": True}
    outcomes = set()
    for seed in range(1, 7):
        run = run_slipping_rover(seed, legs=[leg], obstacles=[OBSTACLE], slip={"flat": 0.01}, start={"distance_m": 6.0})
        outcomes.add(run.outcome.name)
        rocks = run.setup.world.rocks
        rock_m = rocks.position_m[rocks.names["obstacle-1"], :2]
        for stance in (stance for stop in run.stops for drive in stop.drives for stance in drive.stances):
            # The circle around all wheels has a radius of 0.6 m.
            distance_m = float(np.hypot(*(stance.world_from_rover.translation[:2] - rock_m)))
            assert distance_m > 0.6 + 0.5 * OBSTACLE["diameter_m"] - 0.05
    assert "COMPLETED" in outcomes
    assert outcomes <= {"COMPLETED", "NO_PATH"}


def test_oracles_need_no_navigation_cameras() -> None:
    leg = {"motion": "approach", "goal_m": 4.5, "autonav": True, "visual_odometry": True}
    run = run_slipping_rover(legs=[leg], navigation={"odometry": "oracle-motion", "terrain": "oracle-heights"})
    assert run.setup.navigation_cameras.mast is run.setup.navigation_cameras.body is None
    assert _position_error_m(run) < 0.05


@pytest.mark.parametrize(("name", "defocus_px"), [("research-navcam", 1.5), ("research-pancam", 0.0)])
def test_navcam_has_the_optics_of_the_camera_parameters(name: str, defocus_px: float) -> None:
    """6 px of defocus are 1.5 px of an image with 4 x 4 pixels summed; the pancam does not navigate."""
    leg = {"motion": "approach", "goal_m": 4.5, "visual_odometry": True}
    camera = {"preset": name, "defocus_px": 6.0, "dust_discs": 3, "stray_light": 0.2}
    parameters = RoverScenarioParameters.model_validate({**SLIPPING_ROVER, "camera": camera, "legs": [leg]})
    pair = prepare_run(parameters, Streams(4, "rover tests", 0)).setup.navigation_cameras.mast
    assert pair is not None
    for detector in pair.camera.detectors:
        optics, is_same = detector.parameters.optics, name == "research-navcam"
        assert optics.defocus_px == defocus_px
        assert (optics.dust_discs, optics.stray_light) == ((3, 0.2) if is_same else (0, 0.0))


OPENCV_CALIBRATION = (
    "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [640, 0, 321, 0, 640, 238, 0, 0, 1]}\n"
    "distortion_coefficients: {data: [-0.1, 0.02, 0, 0]}\n"
)
#: Datasheet of a machine vision sensor, specified for sunlight on Earth.
SENSOR_DATASHEET = (
    "pixel_pitch_um = 4.8\nfull_well_e = 10000\nread_noise_e = 5\nbits = 10\nquantum_efficiency = 0.5\n"
    "dark_current_e_s = 20\ndark_temperature_c = 20\nrows = 480\nreadout_s = 0.02\nsun_au = 1.0\n"
    "[lens]\nf_number = 4\nband_nm = [450, 700]\n"
)


@pytest.mark.parametrize(
    ("name", "baseline_m", "toe_in_deg"), [("mer-navcam", 0.20, 0.0), ("research-pancam", 0.30, 1.0)]
)
def test_pair_from_files_equals_the_preset(name: str, baseline_m: float, toe_in_deg: float, tmp_path: Path) -> None:
    """The pose of the pair in the files does not matter: only the relative pose of the two cameras is used."""
    file_pose = rigid(Rotation.from_euler("xyz", [20.0, -50.0, 130.0], degrees=True), np.array([3.0, -8.0, 1.5]))
    for side, camera in zip(("left", "right"), preset(name).cameras(), strict=True):
        write_cahvor(camera.transform(file_pose), tmp_path / f"{side}.cahvor")
    files = {side: str(tmp_path / f"{side}.cahvor") for side in ("left", "right")}
    pair_geometry = {"baseline_m": baseline_m, "toe_in_deg": toe_in_deg}
    mast, preset_mast = (
        MastCameraParameters.model_validate({"preset": name, "custom": files | pair_geometry}).mast(),
        stereo_mast(name),
    )
    points = np.array([[2.0, 0.3, -0.2], [4.0, -0.5, 0.4], [30.0, 1.0, 1.0]])
    for camera, expected_camera in ((mast.left, preset_mast.left), (mast.right, preset_mast.right)):
        assert np.allclose(camera.project(points)[0], expected_camera.project(points)[0], rtol=0.0, atol=1e-4)
    assert mast.geometry is preset_mast.geometry


def test_target_is_tracked_with_a_custom_pair(tmp_path: Path) -> None:
    camera, datasheet = tmp_path / "cam0.yaml", tmp_path / "sensor.toml"
    camera.write_text(OPENCV_CALIBRATION)
    datasheet.write_text(SENSOR_DATASHEET)
    custom = {
        "preset": "research-navcam",
        "custom": {"left": str(camera), "baseline_m": 0.24},
        "detector": str(datasheet),
    }
    parameters = RoverScenarioParameters.model_validate({**SHORT_RUN, "camera": custom})
    # The campaign stores all calibration values, so the files are not necessary.
    camera.unlink()
    datasheet.unlink()
    parameters = RoverScenarioParameters.model_validate(parameters.model_dump(mode="json", round_trip=True))
    result = RoverScenario().run(parameters, Streams(1, "own pair", 0))
    row = dict(result.row)
    assert (result.outcome, row["camera"], row["navcam"]) == ("COMPLETED", str(camera), False)
    # One pixel of disparity is 8 cm of range at 3.5 m (Eq. 1 of the tracking paper). The calibration error is at most
    # half a pixel.
    assert 0.0 < float(row["position_error_m"]) < 0.06
    # The brightest counts use the 10-bit range of the detector.
    counts = result.products["stop_1_left"]
    assert 200 < np.percentile(counts, 99) <= 1023


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"custom": {"left": "none.cahvor", "baseline_m": 0.2}}, "none.cahvor"),
        ({"custom": {"left": "small.yaml", "right": "large.yaml", "baseline_m": 0.2}}, "640 x 480 pixels, the right"),
        ({"detector": {"preset": "mer-descent-flown"}}, "rows_summed is 4; allowed for cameras on a mast: 1"),
    ],
)
def test_invalid_camera_pairs_are_rejected(
    values: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "small.yaml").write_text(OPENCV_CALIBRATION)
    (tmp_path / "large.yaml").write_text(OPENCV_CALIBRATION.replace("640\nimage_height", "800\nimage_height"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValidationError, match=message):
        MastCameraParameters.model_validate(values)
