"""Tests of the score of a flight's answer against known ground truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import HdaDetails, HdaOptions, Matches, MatchStatus, Safety, Tracks
from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.hazards import HazardMaps, safe_site
from marsyard.algorithms.hda.products import MappedGround
from marsyard.algorithms.hda.scene import CameraView
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.requirements import shipped_requirements
from marsyard.campaigns.running.engine import check_metrics
from marsyard.reports.decision import requirement_masks
from marsyard.scenarios.conformance.parts import swinging_fall
from marsyard.scenarios.hda_stage_columns import stage_row
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.conditions import site_populations
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.helicopter import LandingHelicopterParameters, Transit
from marsyard.scenarios.landing.map_score import SampledMap, map_errors, map_row
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.relief import Footprints, Limits, Relief
from marsyard.scenarios.landing.score import landing_row, motion_row, site_row
from marsyard.scenarios.landing.simulation import RenderedFlight
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor import preset
from marsyard.sim.streams import Streams

SAFE_SITE, UNSAFE_SITE = np.array([-3.0, 0.0, 0.0]), np.array([3.0, 0.0, 0.0])
SITE_REPORTED, NO_SITE_REPORTED = SiteOutcome.SAFE_SITE, SiteOutcome.NO_SAFE_SITE
VIEW = CameraView(
    np.zeros((480, 640), dtype=np.uint16), preset("xc-55").cameras()[0], rigid(Rotation.identity(), np.zeros(3))
)


def make_ground(elevation: ElevationMap, safety: np.ndarray) -> MappedGround:
    """Return a map without slope and roughness."""
    zeros = np.zeros(safety.shape)
    hazards = HazardMaps(zeros, zeros, zeros, safety)
    return MappedGround(
        Rotation.identity(), Rotation.identity(), np.zeros((1, 3)), elevation, hazards, np.zeros(2), None
    )


def make_flight() -> LandingFlight:
    """Return a flight with exact navigation."""
    states = swinging_fall().state(0.0), swinging_fall().state(3.75)
    first, second = (PoseMeasurement(rigid(entry.attitude, entry.position_m), entry.time_s) for entry in states)
    return LandingFlight(states, (first, second), np.array([0.0, 0.0, 1.0]))


def make_truth(n_safe: int) -> GroundTruth:
    """Return 12 m x 12 m of ground, level in the west and too steep in the east, with `n_safe` safe positions.

    Positions have a spacing of 1 m. 25 safe positions form a square; its centre is one lander radius from unsafe
    positions. 3 safe positions form a row without such a margin.
    """
    x, _ = np.meshgrid(np.arange(-6.0, 6.0, 0.1), np.arange(-6.0, 6.0, 0.1))
    axis_m = np.linspace(-4.0, 4.0, 9)
    positions_m = np.stack(np.meshgrid(axis_m, axis_m), axis=-1)
    safe = np.zeros(positions_m.shape[:2], dtype=bool)
    if n_safe == 25:
        safe[2:7, 2:7] = True
    else:
        safe[4, 3 : 3 + n_safe] = True
    zeros = np.zeros(safe.shape)
    footprints = Footprints(zeros, zeros, zeros, safe)
    return GroundTruth(
        Relief(np.maximum(x, 0.0), -6.0, -6.0, 0.1),
        Limits(diameter_m=2.0, max_slope_rad=0.26, max_roughness_m=0.2),
        positions_m,
        footprints,
        covered=np.ones_like(safe),
        step_m=1.0,
    )


@pytest.mark.parametrize(
    ("n_safe", "population"), [(0, "no_safe_site_exists"), (3, "narrow_site_exists"), (25, "wide_site_exists")]
)
def test_each_flight_is_in_exactly_one_population(n_safe: int, population: str) -> None:
    row = site_populations(make_truth(n_safe))
    populations = ("no_safe_site_exists", "narrow_site_exists", "wide_site_exists")
    assert [name for name in populations if row[name]] == [population]


def test_hazard_is_near_where_the_clearance_is_below_half_of_the_largest() -> None:
    truth = make_truth(25)
    fractions = [truth.clearance_fraction(position) for position in truth.positions.reshape(-1, 2)]
    is_near = [truth.has_hazard_near(position) for position in truth.positions.reshape(-1, 2)]
    assert is_near == [fraction < 0.5 for fraction in fractions]
    assert {True, False} == set(is_near)
    # only the border: every position is right
    no_hazard = replace(truth, covered=truth.safe)
    assert not any(no_hazard.has_hazard_near(position) for position in truth.positions.reshape(-1, 2))


def test_flight_without_landing_has_no_touchdown_score() -> None:
    row = landing_row(None, SiteEstimate(NO_SITE_REPORTED, None), make_flight(), make_truth(3))
    assert (row["landed"], row["descent_target_exists"]) == (False, False)
    assert "touchdown_safe" not in row
    # A campaign with touchdown requirements accepts a first case without a landing.
    check_metrics(load_campaign("hda-benign").definition, {**row, "answered": True}, Path())


@pytest.mark.parametrize("name", ["HDA-TOUCHDOWN", "HDA-POS"])
def test_flight_to_a_site_without_touchdown_fails_the_requirements_of_landings(name: str) -> None:
    transit = Transit.fly(
        LandingHelicopterParameters(), np.array([0.0, 0.0, 10.0]), 0.0, 0.0, 9.8, Streams(1, "air", 0)
    )
    flight = replace(make_flight(), transit=transit)
    row = landing_row(None, SiteEstimate(SITE_REPORTED, SAFE_SITE), flight, make_truth(3))
    masks = requirement_masks(pd.DataFrame([row]), shipped_requirements()[name].model_dump())
    assert masks is not None
    assert [mask.tolist() for mask in masks] == [[True], [False]]


@pytest.mark.parametrize(
    ("n_safe", "outcome", "site", "is_safe_or_none", "is_correct"),
    [
        (25, SITE_REPORTED, SAFE_SITE, True, True),
        (25, SITE_REPORTED, UNSAFE_SITE, False, False),
        # refusing is wrong where a safe site with margin exists, and correct where none or only a narrow one exists
        (25, NO_SITE_REPORTED, None, True, False),
        (3, NO_SITE_REPORTED, None, True, True),
        (0, NO_SITE_REPORTED, None, True, True),
        (0, SITE_REPORTED, UNSAFE_SITE, False, False),
        # without convergence the answer is the a-priori site, which is safe by chance
        (3, SiteOutcome.NO_MOTION, SAFE_SITE, False, False),
    ],
)
def test_answer_is_correct_for_the_true_ground(
    n_safe: int, outcome: SiteOutcome, site: np.ndarray | None, is_safe_or_none: bool, is_correct: bool
) -> None:
    row = site_row(SiteEstimate(outcome, site), make_flight(), make_truth(n_safe))
    assert (row["safe_or_no_site_reported"], row["answer_correct"]) == (is_safe_or_none, is_correct)
    assert row["site_safe"] is (outcome is SITE_REPORTED and site is SAFE_SITE)
    assert row["descent_target_safe"] is (site is SAFE_SITE)


def test_clearance_is_relative_to_the_farthest_position() -> None:
    """Ground of 9 m x 9 m with a hazard in the corner (-4, -4); the unseen ground begins 1 m beyond the outer ones.

    The centre is farthest from both: 5 m from the unseen ground, and more from the hazard.
    """
    truth = make_truth(0)
    safe = np.ones_like(truth.covered)
    safe[0, 0] = False
    truth = replace(truth, footprints=replace(truth.footprints, safe=safe))
    assert truth.clearance_fraction(np.array([0.0, 0.0])) == 1.0
    assert truth.clearance_fraction(np.array([2.0, 0.0])) == pytest.approx(3.0 / 5.0)
    assert truth.clearance_fraction(np.array([-3.0, -3.0])) == pytest.approx(np.sqrt(2.0) / 5.0)
    # at the border, at a hazard, and outside of the images
    assert truth.clearance_fraction(np.array([4.0, 4.0])) == pytest.approx(1.0 / 5.0)
    assert truth.clearance_fraction(np.array([-4.0, -4.0])) == 0.0
    assert truth.clearance_fraction(np.array([9.0, 0.0])) == 0.0
    far, near = (
        site_row(SiteEstimate(SITE_REPORTED, np.array([x, x, 0.0])), make_flight(), truth) for x in (1.0, -3.0)
    )
    assert (far["site_far_from_hazards"], near["site_far_from_hazards"]) == (True, False)
    # a slope of 45 deg: the ground is at 1 m, and at 0 m in the west
    assert [row["site_height_error_m"] for row in (far, near)] == pytest.approx([-1.0, 0.0], abs=0.06)


@pytest.mark.parametrize("seed", range(20))
def test_site_of_an_exact_map_is_the_farthest_from_hazards(seed: int) -> None:
    """The algorithm's selection, applied to the true safety of random ground with unseen positions."""
    truth, rng = make_truth(0), np.random.default_rng(seed)
    safe, covered = (rng.random((9, 9)) < probability for probability in (0.8, 0.9))
    truth = replace(truth, footprints=replace(truth.footprints, safe=safe), covered=covered)
    site = safe_site(np.where(truth.safe, Safety.SAFE, Safety.HAZARD).astype(np.uint8), np.array([8.0, 0.0]))
    assert site is not None
    assert truth.clearance_fraction(truth.positions[site]) == pytest.approx(1.0)


