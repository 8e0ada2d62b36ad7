"""Tests of complete descents: truth, measurements and scores are consistent."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams
from tests.scenarios.descent.descents import DESCENT, FLAT_TERRAIN, IDEAL_INSTRUMENTS, SMALL_WORLD, run_descent


@pytest.fixture(scope="module")
def nominal_case() -> CaseResult:
    """Run case 0 of the descent over the small terrain without changes of its parameters."""
    return run_descent()


def test_velocity_error_is_estimate_minus_truth(nominal_case: CaseResult) -> None:
    row: Any = nominal_case.row
    assert nominal_case.answered
    for name in ("velocity", "firing_velocity"):
        error, estimated, true = (
            np.array([row[f"{name}_{kind}_{axis}_m_s"] for axis in "xy"]) for kind in ("error", "estimated", "true")
        )
        assert error == pytest.approx(estimated - true, abs=1e-12)
        assert row[f"{name}_error_m_s"] == pytest.approx(np.hypot(*error))
        if name == "velocity":
            np.testing.assert_array_equal(nominal_case.products["velocity_true_m_s"], true)
            np.testing.assert_array_equal(nominal_case.products["velocity_estimated_m_s"], estimated)


def test_true_velocity_is_the_mean_camera_velocity() -> None:
    """Without swing and gusts the lander drifts with the wind, which is uniform above the boundary layer of 500 m."""
    no_swing = {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0, "gust_intensity_m_s": 0.0}
    row = run_descent(descent=DESCENT | no_swing).row
    assert row["velocity_true_x_m_s"] == pytest.approx(14.0, abs=1e-6)
    assert row["velocity_true_y_m_s"] == pytest.approx(-9.0, abs=1e-6)
    # In the boundary layer the wind decreases, and the parachute follows.
    assert 0.0 < float(row["firing_velocity_true_x_m_s"]) < 14.0


@pytest.mark.parametrize("wind", [(25.0, 0.0), (0.0, 25.0), (-18.0, -18.0)])
def test_ideal_instruments_over_flat_ground_give_exact_velocity(wind: tuple[float, float]) -> None:
    """Test signs and axes from rendering to estimate. The tolerance is a tenth of a binned pixel in 3.75 s: 0.15 m/s.

    Propagation to the firing with an ideal inertial unit does not change the error.
    """
    east, north = wind
    descent = DESCENT | {"wind_east_m_s": east, "wind_north_m_s": north}
    result = run_descent(**IDEAL_INSTRUMENTS, terrain=FLAT_TERRAIN, descent=descent)
    row = result.row
    assert result.outcome == "VALID"
    assert float(row["velocity_error_m_s"]) < 0.15
    for axis in "xy":
        assert row[f"firing_velocity_error_{axis}_m_s"] == pytest.approx(row[f"velocity_error_{axis}_m_s"], abs=0.01)


def test_reported_attitude_error_corrects_the_propagation_to_the_firing() -> None:
    """An error of the initial attitude tilts the attitudes of the images and of the inertial navigation.

    Over level ground the algorithm knows the tilt. Its velocity error is then small at the images, and also at the
    firing. Without the correction the error grows by gravity times tilt times the time to the firing, 20 s.
    """
    approach = {"attitude_sd_deg": 1.5, "velocity_sd_m_s": 0.0, "spin_scale_ppm": 0.0}
    options = {"correct_tilt": True, "slope_sd_rad": 1e-6, "tilt_sd_rad": 0.03}
    instruments = {**IDEAL_INSTRUMENTS, "approach": approach}
    row: Any = run_descent(**instruments, terrain=FLAT_TERRAIN, algorithm="dimes-custom", dimes=options).row
    tilt_deg = float(row["attitude_error_common_deg"])
    assert tilt_deg > 1.0
    assert row["velocity_error_m_s"] < 0.4
    assert row["firing_velocity_error_m_s"] < 0.6
    assert 3.7 * 15.0 * np.deg2rad(tilt_deg) > 0.9  # error of the propagation without the correction, m/s


def test_instrument_errors_have_the_specified_size(nominal_case: CaseResult) -> None:
    """The altimeter has an error of 1 % at 3 sigma. A gyro scale error of 100 ppm over 38 revolutions is 1.4 deg."""
    rows = [nominal_case.row, *(run_descent(case).row for case in (1, 2))]
    altitude = np.array([float(row["altitude_error_common"]) for row in rows])
    attitude = np.array([float(row["attitude_error_common_deg"]) for row in rows])
    independent = np.array([float(row["attitude_error_independent_deg"]) for row in rows])
    assert np.abs(altitude).max() < 0.015
    assert 0.1 < attitude.max() < 4.2
    # Gyro drift between images is small: a time tag error of 1 ms at 20 deg/s dominates.
    assert independent.max() < 0.1


@pytest.mark.slow
def test_attitude_error_causes_predicted_velocity_error() -> None:
    """An attitude error common to all images rotates the measured displacement, including its vertical component.

    The velocity error is ``b x v`` to first order in the attitude error b. Tolerance: for a template 20 deg from
    nadir the contribution of the vertical velocity is 13 % larger.
    """
    steady = DESCENT | {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0}
    errors, expected = [], []
    for case in range(4):
        row = run_descent(
            case, **IDEAL_INSTRUMENTS, terrain=FLAT_TERRAIN, descent=steady, faults={"attitude_error_deg": 0.8}
        ).row
        descent_m = float(row["altitude_2_m"]) - float(row["altitude_3_m"])
        velocity = [float(row["velocity_true_x_m_s"]), float(row["velocity_true_y_m_s"]), -descent_m / 3.75]
        errors.append([float(row[f"velocity_error_{axis}_m_s"]) for axis in "xy"])
        direction_rad = Streams(1, "test", case).generator("attitude fault").uniform(-np.pi, np.pi)
        tilt = np.radians(0.8) * np.array([np.cos(direction_rad), np.sin(direction_rad), 0.0])
        expected.append(np.cross(tilt, velocity)[:2])
        assert row["attitude_error_common_deg"] == pytest.approx(0.8, abs=1e-3)
        assert float(row["attitude_error_independent_deg"]) < 1e-3
    np.testing.assert_allclose(errors, expected, atol=0.15, rtol=0.13)
    assert np.abs(expected).max() > 1.0


@pytest.mark.parametrize("images", [3, 9])
def test_attitude_error_tilts_the_velocity_changes_of_the_navigation(images: int) -> None:
    """A tilt a turns the specific force f: the velocity change between the pairs has an error of f sin(a) times 3.75 s.

    f is gravity plus the deceleration V^2 / (2 H) in air of scale height H; 3 % for gusts. The propagation to the
    firing, which the same tilt changes with the opposite sign, removes most of the velocity error.
    """
    steady = DESCENT | {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0, "interval_s": 7.5 / (images - 1)}
    fault = {"attitude_error_deg": 5.0}
    row: Any = run_descent(**IDEAL_INSTRUMENTS, terrain=FLAT_TERRAIN, images=images, descent=steady, faults=fault).row
    assert row["attitude_error_common_deg"] == pytest.approx(5.0, abs=1e-3)
    specific_force = 3.71 + 75.0**2 / (2.0 * 11200.0)
    # of nine images, the pairs consist of images 1, 5 and 9
    assert row["velocity_change_error_m_s"] == pytest.approx(specific_force * 3.75 * np.sin(np.radians(5.0)), rel=0.03)
    assert row["velocity_error_m_s"] > 5.0
    assert row["firing_velocity_error_m_s"] < 0.4 * row["velocity_error_m_s"]


def test_common_altitude_error_scales_the_velocity() -> None:
    """An altitude error of +2 % makes displacements and velocity 2 % too large."""
    steady = DESCENT | {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0, "wind_east_m_s": 25.0}
    row = run_descent(**IDEAL_INSTRUMENTS, terrain=FLAT_TERRAIN, descent=steady, faults={"altitude_error": 0.02}).row
    assert row["velocity_error_x_m_s"] == pytest.approx(0.02 * float(row["velocity_true_x_m_s"]), abs=0.12)
    assert row["altitude_error_common"] == pytest.approx(0.02, abs=1e-4)


def test_condition_columns_have_the_simulated_values(nominal_case: CaseResult) -> None:
    row: Any = nominal_case.row
    assert row["altitude_1_m"] == pytest.approx(2000.0, abs=20.0)
    assert row["altitude_1_m"] - row["altitude_3_m"] == pytest.approx(7.5 * row["descent_rate_m_s"], abs=40.0)
    assert row["off_nadir_max_deg"] == max(row[f"off_nadir_{number}_deg"] for number in (1, 2, 3))
    assert 0.0 < row["off_nadir_max_deg"] < 12.0 + 15.0
    assert row["sun_azimuth_deg"] == pytest.approx(270.0)
    assert row["sun_elevation_deg"] == pytest.approx(40.0)
    assert len(row["image_hash"]) == 64
    assert (row["fault"], row["fault_size"], row["site"]) == ("none", 0.0, "plain")
    # 1300 m at about 72 m/s.
    assert 15.0 < float(row["firing_after_s"]) < 21.0


@pytest.mark.parametrize(("altitude_m", "is_feasible"), [(2000.0, True), (700.0, False)])
def test_refusal_counts_if_the_true_overlap_is_sufficient(altitude_m: float, is_feasible: bool) -> None:
    """The camera swings by 42 deg to opposite sides, and DIMES has no two tracks that agree with the IMU.

    From 2000 m both images of the second pair show ground of more than 110 m, and from 700 m of less: the sizes of
    the footprints are proportional to the altitude.
    """
    wide_swing = {"cone_angle_deg": 42.0, "cone_phase_deg": 0.0, "cone_minor_fraction": 0.0}
    result = run_descent(descent=DESCENT | wide_swing | {"altitude_first_m": altitude_m})
    assert result.outcome != "VALID"
    assert result.row["feasible_overlap"] is is_feasible
    assert (float(result.row["overlap_width_second_pair_m"]) >= 110.0) is is_feasible
    assert not result.answered
    for name in ("velocity", "firing_velocity"):
        assert math.isnan(float(result.row[f"{name}_error_m_s"]))
        assert math.isfinite(float(result.row[f"{name}_true_x_m_s"]))


def test_feasible_overlap_does_not_depend_on_the_algorithm(nominal_case: CaseResult) -> None:
    """An altitude error of 40 % makes DIMES search in wrong areas, and templates of 127 px need more space."""
    names = ("feasible_overlap", "overlap_width_first_pair_m", "overlap_width_second_pair_m")
    for changes in ({"faults": {"altitude_error": 0.4}}, {"algorithm": "dimes-custom", "dimes": {"template_px": 127}}):
        changed = run_descent(**changes)
        assert [changed.row[name] for name in names] == [nominal_case.row[name] for name in names]
    assert nominal_case.row["feasible_overlap"] is True


def test_imported_terrain_is_rendered(tmp_path: Path) -> None:
    """The terrain model from a file, inside the terrain of the site, changes the images."""
    heights = 30.0 * np.sin(np.arange(200) / 9.0)[:, None] * np.cos(np.arange(200) / 7.0)
    heights += np.random.default_rng(1).normal(0.0, 1.5, heights.shape)
    np.savez(tmp_path / "dtm.npz", dem=heights, dem_gsd=8.0)
    location = {"location": {"bank": 1, "east_m": 1536.0, "north_m": 1536.0}}
    source = {"source": {"dtm": str(tmp_path / "dtm.npz")}}
    result = run_descent(site="gusev", terrain=SMALL_WORLD["terrain"] | source, **location)
    without_source = run_descent(site="gusev", **location)
    assert result.outcome == "VALID"
    assert result.row["image_hash"] != without_source.row["image_hash"]
    # The imported relief has an amplitude of 30 m within 500 m.
    assert float(result.row["velocity_error_m_s"]) < 4.0


def test_exact_instruments_have_no_instrument_errors(nominal_case: CaseResult) -> None:
    row, nominal = run_descent(exact_instruments=True).row, nominal_case.row
    for name in ("attitude_error_common_deg", "attitude_error_independent_deg", "velocity_change_error_m_s"):
        assert float(row[name]) < 1e-6 < float(nominal[name])
    for name, tolerance in (("altitude_error_common", 1e-9), ("tag_error_1_s", 1e-12)):
        assert abs(float(row[name])) < tolerance < abs(float(nominal[name]))
    assert float(row["velocity_error_m_s"]) < 0.3
    # the propagation to the firing is exact: its error is that of the reported velocity
    for axis in "xy":
        assert row[f"firing_velocity_error_{axis}_m_s"] == pytest.approx(row[f"velocity_error_{axis}_m_s"], abs=0.01)
