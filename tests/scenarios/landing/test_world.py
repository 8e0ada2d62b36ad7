"""Tests of a landing's illumination and terrains, of true slope and roughness, and of the choice of an image pair."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from marsyard.scenarios.landing import kernels
from marsyard.scenarios.landing.flight import true_states
from marsyard.scenarios.landing.pair_choice import choose_pair
from marsyard.scenarios.landing.parameters import LandingScenarioParameters, PairParameters
from marsyard.scenarios.landing.relief import Limits, Relief
from marsyard.scenarios.landing.scenario import LandingScenario
from marsyard.scenarios.landing.world import LandingWorld
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor import preset
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import site


@pytest.mark.parametrize(("site_name", "camera"), [("gusev", "mer-descent-flown"), ("heli-hazardous", "xc-55")])
def test_camera_preset_refers_to_the_sunlight_on_the_planet_of_its_site(site_name: str, camera: str) -> None:
    # The responsivity of a preset already contains the factor of 0.44 for sunlight on Mars (1.5 au), or 1 on Earth.
    environment = site(site_name).environment
    assert environment.solar_irradiance / preset(camera).detector.sunlight == pytest.approx(1.0, abs=0.02)


def test_electron_count_does_not_depend_on_the_sun_distance_of_the_responsivity() -> None:
    """The responsivity (electrons/s) decreases with the square of the distance from the sun for which it is given."""
    small_terrain = {"terrain": {"samples": 256}, "location": {"bank": 1}}
    electrons = []
    for sun_au in (1.0, 1.5, 3.0):
        detector = {"preset": "xc-55", "sun_au": sun_au, "responsivity_e_s": 1e7 / sun_au**2}
        parameters = LandingScenarioParameters.model_validate({**small_terrain, "detector": detector})
        electrons.append(LandingWorld.from_parameters(parameters).brightness * parameters.detector.responsivity_e_s)
    assert electrons == pytest.approx([electrons[0]] * 3, rel=1e-12)


def test_velocity_at_the_images_is_that_of_the_motion_between_them() -> None:
    poses = {"height_m": 20.0, "climb_fraction": -0.15, "speed_m_s": 0.65}
    parameters = LandingScenarioParameters.model_validate({"terrain": {"samples": 256}, "image_poses": poses})
    first, second = true_states(parameters, LandingWorld.from_parameters(parameters).surface, Streams(1, "poses", 0))
    velocity = (second.position_m - first.position_m) / (second.time_s - first.time_s)
    np.testing.assert_allclose([first.velocity_m_s, second.velocity_m_s], [velocity, velocity])
    assert np.linalg.norm(velocity) == pytest.approx(0.65)


@pytest.mark.parametrize(("bank", "n_built"), [(1, 1), (64, 64), (65, 0), (10_000, 0)])
def test_only_small_banks_are_built_in_advance(bank: int, n_built: int) -> None:
    parameters = LandingScenarioParameters.model_validate({"location": {"bank": bank}})
    assert LandingScenario().shared_inputs(parameters) == tuple(range(n_built))


LIMITS = Limits(diameter_m=2.0, max_slope_rad=float(np.radians(15.0)), max_roughness_m=0.2)
SPACING_M = 0.025


def _make_relief(slope: float = 0.0, block_height_m: float = 0.0, half_width_m: float = 0.1) -> Relief:
    """Return a 6 m x 6 m relief that rises to the east, with a block at its centre."""
    x, y = np.meshgrid(np.arange(-3.0, 3.0, SPACING_M), np.arange(-3.0, 3.0, SPACING_M))
    heights = slope * x + block_height_m * ((abs(x) < half_width_m) & (abs(y) < half_width_m))
    return Relief(heights, -3.0, -3.0, SPACING_M)


def test_plane_has_exact_slope_and_no_roughness() -> None:
    footprints = _make_relief(slope=np.tan(np.radians(10.0))).footprints(np.array([[0.0, 0.0], [1.2, -0.7]]), LIMITS)
    np.testing.assert_allclose(np.degrees(footprints.slope_rad), 10.0, atol=1e-9)
    np.testing.assert_allclose(footprints.roughness_m, 0.0, atol=1e-9)
    assert footprints.safe.all()
    assert not _make_relief(slope=np.tan(np.radians(15.1))).footprints(np.array([[0.0, 0.0]]), LIMITS).safe.any()


@pytest.mark.parametrize("side_m", [SPACING_M, 2 * SPACING_M, 8 * SPACING_M, 9 * SPACING_M])
def test_mean_height_of_a_square_on_a_plane_is_that_of_its_centre(side_m: float) -> None:
    relief = _make_relief(slope=0.4)
    relief = Relief(relief.heights_m + 0.1 * relief.heights_m.T, -3.0, -3.0, SPACING_M)
    points = np.array([[[0.0, 0.0], [1.21, -0.73]]])
    # cv2 interpolates at multiples of 1/32 point: 0.8 mm / 2 x slope
    np.testing.assert_allclose(relief.average(points, side_m), points @ [0.4, 0.04], atol=2e-4)


def test_block_is_a_hazard_only_inside_the_footprint() -> None:
    relief = _make_relief(slope=0.1, block_height_m=0.3)
    footprints = relief.footprints(np.array([[0.0, 0.0], [1.0, 0.0], [1.2, 0.0]]), LIMITS)
    # The fitted plane is nearly the ground, because the block is small. The cost of deviations below
    # 0.1 mm is quadratic, so the block tilts the plane slightly.
    np.testing.assert_allclose(footprints.roughness_m, [0.3, 0.3, 0.0], atol=1e-5)
    np.testing.assert_array_equal(footprints.safe, [False, False, True])
    # The block is 0.2 m x 0.2 m: 8 x 8 points of 25 mm, without those at its edges.
    assert footprints.exceeding_m2[0] == pytest.approx(0.04, rel=0.15)


def _make_uneven_relief(height_m: float = 0.3) -> Relief:
    """Return a 6 m x 6 m relief with mounds and hollows of half a metre width."""
    noise = np.random.default_rng(3).standard_normal((240, 240))
    smooth_noise = gaussian_filter(noise, 20.0)
    return Relief(height_m * smooth_noise / abs(smooth_noise).max(), -3.0, -3.0, SPACING_M)


def test_plane_minimises_absolute_deviations() -> None:
    relief = _make_uneven_relief()
    position = np.array([0.4, -0.3])
    footprints = relief.footprints(position[None], LIMITS)
    row, column = np.rint(relief.cells(position)).astype(int)
    # The lander radius of 1 m is 40 grid points.
    row_offset, column_offset = (index.ravel() for index in np.mgrid[-40:41, -40:41])
    in_footprint = np.hypot(row_offset, column_offset) <= 40
    row_offset, column_offset = row_offset[in_footprint], column_offset[in_footprint]
    heights = relief.heights_m[row + row_offset, column + column_offset]
    # Independent method: linear program for the same points, minimise sum t with -t <= z - plane <= t.
    # The fit uses every fourth row and column.
    in_fit = (row_offset % 4 == 0) & (column_offset % 4 == 0)
    design = np.stack([np.ones(len(row_offset)), column_offset * SPACING_M, row_offset * SPACING_M], axis=-1)
    fit_design, n_fit = design[in_fit], int(in_fit.sum())
    bounds = np.block([[fit_design, -np.eye(n_fit)], [-fit_design, -np.eye(n_fit)]])
    solution = linprog(
        np.r_[np.zeros(3), np.ones(n_fit)],
        bounds,
        np.r_[heights[in_fit], -heights[in_fit]],
        bounds=[(None, None)] * (3 + n_fit),
    )
    assert solution.x is not None
    plane = solution.x[:3]
    assert footprints.slope_rad[0] == pytest.approx(np.arctan(np.hypot(*plane[1:])), abs=1e-3)
    assert footprints.roughness_m[0] == pytest.approx(abs(heights - design @ plane).max(), abs=1e-3)


def test_footprint_plane_is_continuous_in_position() -> None:
    steps = np.arange(-1.5, 1.5, SPACING_M)
    for x, y in ((steps, np.full_like(steps, 0.2)), (np.full_like(steps, -0.4), steps)):
        footprints = _make_uneven_relief().footprints(np.stack([x, y], axis=-1), LIMITS)
        # The slope is at most 0.5: one step changes a height, and therefore the plane, by at most 1.3 cm.
        assert np.abs(np.diff(footprints.roughness_m)).max() < 0.02
        assert np.abs(np.diff(np.tan(footprints.slope_rad))).max() < 0.02


def test_rock_on_a_fifth_of_the_footprint_does_not_tilt_the_plane() -> None:
    # A square of 0.8 m at the centre: 0.64 of 3.14 m2.
    footprints = _make_relief(slope=0.1, block_height_m=0.3, half_width_m=0.4).footprints(np.zeros((1, 2)), LIMITS)
    assert np.tan(footprints.slope_rad[0]) == pytest.approx(0.1, abs=1e-3)
    assert footprints.roughness_m[0] == pytest.approx(0.3, abs=1e-3)


def test_footprint_outside_the_height_grid_is_rejected() -> None:
    with pytest.raises(ValueError, match="beyond the grid of exact heights"):
        _make_relief().footprints(np.array([[2.5, 0.0]]), LIMITS)


def test_triangles_raise_the_ground() -> None:
    """Heights below a triangle with corners at 1, 1 and 3 m are raised to it; the other heights do not change."""
    heights = np.zeros((5, 5))
    vertices = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [0.0, 4.0, 3.0]])
    faces = np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)
    kernels.raise_by_triangles(heights, 0.0, 0.0, 1.0, vertices, faces)
    row, column = np.indices((5, 5))
    np.testing.assert_allclose(heights, np.where(row + column <= 4, 1.0 + 0.5 * row, 0.0))


CAMERA = preset("xc-55").cameras()[0]
HEIGHT_M = 10.0
#: Measured range at each of 40 images.
RANGES_M = np.full(40, HEIGHT_M)


def _make_poses(step_m: float, count: int = 40, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> list[PoseMeasurement]:
    """Return nadir poses that are `step_m` apart along x; all poses but the first are rotated by yaw and pitch."""
    poses = []
    for number in range(count):
        angles = [yaw_deg * (number > 0), pitch_deg * (number > 0)]
        rotation = Rotation.from_euler("zy", angles, degrees=True)
        poses.append(PoseMeasurement(rigid(rotation, np.array([number * step_m, 0.0, HEIGHT_M])), 0.1 * number))
    return poses


def test_shortest_sufficient_baseline_has_max_overlap() -> None:
    choice = choose_pair(_make_poses(0.125), RANGES_M, CAMERA, PairParameters(max_baseline_fraction=0.2), HEIGHT_M)
    # the maximum baseline, 0.2 x 10 m, is 16 steps of 0.125 m
    assert (choice.first, choice.second) == (0, 16)
    assert choice.baseline_m == pytest.approx(2.0)
    # Field width at 10 m: 640 px of 7.4 um and a focal length of 6 mm give 7.89 m, with lens distortion 8.04 m.
    assert choice.overlap == pytest.approx(1.0 - 2.0 / 8.0, abs=0.006)


def test_product_of_baseline_and_overlap_is_maximal_without_baseline_limit() -> None:
    """With the field width w, b (1 - b / w) is maximal at b = w / 2 = 4.0 m, where the overlap is one half."""
    choice = choose_pair(
        _make_poses(0.125), RANGES_M, CAMERA, PairParameters(max_baseline_fraction=1.0, min_overlap=0.1), HEIGHT_M
    )
    assert choice.baseline_m == pytest.approx(4.0, abs=0.13)
    # A larger required overlap limits the baseline.
    choice = choose_pair(
        _make_poses(0.125), RANGES_M, CAMERA, PairParameters(max_baseline_fraction=1.0, min_overlap=0.7), HEIGHT_M
    )
    assert choice.baseline_m == pytest.approx(0.3 * 8.0, abs=0.13)


def test_rotation_reduces_overlap() -> None:
    """A pitch of 10 deg shifts the footprint of the second image by 10 m tan 10 deg = 1.76 m."""
    no_pitch, pitch_with_motion, pitch_against_motion = (
        choose_pair(_make_poses(0.5, 2, pitch_deg=deg), RANGES_M[:2], CAMERA, PairParameters(), HEIGHT_M).overlap
        for deg in (0.0, -10.0, 10.0)
    )
    assert no_pitch == pytest.approx(1.0 - 0.5 / 8.0, abs=0.005)
    for overlap, sign in ((pitch_with_motion, 1.0), (pitch_against_motion, -1.0)):
        assert overlap == pytest.approx(1.0 - abs(0.5 + sign * 1.76) / 8.0, abs=0.03)


def test_rotation_that_cancels_the_motion_in_the_image_is_not_preferred() -> None:
    """The baseline decides: with the default parameters it is 0.2 of the range, as without the rotation."""
    choice = choose_pair(_make_poses(0.125, yaw_deg=10.0), RANGES_M, CAMERA, PairParameters(), HEIGHT_M)
    assert choice.baseline_m == pytest.approx(2.0, abs=0.13)


def test_missing_range_uses_commanded_height() -> None:
    choice = choose_pair(_make_poses(0.125), np.full(40, np.nan), CAMERA, PairParameters(), HEIGHT_M)
    assert (choice.first, choice.second) == (0, 16)


def test_pair_with_too_small_overlap_is_accepted_without_alternative() -> None:
    choice = choose_pair(_make_poses(5.0, 3), RANGES_M[:3], CAMERA, PairParameters(min_overlap=0.9), HEIGHT_M)
    assert (choice.first, choice.second) == (0, 1)
    with pytest.raises(ValueError, match="at least 2"):
        choose_pair(_make_poses(1.0, 1), RANGES_M[:1], CAMERA, PairParameters(), HEIGHT_M)