def compute_map_errors(change_map: Callable[[np.ndarray], np.ndarray]) -> dict[str, Scalar]:
    """Return the errors of a changed map of gently undulating ground with 40 rocks, 0.3 m high, on 8 % of it.

    `change_map` receives the exact elevations of cells of 0.25 m. The map has an additional tilt that does not count.
    """
    truth, flight, rng = make_truth(25), make_flight(), np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(-6.0, 6.0, 0.1), np.arange(-6.0, 6.0, 0.1))
    heights = 0.1 * x + 0.03 * np.sin(x) * np.cos(y)
    for rock in rng.uniform(-5.0, 5.0, (40, 2)):
        heights[np.hypot(x - rock[0], y - rock[1]) < 0.25] += 0.3
    truth = replace(truth, relief=Relief(heights, -6.0, -6.0, 0.1))
    start = flight.states[0].position_m
    cells = ElevationMap(np.zeros((40, 40)), np.array([-4.875, 4.875]) - start[:2], 0.25)
    rows, columns = np.indices((40, 40))
    local = cells.positions(np.stack([rows, columns], axis=-1).astype(np.float64))
    exact = truth.relief.average(start[:2] + local, 0.25) - start[2]
    plane = 0.1 * local[..., 0] - 0.05 * local[..., 1] + 3.0
    ground = make_ground(replace(cells, elevation_m=change_map(exact) + plane), np.zeros((40, 40), dtype=np.uint8))
    return map_errors(ground, flight, SampledMap.sample(ground, flight, truth, HdaOptions()), truth)


