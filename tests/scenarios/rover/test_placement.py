"""Tests of the instrument's placement, of points on a rock, and of campaigns whose runs are a list."""

from typing import Any

import numpy as np
import pytest
import trimesh

from marsyard.algorithms.vtt.arm import Placement, PlacementOutcome, measure_surface
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.rover.closed_loop import prepare_run, track_target
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.placement import place_on_target, placement_row, placement_truth, sample_surface
from marsyard.scenarios.rover.points import (
    RockOutline,
    enclosing_spheres,
    find_self_occlusion,
    find_self_shadow,
    patch_normal,
    ray_distances,
    spheres_near_line,
)
from marsyard.scenarios.rover.run_state import RoverRun
from marsyard.scenarios.rover.scenario import RoverScenario
from marsyard.scenarios.rover.shared_drive import SharedDriveScenario
from marsyard.scenarios.rover.shared_drive_parameters import SharedDriveParameters
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN

#: A slab that the rover approaches to 2.2 m.
SLAB: dict[str, Any] = {
    **SHORT_RUN,
    "start": {"distance_m": 2.6},
    "target": {"diameter_m": 1.2, "height_m": 0.25, "up": 0.6, "shape": 8, "yaw_deg": 30.0},
    "legs": [{"motion": "approach", "goal_m": 2.2, "step_fraction": 0.1}],
}


@pytest.fixture(scope="module")
def placed_run() -> tuple[bool, RoverRun]:
    """Return whether the target of a short run is placeable, and the run."""
    parameters = RoverScenarioParameters.model_validate(SLAB)
    run = prepare_run(parameters, Streams(1, "placement tests", 0))
    placeable = placement_truth(run)["placeable"]
    return bool(placeable), place_on_target(track_target(parameters, run))


def test_instrument_is_placed_on_the_target(placed_run: tuple[bool, RoverRun]) -> None:
    placeable, run = placed_run
    row = placement_row(run)
    assert placeable
    assert run.handed_off
    assert (row["placed"], row["placement_safe"]) == (True, True)
    assert run.placement is not None
    # along the normal the contact is on the measured surface, within 3 cm; across, within 8 mm
    assert float(row["placement_error_m"]) < 0.03
    assert float(row["tool_overlap_m"]) <= 0.0


def test_measured_surface_agrees_with_the_rock(placed_run: tuple[bool, RoverRun]) -> None:
    _, run = placed_run
    stop = run.stops[-1]
    target = np.asarray(stop.update.position_rover)
    measured = measure_surface(stop.measurements(run.setup.rig.calibrated), target)
    measured = measured[np.linalg.norm(measured - target, axis=1) < 0.05]
    viewpoint = run.setup.rig.camera_positions(stop.world_from_head)[0]
    true_surface = np.asarray(stop.stance.world_from_rover.inv().apply(sample_surface(run, viewpoint)))
    # the surface within 5 cm covers thousands of pixels of 2 mm; half of them have a match
    assert len(measured) > 500
    distances = np.array([np.linalg.norm(true_surface - point, axis=1).min() for point in measured[::10]])
    # half a pixel of calibration error at 2.6 m is 1.5 cm of range (Eq. 1 of the tracking paper)
    assert np.median(distances) < 0.02


def test_overlap_of_the_true_rock_is_a_collision(placed_run: tuple[bool, RoverRun]) -> None:
    """A tool axis tilted by 60 deg from the surface normal: 5 cm x tan(60 deg) exceeds the clearance."""
    _, run = placed_run
    assert run.placement.normal_rover is not None
    normal = run.placement.normal_rover
    across = np.cross(normal, [0.0, 1.0, 0.0])
    tilted = 0.5 * normal + np.sqrt(0.75) * across / np.linalg.norm(across)
    original = run.placement
    run.placement = Placement(PlacementOutcome.PLACED, original.position_rover, tilted)
    row = placement_row(run)
    run.placement = original
    overlap = row["tool_overlap_m"]
    assert isinstance(overlap, float)
    assert overlap > 0.02
    assert not row["placement_safe"]


