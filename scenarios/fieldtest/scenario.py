"""Field test scenario: simulate, measure, estimate and score one triple of images of a run.

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt16
from pydantic import BaseModel

from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios import condition_columns
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.base import TerrainScenario
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.fieldtest.imaging import FlownRun, RunKey, build_start_scene, run_ground, sun_at, take_image
from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.fieldtest.run import FieldRun, simulate_run
from marsyard.scenarios.fieldtest.timeline import triple_timeline
from marsyard.scenarios.fieldtest.triples import Category, Triple
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.scores import ScoredFlight
from marsyard.scenarios.velocity import VELOCITY, check_last_interval, consistency_row, velocity_products, velocity_row
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.sensor import Detector
from marsyard.sim.sensor.ranging import height_above_ground
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface, TerrainBank

#: Spacing of the grid on which cloud transmittance is evaluated, pixels.
CLOUD_GRID_PX = 32
#: Cache sizes of runs and scenes: large enough for all runs of the paper, because the cases alternate runs.
_CACHED_RUNS, _CACHED_SCENES = 16, 5


@dataclass(frozen=True)
class TripleCase:
    """A triple of a run, and the true states at its images."""

    run: FieldRun
    triple: Triple
    states: tuple[State, State, State]


class FieldTestScenario(TerrainScenario[FieldTestParameters]):
    """Triples of images from a helicopter flight, measured as in the paper, for a velocity estimator."""

    name = "fieldtest"
    parameters_type = FieldTestParameters
    task = VELOCITY
    max_cached_grounds = 3

    def __init__(self) -> None:
        super().__init__()
        self._simulate_run = lru_cache(maxsize=_CACHED_RUNS)(lambda key: simulate_run(key, self.load_ground))
        self._start_scene = lru_cache(maxsize=_CACHED_SCENES)(
            lambda key: build_start_scene(self._simulate_run(key).flown, run_ground(key, self.load_ground))
        )

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return the indices of the sites."""
        return tuple(range(len(self.check_parameters(parameters).site_names)))

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the site of the case's run. Raises ValueError if there is no such triple."""
        p = self.check_parameters(parameters)
        number, _ = _find_triple(p, case)
        return (p.site_names.index(p.runs[number].site),)

    def input_terrain(self, p: FieldTestParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """Return the terrain bank and index of a site's terrain."""
        return TerrainBank(p.terrain(p.site_names[shared_input]), p.bank_seed), 0

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Simulate one triple and score all algorithms."""
        p = self.check_parameters(parameters)
        number, index = _find_triple(p, streams.case)
        key = RunKey(p, number, streams.seed, streams.campaign)
        run, ground = self._simulate_run(key), run_ground(key, self.load_ground)
        triple = run.triples[index]
        times_s = run.truth.times_s[list(triple.image_indices)].tolist()
        first, second, third = map(run.flown.flight.state, times_s)
        case = TripleCase(run, triple, (first, second, third))
        detector = key.detector()
        noise, scene = streams.generator("detector noise"), self._start_scene(key)
        exposures = [take_image(run.flown, scene, ground, state, detector, noise) for state in case.states]
        images = [counts for counts, _ in exposures]
        ground_points = exposures[1][1].points_world(np.s_[::CLOUD_GRID_PX, ::CLOUD_GRID_PX])
        truth = truth_velocities(p, case)[1, :2]
        inertial = streams.generator("inertial velocity")
        measurements = measure(p, case, images, detector, key.calibrated_camera(), inertial)
        # cloud transmittance on the ground of the second image, at the time of each image, and its changes
        transmittances = cloud_transmittances(run.flown, ground_points, [state.time_s for state in case.states])
        changes = np.abs(np.diff(transmittances, axis=0))
        conditions = {
            **_conditions(p, case, measurements, ground.surface),
            **{f"cloud_transmittance_{n}": float(np.nanmean(field)) for n, field in enumerate(transmittances, start=1)},
            **{f"cloud_change_{pair}": float(np.nanmean(change)) for pair, change in enumerate(changes, start=1)},
            **condition_columns.image_columns(p.backend, condition_columns.hash_images(images)),
        }

        def evaluate(algorithm: str) -> AlgorithmRun[VelocityEstimate]:
            check = partial(check_last_interval, measurements=measurements)
            return run_on_measurements(partial(p.make, algorithm, streams.case), check, measurements)

        def score(algorithm: str, runs: Runs[VelocityEstimate]) -> Score:
            estimate = runs[algorithm].answer
            velocity = None if estimate is None else estimate.velocity_m_s
            row = {**velocity_row("velocity", velocity, truth), **consistency_row(estimate, truth)}
            scored = None
            if estimate is not None:
                truths: dict[str, Any] = {"true_velocity_m_s": truth, "states": case.states, "motion": run.flown.flight}
                scored = ScoredFlight(measurements=measurements, answer=estimate, **truths)
            timeline = partial(triple_timeline, run, ground, case.states, images, estimate)
            return Score(velocity is not None, row, velocity_products(images, estimate, truth), scored, timeline)

        return evaluate_case(p, conditions, evaluate, score)


def _find_triple(p: FieldTestParameters, case: int) -> tuple[int, int]:
    """Return the indices of a case's run and triple. Raises ValueError if the case does not exist."""
    total = sum(run.triples for run in p.runs)
    if case >= total:
        raise ValueError(f"case {case} does not exist: the runs define {total} triples; allowed: 0 to {total - 1}")
    return case_order(p)[case]


def case_order(p: FieldTestParameters) -> list[tuple[int, int]]:
    """Return the run and triple of each case.

    Triple k of the n triples of a category has the rank (k + 0.5) / n. Sorting by rank mixes all runs and categories in
    proportion, so that any number of first cases is representative.
    """
    ranks = []
    for number, run in enumerate(p.runs):
        start = 0
        for count in (run.short_time, run.same_direction, run.opposite_direction):
            ranks += [((index + 0.5) / count, number, start + index) for index in range(count)]
            start += count
    return [(number, index) for _, number, index in sorted(ranks)]


def truth_velocities(p: FieldTestParameters, case: TripleCase) -> Float64[np.ndarray, "2 3"]:
    """Compute the paper's truth velocities: GPS differences divided by the virtual interval, world axes (III.D.5).

    The images of a triple are not consecutive, so the time between them has no meaning for an inertial unit. The paper
    assigns a fixed virtual interval to each pair.
    """
    fixes = case.run.images.position_m[list(case.triple.image_indices)]
    return np.asarray(np.diff(fixes, axis=0) / p.triples.virtual_interval_s)


def measure(
    p: FieldTestParameters,
    case: TripleCase,
    images: Sequence[UInt16[np.ndarray, "rows columns"]],
    detector: Detector,
    camera: CameraModel,
    rng: np.random.Generator,
) -> DescentMeasurements:
    """Create an estimator's inputs: time tags at the virtual interval, and the calibrated camera (paper, III.D).

    The inertial velocities are the paper's truth velocities plus a constant horizontal error, drawn from `rng`: "biased
    IMU velocities" (III.D.3), because an inertial unit measures changes of velocity, but does not know the wind.
    Without the error the truth would be an input.
    """
    bias = np.append(p.triples.velocity_bias_m_s * rng.standard_normal(2), 0.0)
    tags = [number * p.triples.virtual_interval_s for number in range(len(images))]
    indices_and_tags = list(zip(case.triple.image_indices, tags, strict=True))
    altitudes = case.run.images.altitude_m
    return DescentMeasurements(
        images=tuple(
            DetectorImage(counts, tag, camera, detector.calibration) for counts, tag in zip(images, tags, strict=True)
        ),
        attitudes=tuple(AttitudeMeasurement(case.run.attitudes[index], tag) for index, tag in indices_and_tags),
        altitudes=tuple(AltitudeMeasurement(float(altitudes[index]), tag) for index, tag in indices_and_tags),
        interval_velocities_m_s=truth_velocities(p, case) + bias,
        sun_direction=case.run.flown.sun(case.states[1].time_s),
    )


def _conditions(
    p: FieldTestParameters, case: TripleCase, measurements: DescentMeasurements, surface: Surface
) -> dict[str, Scalar]:
    """Compute the columns of a case's conditions and measurement errors."""
    run, indices = case.run, list(case.triple.image_indices)
    true_altitudes = height_above_ground(surface, np.stack([state.position_m for state in case.states]))
    row: dict[str, Scalar] = {
        "run": run.flown.parameters.name,
        "category": str(case.triple.category),
        "one_direction": case.triple.category is not Category.OPPOSITE_DIRECTION,
        "clear_sky": run.flown.clouds is None,
        "intact_cable": run.flown.parameters.cable_bursts == 0.0,
        "noisy_cable": run.flown.parameters.cable_bursts > 0.0,
        "site": run.flown.parameters.site,
        "terrain": p.site_names.index(run.flown.parameters.site),
        "location_east_m": float(case.states[1].position_m[0]),
        "location_north_m": float(case.states[1].position_m[1]),
        **condition_columns.sun_columns(measurements.sun_direction),
        "horizontal_speed_m_s": float(np.hypot(*case.states[1].velocity_m_s[:2])),
    }
    errors = []
    samples = zip(case.states, measurements.attitudes, measurements.altitudes, true_altitudes, strict=True)
    for number, (state, attitude, altitude, true_altitude) in enumerate(samples, start=1):
        errors.append((attitude.world_from_body * state.attitude.inv()).as_rotvec())
        row[f"image_time_{number}_s"] = state.time_s
        row[f"pass_{number}"] = int(run.images.pass_number[indices[number - 1]])
        row[f"altitude_{number}_m"] = float(true_altitude)
        row[f"altitude_error_{number}_m"] = altitude.altitude_m - float(true_altitude)
        row[f"off_nadir_{number}_deg"] = condition_columns.off_nadir_deg(state)
        row[f"attitude_rate_{number}_deg_s"] = condition_columns.attitude_rate_deg_s(state)
        row[f"attitude_error_{number}_deg"] = float(np.degrees(np.linalg.norm(errors[-1])))
    for pair in (1, 2):
        row[f"attitude_change_{pair}_deg"] = float(np.degrees(np.linalg.norm(errors[pair] - errors[pair - 1])))
        row[f"interval_{pair}_s"] = abs(case.states[pair].time_s - case.states[pair - 1].time_s)
    row["off_nadir_max_deg"] = max(condition_columns.off_nadir_deg(state) for state in case.states)
    row["attitude_rate_max_deg_s"] = max(condition_columns.attitude_rate_deg_s(state) for state in case.states)
    return row


def cloud_transmittances(
    flown: FlownRun, ground_m: Float64[np.ndarray, "m n 3"], times_s: Sequence[float]
) -> Float64[np.ndarray, "times m n"]:
    """Compute the fraction of direct sunlight that clouds transmit to points on the ground."""
    if flown.clouds is None:
        return np.ones((len(times_s), *ground_m.shape[:2]))
    return np.stack([flown.clouds.transmittance(ground_m, sun_at(flown, time), time) for time in times_s])