@pytest.mark.parametrize(("map_scale", "fraction"), [(0.0, 1.0), (1.0, 0.0), (0.5, 0.5)])
def test_relief_error_is_1_for_a_plane_and_0_for_an_exact_map(map_scale: float, fraction: float) -> None:
    row = compute_map_errors(lambda exact: map_scale * exact)
    assert row["relief_error_fraction"] == pytest.approx(fraction, abs=1e-9)


def add_gross_errors(exact: np.ndarray) -> np.ndarray:
    """Shift a fifth of the cells by 1 to 8 m, up or down."""
    rng = np.random.default_rng(1)
    shift = rng.uniform(1.0, 8.0, exact.shape) * rng.choice([-1.0, 1.0], exact.shape)
    return exact + np.where(rng.random(exact.shape) < 0.2, shift, 0.0)


def keep_corner(exact: np.ndarray) -> np.ndarray:
    """Return a map of 2 m x 2 m."""
    return np.where((np.indices(exact.shape) < 8).all(axis=0), exact, np.nan)


@pytest.mark.parametrize(
    "change_map",
    [lambda exact: median_filter(exact, 8), add_gross_errors, keep_corner],
    ids=["without-rocks", "gross-errors", "corner-only"],
)
def test_map_without_rocks_or_with_gross_errors_or_of_a_corner_misses_the_bound(
    change_map: Callable[[np.ndarray], np.ndarray],
) -> None:
    (bound,) = {entry.bound for entry in load_campaign("hda-map").definition.requirements}
    assert bound is not None
    assert float(compute_map_errors(change_map)["relief_error_fraction"]) > bound


