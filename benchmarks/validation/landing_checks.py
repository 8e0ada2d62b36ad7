"""Accuracy of the hazard detection on noise-free rendered image pairs: camera motion and elevation map."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.validation.records import Check, Measure
from marsyard.algorithms.hda import HdaEstimator, HdaOptions, TrackSeed
from marsyard.campaigns.definition.parameter_paths import replace_values
from marsyard.reports.validation_rows import Conditions
from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.error_sources import error_sources
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.images import take_images
from marsyard.scenarios.landing.map_score import map_row
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.score import motion_row
from marsyard.scenarios.landing.simulation import measure
from marsyard.scenarios.landing.world import LandingWorld
from marsyard.sim.sensor import DetectorParameters, LaserParameters, preset
from marsyard.sim.streams import Streams

#: Seed of the random streams of all image pairs.
SEED = 20050107
#: Number of terrains and seed of each site's terrain bank, as in the campaigns.
BANK = {"bank": 8, "bank_seed": 1}
SITES = ("heli-benign", "heli-hazardous")
#: Limits of rms errors: rotation; baseline divided by its length; elevation divided by the height.
ROTATION_LIMIT_DEG, BASELINE_LIMIT, ELEVATION_LIMIT = 0.05, 0.0075, 0.005
#: Both sets of options compute elevations at 160 x 120 points. The first tracks about 59 features, as in the landing
#: paper, the second about 200: over rocks the motion estimate needs more features, because an affine warp does not
#: model the parallax at the sides of rocks.
PAPER_FEATURES = HdaOptions(track_seed=TrackSeed.POSE, align=True, refine_planes=True, grid_px=4)
MANY_FEATURES = replace(PAPER_FEATURES, block_px=32)


def make_noise_free_detector(camera: str) -> DetectorParameters:
    """Return a camera's detector with 16 bits and a large full well, so that shot noise is below 1e-4 of the signal."""
    full_well_e = 1e9
    detector = preset(camera).detector
    return detector.model_copy(
        update={
            "full_well_e": full_well_e,
            "gain_e_dn": full_well_e / 2**16,
            "responsivity_e_s": detector.responsivity_e_s * full_well_e / detector.full_well_e,
            "bits": 16,
            "read_noise_e": 0.0,
            "dark_e_s": 0.0,
            "response_spread": 0.0,
            "calibration_error": 0.0,
        }
    )


def draw_exact_parameters(site: str, rng: np.random.Generator) -> LandingScenarioParameters:
    """Draw parameters of an image pair as in `hda-map`, with attitudes of a helicopter and without errors."""
    east, north = rng.uniform(0.0, 102.4, 2)
    roll, pitch, yaw = rng.normal(0.0, 2.0, 3)
    parameters = LandingScenarioParameters.model_validate(
        {
            "site": site,
            "terrain": {"samples": 2048},
            "location": {**BANK, "terrain": int(rng.integers(8)), "east_m": east, "north_m": north},
            "sun": {"azimuth_deg": rng.uniform(90.0, 270.0), "elevation_deg": rng.uniform(30.0, 65.0)},
            "detector": make_noise_free_detector("xc-55").model_dump(),
            "image_poses": {
                "height_m": rng.uniform(8.0, 15.0),
                "heading_deg": rng.uniform(0.0, 360.0),
                "tilt_deg": rng.uniform(0.0, 5.0),
                "tilt_towards_deg": rng.uniform(0.0, 360.0),
                "climb_fraction": rng.normal(0.0, 0.01),
                "roll_deg": roll,
                "pitch_deg": pitch,
                "yaw_deg": yaw,
            },
            "laser": LaserParameters(count_m=0.0).model_dump(),
        }
    ).model_dump()
    # also those sources of error that instruments may get later
    for source in error_sources("landing"):
        parameters = replace_values(parameters, source.exact_values(parameters))
    return LandingScenarioParameters.model_validate(parameters)