def test_run_without_a_hand_off_is_not_placed() -> None:
    parameters = RoverScenarioParameters.model_validate({**SLAB, "legs": [{"motion": "stay", "steps": 1}]})
    run = place_on_target(track_target(parameters, prepare_run(parameters, Streams(1, "placement tests", 0))))
    assert run.placement is None
    assert not placement_row(run)["placed"]


@pytest.fixture(scope="module")
def sphere() -> np.ndarray:
    """Return the triangles of a sphere with radius 0.5 m and centre (5, 0, 0.5)."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    return np.asarray(np.asarray(mesh.triangles, dtype=np.float64) + np.array([5.0, 0.0, 0.5]))


def test_ray_distances_match_a_sphere(sphere: np.ndarray) -> None:
    eye = np.array([0.0, 0.0, 1.5])
    rng = np.random.default_rng(1)
    aim_points = np.array([5.0, 0.0, 0.5]) + 0.35 * rng.uniform(-1.0, 1.0, (40, 3))
    directions = (aim_points - eye) / np.linalg.norm(aim_points - eye, axis=1, keepdims=True)
    offset = eye - np.array([5.0, 0.0, 0.5])
    # Nearer root of |offset + t * direction| = radius.
    projection = directions @ offset
    exact_distances = -projection - np.sqrt(projection * projection - offset @ offset + 0.25)
    # The 5,120 flat triangles lie inside the sphere by up to 0.1 % of the radius; oblique rays increase the error.
    np.testing.assert_allclose(ray_distances(sphere, eye, directions), exact_distances, atol=4e-3)
    assert np.isinf(ray_distances(sphere, eye, -directions[:1])[0])


def test_outline_points_are_on_the_visible_face(sphere: np.ndarray) -> None:
    eye = np.array([0.0, 0.0, 1.5])
    outline = RockOutline.from_triangles(sphere, eye, 0.0)
    front = outline.point(0.0, 0.5)
    assert np.linalg.norm(front - [5.0, 0.0, 0.5]) == pytest.approx(0.5, abs=1e-3)
    assert front[0] < 4.6
    # Arguments of `point`: from left (-1) to right (1), from foot (0) to top (1). For a view along +x, right is -y.
    assert outline.point(0.8, 0.5)[1] < -0.3 < 0.3 < outline.point(-0.8, 0.5)[1]
    assert outline.point(0.0, 0.9)[2] > front[2] > outline.point(0.0, 0.1)[2]


def test_far_side_is_occluded_and_side_away_from_sun_is_shaded(sphere: np.ndarray) -> None:
    near_point, far_point = np.array([4.5, 0.0, 0.5]), np.array([5.5, 0.0, 0.5])
    points, eye = np.stack([near_point, far_point]), np.array([0.0, 0.0, 1.5])
    assert find_self_occlusion(sphere, points, eye).tolist() == [False, True]
    western_sun = np.array([-np.cos(0.5), 0.0, np.sin(0.5)])
    assert find_self_shadow(sphere, points, western_sun).tolist() == [False, True]


def test_normals_match_the_sphere(sphere: np.ndarray) -> None:
    eye, centre = np.array([0.0, 0.0, 0.5]), np.array([5.0, 0.0, 0.5])
    outline = RockOutline.from_triangles(sphere, eye, 0.0)
    for right_fraction in (-0.9, -0.5, 0.0, 0.7):
        point = outline.point(right_fraction, 0.5)
        normal = patch_normal(sphere, eye, point, 0.01)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        # A triangle of the sphere is 3.5 deg wide.
        assert normal @ (point - centre) / np.linalg.norm(point - centre) > np.cos(np.radians(3.5))


def test_triangles_near_a_line_contain_all_intersections(sphere: np.ndarray) -> None:
    eye, half_angle_rad = np.array([0.0, 0.0, 0.5]), 0.03
    rng = np.random.default_rng(2)
    for point in RockOutline.from_triangles(sphere, eye, 0.0).point(0.4, 0.7), np.array([5.0, 0.4, 0.8]):
        near_triangles = sphere[spheres_near_line(enclosing_spheres(sphere), eye, point, half_angle_rad)]
        assert 0 < len(near_triangles) < 0.2 * len(sphere)
        central_direction = (point - eye) / np.linalg.norm(point - eye)
        rays = central_direction + np.tan(half_angle_rad) * rng.uniform(-0.7, 0.7, (200, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays = rays[rays @ central_direction > np.cos(half_angle_rad)]
        np.testing.assert_array_equal(ray_distances(near_triangles, eye, rays), ray_distances(sphere, eye, rays))


VARIANTS: list[dict[str, Any]] = [
    {"diameter_m": 0.18, "leg": {"goal_m": 2.0}},
    {"diameter_m": 1.0, "leg": {"goal_m": 2.0, "visual_odometry": True}, "incline": {"name": "ramp", "slope_deg": 9.0}},
]


def test_variant_replaces_leg_ground_and_rock() -> None:
    p = RoverScenarioParameters.model_validate({**SHORT_RUN, "variants": VARIANTS, "variant": 1})
    selected = RoverScenario().check_parameters(p)
    assert [leg.visual_odometry for leg in selected.legs] == [True]
    assert (selected.target.diameter_m, selected.target.shape) == (1.0, 8)
    assert (selected.world.incline.slope_deg, selected.world.samples) == (9.0, 1024)
    # selected parameters have no variants; a second check does not change them
    assert RoverScenario().check_parameters(selected) == selected
    with pytest.raises(ValueError, match="variant is 2; allowed: 0 to 1"):
        RoverScenarioParameters.model_validate({**SHORT_RUN, "variants": VARIANTS, "variant": 2})


def test_regression_campaign_has_the_14_runs_of_the_paper() -> None:
    """Six ways of driving on level ground and visual odometry on the ramp, to a small and to a large rock."""
    campaign = load_campaign("vtt-regression")
    assert campaign.definition.cases == 14
    scenario = RoverScenario()
    runs = [scenario.check_parameters(campaign.parameters(case)) for case in range(14)]
    legs = [run.legs[0] for run in runs]
    assert (
        len({(run.target.diameter_m, run.world.incline.name, leg) for run, leg in zip(runs, legs, strict=True)}) == 14
    )
    ramp = [leg for run, leg in zip(runs, legs, strict=True) if run.world.incline.slope_deg]
    # wheel odometry does not measure the slip on a slope
    assert [(leg.visual_odometry, leg.autonav) for leg in ramp] == [(True, False)] * 2


@pytest.mark.slow
def test_shadow_of_a_shared_drive_does_not_depend_on_the_tracker() -> None:
    """The sun is 30 deg high behind the rover: at the last stop the mast shades the middle of the rock."""
    values: dict[str, Any] = {
        "drive": {
            **SHORT_RUN,
            "start": {"distance_m": 2.6},
            "sun": {"hour_angle_deg_min": 0.0},
            "legs": [{"motion": "approach", "goal_m": 1.3, "step_fraction": 0.25, "steps": 2}],
            "algorithm": "tests.scenarios.rover.trackers:LosingTracker",
        },
        "variants": [
            {"diameter_m": 0.8, "height_m": 0.4, "shape": 8, "sun_azimuth_deg": 270.0, "sun_elevation_deg": 30.0}
        ],
        "targets": [{"across": 0.0, "up": 0.5}],
    }
    scenario = SharedDriveScenario()
    row = scenario.run(SharedDriveParameters.model_validate(values), Streams(1, "shared shadow", 0)).row
    # the tracker loses the target at the second stop, before the shadow arrives
    assert not row["tracked"]
    assert (row["rover_shadow_on_target"], row["no_rover_shadow_on_target"]) == (True, False)
    values["drive"] = {**values["drive"], "rover_shadow": False}
    row = scenario.run(SharedDriveParameters.model_validate(values), Streams(1, "shared shadow", 0)).row
    assert not row["rover_shadow_on_target"]
