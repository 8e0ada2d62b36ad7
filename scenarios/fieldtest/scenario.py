"""The field test as a scenario: case i is one triple of one run, its measurements, an estimator's answer, the score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, UInt16
from pydantic import BaseModel

from marsyard.algorithms.dimes import DimesOptions
from marsyard.scenarios.base import TerrainScenario, judged_attempt
from marsyard.scenarios.conditions import attitude_rate_deg_s, off_nadir_deg, sun_columns
from marsyard.scenarios.estimators import VELOCITY
from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.fieldtest.pictures import cloud_transmittances, first_light, ground_of, take_picture
from marsyard.scenarios.fieldtest.run import Run, RunKey, field_camera, work_out
from marsyard.scenarios.fieldtest.triples import Category, Triple
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.optics import camera_optics, draw_calibrated
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.parts.scores import ScoredFlight, scored
from marsyard.scenarios.provenance import rendered
from marsyard.scenarios.trial import Judged, attempted_with, case_result
from marsyard.scenarios.velocity import checked_last_interval, consistency_row, velocity_products, velocity_row
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement, DescentMeasurements, DetectorImage
from marsyard.sim.sensor import Detector
from marsyard.sim.sensor.ranging import height_above_ground
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface, TerrainBank

PICTURES = 3
#: Grounds, runs and their scenes that a process keeps: at least those of the paper, among which cases take turns.
KEPT_GROUNDS, KEPT_RUNS, KEPT_SCENES = 3, 16, 5


@dataclass(frozen=True)
class Case:
    """A triple of a run, with what is true of its pictures."""

    run: Run
    triple: Triple
    states: tuple[State, State, State]

    @classmethod
    def of(cls, run: Run, place: int) -> Case:
        """The triple at a place among a run's."""
        triple = run.triples[place]
        first, second, third = (run.flight.state(float(time)) for time in run.truth.times_s[list(triple.pictures)])
        return cls(run, triple, (first, second, third))


