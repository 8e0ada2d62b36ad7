"""Tests of the true overlap of descent images, of the slopes of the sites over it, and of the touchdown velocity."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes import DimesOptions
from marsyard.scenarios.conformance.parts import swinging_fall
from marsyard.scenarios.descent.overlap import ZERO_PHASE_RADIUS_RAD, footprint, overlap_width_m, zero_phase_spot
from marsyard.scenarios.descent.parameters import TouchdownParameters
from marsyard.scenarios.descent.touchdown import compute_touchdown
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import TerrainBank, site

#: Direction to a sun 10 deg above the horizon in the south: its bright spot is outside of images at the nadir.
LOW_SUN = np.array([0.0, -np.cos(np.radians(10.0)), np.sin(np.radians(10.0))])
#: Resolution of a width: a cell on each side.
CELLS_M = 10.0


def make_camera() -> CameraModel:
    (camera,) = preset("mer-descent-flown").cameras()
    return camera


def make_state(east_m: float, height_m: float = 1000.0) -> State:
    """Return a state at a height above the datum; the camera points down."""
    position_m = np.array([east_m, 0.0, height_m])
    return replace(swinging_fall().state(0.0), position_m=position_m, attitude=Rotation.identity())


def half_widths_m(camera: CameraModel) -> np.ndarray:
    """Return half the width of the footprint from 1000 m, east and north."""
    return np.ptp(footprint(make_state(0.0), camera, 0.0), axis=0) / 2.0


def test_width_without_motion_is_that_of_the_footprint() -> None:
    """A field of view of 45 deg (paper, section II) is 830 m wide at a height of 1000 m."""
    camera = make_camera()
    width = overlap_width_m([make_state(0.0), make_state(0.0)], camera, 0.0, LOW_SUN)
    assert width == pytest.approx(2.0 * half_widths_m(camera).min(), abs=CELLS_M)
    assert width == pytest.approx(830.0, rel=0.05)
    # twice the height above the ground
    raised = overlap_width_m([make_state(0.0), make_state(0.0)], camera, -1000.0, LOW_SUN)
    assert raised == pytest.approx(2.0 * width, rel=0.02)


@pytest.mark.parametrize("width_m", [300.0, 110.0, 0.0])
def test_width_decreases_by_the_tilt_between_the_images(width_m: float) -> None:
    """A tilt b moves the near edge of the second footprint to h tan(b - a), for a half field of view a."""
    camera = make_camera()
    half_m = half_widths_m(camera)[0]
    tilt_rad = np.arctan((half_m - width_m) / 1000.0) + np.arctan(half_m / 1000.0)
    tilted = replace(make_state(0.0), attitude=Rotation.from_rotvec([0.0, -tilt_rad, 0.0]))
    width = overlap_width_m([make_state(0.0), tilted], camera, 0.0, LOW_SUN)
    assert width == pytest.approx(width_m, abs=CELLS_M)


@pytest.mark.parametrize("motion_m", [100.0, 1000.0])
def test_width_is_that_without_horizontal_motion(motion_m: float) -> None:
    """The paper assumes no horizontal motion between the images, and requires 110 m for a motion of 30 m/s (II.A)."""
    camera = make_camera()
    still, moved = (
        overlap_width_m([make_state(0.0), make_state(east_m)], camera, 0.0, LOW_SUN) for east_m in (0.0, motion_m)
    )
    assert moved == still > 0.0


def test_bright_spot_is_excluded() -> None:
    """With the sun in the zenith the spot is a disc at the nadir; the largest circle is in a corner next to it."""
    camera, sun = make_camera(), np.array([0.0, 0.0, 1.0])
    radius = 1000.0 * np.tan(ZERO_PHASE_RADIUS_RAD)
    spot = zero_phase_spot(make_state(0.0), 0.0, sun)
    assert np.hypot(*spot.T) == pytest.approx(np.full(len(spot), radius), rel=1e-9)
    width = overlap_width_m([make_state(0.0), make_state(0.0)], camera, 0.0, sun)
    # circle of radius r that touches two sides of a square of half width a, and the spot: sqrt(2) (a - r) = r + spot
    half = half_widths_m(camera).min()
    expected = 2.0 * (np.sqrt(2.0) * half - radius) / (1.0 + np.sqrt(2.0))
    assert width == pytest.approx(expected, rel=0.06)


#: Side of the square whose plane is fitted, m: about the overlap of two descent images.
SIDE_M = 1000.0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sd_deg"), [("gusev", 0.32), ("meridiani", 0.38)])
def test_slopes_over_a_kilometre_are_below_the_prior(name: str, sd_deg: float) -> None:
    """The values per axis are those of 60 and 40 descents over 12 terrains (calibration seed 5406)."""
    terrain = site(name).terrain("descent").model_copy(update={"samples": 2048, "spacing_m": 2.0})
    bank = TerrainBank(terrain, 1)
    steps = np.linspace(-0.5 * SIDE_M, 0.5 * SIDE_M, 41)
    east, north = (grid.ravel() for grid in np.meshgrid(steps, steps))
    design = np.column_stack([east, north, np.ones(east.size)])
    slopes = []
    for number in range(4):
        surface = bank.terrain(number)
        for centre_east, centre_north in np.random.default_rng(number).uniform(0.0, 4096.0, (20, 2)):
            heights = surface.height(centre_east + east, centre_north + north)
            slopes.append(np.linalg.lstsq(design, heights, rcond=None)[0][:2])
    rms_deg = np.degrees(np.sqrt(np.mean(np.square(slopes))))
    # about 16 independent squares of 1 km in each terrain of 4 km: 128 values, and terrains that differ
    assert rms_deg == pytest.approx(sd_deg, rel=0.3)
    assert rms_deg < np.degrees(DimesOptions().slope_sd_rad)


#: Time from the last image to the firing, s; enough for the computation.
AVAILABLE_S = 17.0
IDEAL = TouchdownParameters(steering_error=0.0, burn_error_m_s=0.0)
#: True horizontal velocity before the firing, m/s, with a magnitude of 15.
TRUE_VELOCITY = np.array([12.0, -9.0])


def make_rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    ("true_factor", "estimate_factor", "speed_m_s"),
    [
        (1.0, 1.0, 0.0),
        # steering is limited by its capability
        (2.0, 2.0, 30.0 - IDEAL.max_steering_m_s),
        # steering with the negated velocity doubles the velocity
        (1.0, -1.0, 30.0),
    ],
)
def test_burn_is_steered_against_the_estimate(true_factor: float, estimate_factor: float, speed_m_s: float) -> None:
    true, estimate = true_factor * TRUE_VELOCITY, estimate_factor * TRUE_VELOCITY
    result = compute_touchdown(IDEAL, true, estimate, AVAILABLE_S, make_rng())
    np.testing.assert_allclose(result.with_answer, speed_m_s * TRUE_VELOCITY / 15.0, atol=1e-12)
    np.testing.assert_allclose(result.without_answer, true)


@pytest.mark.parametrize(
    ("estimate", "available_s"),
    [
        (None, AVAILABLE_S),
        (TRUE_VELOCITY, IDEAL.computation_s - 0.1),
        # 5 m/s: the deadband, up to which the burn is not steered
        (np.array([3.0, -4.0]), AVAILABLE_S),
    ],
)
def test_burn_is_steered_only_by_a_timely_estimate_above_the_deadband(
    estimate: np.ndarray | None, available_s: float
) -> None:
    result = compute_touchdown(IDEAL, TRUE_VELOCITY, estimate, available_s, make_rng())
    np.testing.assert_array_equal(result.with_answer, result.without_answer)
    assert result.is_in_time == (available_s >= IDEAL.computation_s)


def test_burn_and_steering_errors_have_the_specified_standard_deviation() -> None:
    parameters = TouchdownParameters(steering_error=0.1, burn_error_m_s=1.0)
    touchdowns = [
        compute_touchdown(parameters, TRUE_VELOCITY, TRUE_VELOCITY.copy(), AVAILABLE_S, np.random.default_rng(seed))
        for seed in range(2000)
    ]
    without_answer = np.stack([touchdown.without_answer for touchdown in touchdowns]) - TRUE_VELOCITY
    steering = np.stack([touchdown.with_answer - touchdown.without_answer for touchdown in touchdowns]) + TRUE_VELOCITY
    # Relative standard error of a standard deviation from 4000 values: 1 / sqrt(8000) = 1.1 %.
    # The steering error is 10 % of 15 m/s.
    assert without_answer.std() == pytest.approx(1.0, rel=0.05)
    assert steering.std() == pytest.approx(1.5, rel=0.05)