def test_answer_without_a_map_has_no_relief_error() -> None:
    p = LandingScenarioParameters(site="heli-benign")
    row = map_row(p, SiteEstimate(SITE_REPORTED, SAFE_SITE), make_flight(), make_truth(25))
    assert list(row) == ["relief_error_fraction"]
    assert np.isnan(float(row["relief_error_fraction"]))


def test_matches_are_counted_by_outcome() -> None:
    statuses = np.repeat(np.array(list(MatchStatus), dtype=np.uint8), [50, 4, 3, 2])
    pixels = np.zeros((59, 2))
    matches = Matches(pixels, pixels, pixels, pixels, np.zeros(59), statuses, np.zeros((50, 3)))
    row = stage_row(HdaDetails((VIEW, VIEW), matches=matches))
    assert row == {
        "points": 50,
        "matched_fraction": 50 / 59,
        "matches_dissimilar": 4,
        "matches_out_of_bounds": 3,
        "matches_inconsistent": 2,
    }


def test_unknown_cells_of_a_map_are_counted() -> None:
    elevation_m = np.zeros((20, 30))
    elevation_m[:2] = np.nan
    elevation = ElevationMap(elevation_m, np.zeros(2), 0.1)
    safety = np.full((20, 30), Safety.SAFE, dtype=np.uint8)
    safety[:5], safety[-3:] = Safety.UNKNOWN, Safety.HAZARD
    row = stage_row(HdaDetails((VIEW, VIEW), ground=make_ground(elevation, safety)))
    assert row["empty_fraction"] == pytest.approx(2 / 20)
    assert row["unknown_fraction"] == pytest.approx(5 / 20)


@pytest.mark.parametrize("error_rows", [-0.8, 0.8])
def test_true_track_starts_at_the_middle_of_the_summed_rows(error_rows: float) -> None:
    """Both images are taken at one pose, so that true tracks have no displacement; an error of 0.8 rows is correct.

    The true ray is that of the third of four rows, 0.125 rows below the middle of their sum. The limit is 1 px.
    """
    p = LandingScenarioParameters.model_validate(
        {
            "terrain": {"samples": 512},
            "detector": {"preset": "xc-55", "rows_summed": 4},
            "image_poses": {"baseline_fraction": 0.0},
        }
    )
    case = RenderedFlight.simulate(p, Streams(1, "summed rows", 0))
    rows, columns = case.pair.counts[0].shape
    v, u = np.mgrid[20 : rows - 20 : 20, 20 : columns - 20 : 20].reshape(2, -1).astype(np.float64)
    first, second = np.column_stack([u, v]), np.column_stack([u, v + error_rows])
    tracks = Tracks(first, second, np.ones(u.size), np.ones(u.size, dtype=np.bool_))
    row = motion_row(HdaDetails((VIEW, VIEW), tracks=tracks), case.flight, case.pair)
    assert row["tracks_correct"] == row["features_in_view"] == u.size


@pytest.mark.parametrize("roll_deg", [0.0, 30.0])
def test_both_images_show_the_whole_edge_of_covered_footprints(roll_deg: float) -> None:
    """64 points on the edge of each footprint, on the relief; image borders are at -0.5 px and size - 0.5 px."""
    p = LandingScenarioParameters.model_validate(
        {"terrain": {"samples": 512}, "image_poses": {"heading_deg": 20.0, "roll_deg": roll_deg}}
    )
    case = RenderedFlight.simulate(p, Streams(1, "covered", 0))
    truth = case.truth
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    edge_m = 0.5 * truth.limits.diameter_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    positions = truth.positions[truth.covered][:, None] + edge_m
    points = np.concatenate([positions, truth.relief.average(positions, truth.relief.spacing_m)[..., None]], axis=-1)
    assert len(points) > 100
    for camera, state in zip(case.pair.cameras, case.flight.states, strict=True):
        pixels, _ = camera.transform(state.world_from_body).project(points.reshape(-1, 3))
        assert np.all((pixels >= -0.5) & (pixels <= np.array(camera.size) - 0.5))