class FieldTestScenario(TerrainScenario[FieldTestParameters]):
    """Triples of pictures of a helicopter's flights, measured as the paper did and given to an estimator: DIMES."""

    name = "fieldtest"
    parameters_type = FieldTestParameters
    task = VELOCITY
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def __init__(self) -> None:
        super().__init__(KEPT_GROUNDS)
        self._run = lru_cache(maxsize=KEPT_RUNS)(work_out)
        self._first_light = lru_cache(maxsize=KEPT_SCENES)(
            lambda key: first_light(self._run(key), ground_of(key, self.load_ground))
        )

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the sites."""
        return tuple(range(len(self.checked(parameters).site_names)))

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The site of the case's run. Raises ValueError where the runs have no triple of this number."""
        p = self.checked(parameters)
        number, _ = _run_and_place(p, case)
        return (p.site_names.index(p.runs[number].site),)

    def input_terrain(self, p: FieldTestParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """The terrain of a site."""
        return TerrainBank(p.terrain(p.site_names[shared_input]), p.bank_seed), 0

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One triple."""
        p = self.checked(parameters)
        number, place = _run_and_place(p, streams.case)
        key = RunKey(p, number, streams.seed, streams.campaign)
        case, ground = Case.of(self._run(key), place), ground_of(key, self.load_ground)
        # one camera took all pictures
        response = Streams(streams.seed, streams.campaign, 0).generator("detector response")
        detector = Detector.drawn(camera_optics(field_camera()).fall_off, p.detector, response)
        noise, scene = streams.generator("detector noise"), self._first_light(key)
        taken = [take_picture(case.run, scene, ground, state, detector, noise) for state in case.states]
        pictures = [one.counts for one in taken]
        measurements = measure(p, case, pictures, detector, calibrated_camera(p, streams))
        known = {
            **_conditions(p, case, measurements, ground.surface),
            **_clouding(case, taken[1].ground_m),
            **rendered(p.backend, pictures),
        }

        def judge(algorithm: str) -> Judged:
            truth = truth_velocities(p, case)[1, :2]
            attempt = attempted_with(
                lambda given: VELOCITY.make(algorithm, DimesOptions(), p.executable, streams.case).estimate(given),
                lambda answer: checked_last_interval(answer, measurements),
                measurements,
            )
            estimate = attempt.answer
            velocity = None if estimate is None else estimate.velocity_m_s
            row = {**velocity_row("velocity", velocity, truth), **consistency_row(estimate, truth), **attempt.row}
            if estimate is not None:
                flown = ScoredFlight(
                    measurements=measurements,
                    answer=estimate,
                    true_velocity_m_s=truth,
                    states=case.states,
                    motion=case.run.flight,
                )
                row |= scored(p.scores, flown, {*row, *known})
            return judged_attempt(attempt, velocity is not None, row, velocity_products(pictures, estimate, truth))

        return case_result(p.algorithms, judge, known)


def calibrated_camera(p: FieldTestParameters, streams: Streams) -> CameraModel:
    """The camera of the delivered pictures as calibrated before the field test: the same in all cases."""
    rng = Streams(streams.seed, streams.campaign, 0).generator("camera calibration")
    return draw_calibrated(field_camera(), p.calibration, rng).binned(columns=1, rows=p.detector.rows_summed)


def _run_and_place(p: FieldTestParameters, case: int) -> tuple[int, int]:
    """The run of a case and its place among the run's triples. Raises ValueError where there is no such triple."""
    total = sum(run.triples for run in p.runs)
    if case >= total:
        raise ValueError(f"case {case} is asked for, but the runs state {total} triples; allowed: 0 to {total - 1}")
    return case_order(p)[case]


def case_order(p: FieldTestParameters) -> list[tuple[int, int]]:
    """Run and place in it of each case, spread evenly: the first cases already show every kind in proportion."""
    cells = []
    for number, run in enumerate(p.runs):
        start = 0
        for count in (run.short_time, run.same_direction, run.opposite_direction):
            cells += [((place + 0.5) / count, number, start + place) for place in range(count)]
            start += count
    return [(number, place) for _, number, place in sorted(cells)]


def truth_velocities(p: FieldTestParameters, case: Case) -> Float64[np.ndarray, "2 3"]:
    """The paper's truth velocities: differences of GPS positions over the virtual interval, world axes, m/s.

    The "biased IMU velocities" are made of the same differences (III.D.3 and III.D.5).
    """
    fixes = case.run.pictures.position_m[list(case.triple.pictures)]
    velocities: Float64[np.ndarray, "2 3"] = np.diff(fixes, axis=0) / p.triples.virtual_interval_s
    return velocities


def measure(
    p: FieldTestParameters,
    case: Case,
    pictures: Sequence[UInt16[np.ndarray, "rows columns"]],
    detector: Detector,
    camera: CameraModel,
) -> DescentMeasurements:
    """What DIMES is given of a triple (paper, III.D); pictures are tagged a virtual interval apart.

    `camera` is the calibrated one, of the delivered pictures.
    """
    tags = [number * p.triples.virtual_interval_s for number in range(PICTURES)]
    numbers = case.triple.pictures
    images = [DetectorImage(one, tag, camera, detector.calibration) for one, tag in zip(pictures, tags, strict=True)]
    attitudes = [AttitudeMeasurement(case.run.attitudes[k], tag) for k, tag in zip(numbers, tags, strict=True)]
    altitudes = [
        AltitudeMeasurement(float(case.run.pictures.altitude_m[k]), tag) for k, tag in zip(numbers, tags, strict=True)
    ]
    return DescentMeasurements(
        images=tuple(images),
        attitudes=tuple(attitudes),
        altitudes=tuple(altitudes),
        interval_velocities_m_s=truth_velocities(p, case),
        sun_direction=case.run.sun(case.states[1].time_s),
    )


def _conditions(
    p: FieldTestParameters, case: Case, measurements: DescentMeasurements, surface: Surface
) -> dict[str, Scalar]:
    """What the case was like, read from the simulated objects."""
    run, numbers = case.run, list(case.triple.pictures)
    true_altitudes = height_above_ground(surface, np.stack([state.position_m for state in case.states]))
    row: dict[str, Scalar] = {
        "run": run.parameters.name,
        "category": str(case.triple.category),
        "one_direction": case.triple.category is not Category.OPPOSITE_DIRECTION,
        "clear_sky": run.clouds is None,
        "site": run.parameters.site,
        "terrain": p.site_names.index(run.parameters.site),
        "place_east_m": float(case.states[1].position_m[0]),
        "place_north_m": float(case.states[1].position_m[1]),
        **sun_columns(measurements.sun_direction),
        "horizontal_speed_m_s": float(np.hypot(*case.states[1].velocity_m_s[:2])),
    }
    errors = []
    each = zip(case.states, measurements.altitudes, true_altitudes, strict=True)
    for number, (state, altitude, true) in enumerate(each, start=1):
        errors.append((measurements.attitudes[number - 1].world_from_body * state.attitude.inv()).as_rotvec())
        row[f"flown_{number}_s"] = state.time_s
        row[f"pass_{number}"] = int(run.pictures.flown[numbers[number - 1]])
        row[f"altitude_{number}_m"] = float(true)
        row[f"altitude_error_{number}_m"] = altitude.altitude_m - float(true)
        row[f"off_nadir_{number}_deg"] = off_nadir_deg(state)
        row[f"attitude_rate_{number}_deg_s"] = attitude_rate_deg_s(state)
        row[f"attitude_error_{number}_deg"] = float(np.degrees(np.linalg.norm(errors[-1])))
    for pair in (1, 2):
        row[f"attitude_change_{pair}_deg"] = float(np.degrees(np.linalg.norm(errors[pair] - errors[pair - 1])))
        row[f"apart_{pair}_s"] = abs(case.states[pair].time_s - case.states[pair - 1].time_s)
    row["off_nadir_max_deg"] = max(off_nadir_deg(state) for state in case.states)
    row["attitude_rate_max_deg_s"] = max(attitude_rate_deg_s(state) for state in case.states)
    return row


def _clouding(case: Case, ground_m: Float64[np.ndarray, "m n 3"]) -> dict[str, Scalar]:
    """How clouds lit the middle picture's ground at each picture, and how much that changed in each pair."""
    passed = cloud_transmittances(case.run, ground_m, [state.time_s for state in case.states])
    row: dict[str, Scalar] = {
        f"cloud_transmittance_{number}": float(np.nanmean(one)) for number, one in enumerate(passed, start=1)
    }
    for pair in (1, 2):
        row[f"cloud_change_{pair}"] = float(np.nanmean(np.abs(passed[pair] - passed[pair - 1])))
    return row