def simulate_errors(number: int) -> dict[str, dict[str, Scalar]]:
    """Simulate the errors of one image pair with both sets of options; the sites alternate."""
    streams = Streams(SEED, "landing checks", number)
    parameters = draw_exact_parameters(SITES[number % len(SITES)], streams.generator("pair"))
    world = LandingWorld.from_parameters(parameters)
    flight = LandingFlight.from_parameters(parameters, world.ground.surface, streams)
    pair = take_images(parameters, world, flight, camera_optics(parameters.optics), streams)
    measurements = measure(parameters, flight, pair, streams)
    truth = GroundTruth.from_images(world, flight, pair, parameters.lander.limits)
    rows: dict[str, dict[str, Scalar]] = {}
    for name, options in (("paper", PAPER_FEATURES), ("many features", MANY_FEATURES)):
        estimate = HdaEstimator(options).estimate(measurements)
        motion = motion_row(estimate.details, flight, pair)
        rows[name] = {
            "site": parameters.site,
            "range_m": pair.axis_range_m,
            **motion,
            **map_row(parameters, estimate, flight, truth),
        }
    return rows


def _rms(rows: Sequence[dict[str, Scalar]], read_value: Callable[[dict[str, Scalar]], float]) -> float:
    """Root mean square over all pairs; NaN, which exceeds every limit, if a pair has no map."""
    return float(np.sqrt(np.mean([read_value(row) ** 2 for row in rows])))


def check_accuracy(quick: bool) -> Iterator[Measure]:
    """Measure the errors of motion and elevation map, with many features and with as many as in the landing paper."""
    pairs = [simulate_errors(number) for number in range(6 if quick else 100)]
    for site in (*SITES, ""):
        rows = [pair["many features"] for pair in pairs if pair["many features"]["site"] == site or not site]
        population = f"{len(rows)} noise-free pairs" + (f" over {site}" if site else "")
        limits = (None, None, None) if site else (ROTATION_LIMIT_DEG, BASELINE_LIMIT, ELEVATION_LIMIT)
        tracks = float(np.median([float(row["tracks"]) for row in rows]))
        how = (
            f"{population}, height 8 to 15 m, baseline 0.2 of the height, {tracks:.0f} tracks, exact scale and vertical"
        )
        yield Measure("rotation error, rms", _rms(rows, _read_column("rotation_error_deg")), "deg", limits[0], how)
        baseline = _rms(rows, _read_column("baseline_error_fraction"))
        yield Measure("baseline error, direction and length, divided by its length, rms", baseline, "", limits[1], how)
        elevation = _rms(rows, lambda row: float(row.get("elevation_rms_m", np.nan)) / float(row["range_m"]))
        yield Measure("elevation error divided by the height, rms", elevation, "", limits[2], how)
    paper_rows = [pair["paper"] for pair in pairs]
    tracks = float(np.median([float(row["tracks"]) for row in paper_rows]))
    how = f"the same {len(paper_rows)} pairs"
    rotation = _rms(paper_rows, _read_column("rotation_error_deg"))
    claim = f"rotation error with the paper's features, {tracks:.0f} tracks, rms"
    yield Measure(claim, rotation, "deg", ROTATION_LIMIT_DEG, how)


def _read_column(name: str) -> Callable[[dict[str, Scalar]], float]:
    """Return a function that reads a column of a row."""
    return lambda row: float(row[name])


#: Dispersions of `draw_exact_parameters`.
_CONDITIONS = Conditions(
    "*",
    ("hda",),
    site=SITES,
    camera=("xc-55",),
    sun_elevation_deg=(30.0, 65.0),
    slope_deg=(2.0, 6.0),
    optical_depth=(0.35, 0.35),
    range_m=(8.0, 15.0),
)
CHECKS = (Check("landing", "Landing", check_accuracy, conditions=(_CONDITIONS,)),)
