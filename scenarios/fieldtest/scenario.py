"""The field test as a scenario: case i is one triple of one run, its measurements, an estimator's answer, the score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64, UInt16
from pydantic import BaseModel

from marsyard.algorithms.dimes import DimesOptions
from marsyard.scenarios.estimators import VELOCITY
from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.fieldtest.pictures import cloud_transmittances, field_optics, take_picture
from marsyard.scenarios.fieldtest.run import Run, RunKey, field_camera, worked_out
from marsyard.scenarios.fieldtest.triples import Category, Triple
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.optics import draw_calibrated
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
from marsyard.sim.terrain import TerrainBank

PICTURES = 3


@dataclass(frozen=True)
class Case:
    """A triple of a run, with what is true of its pictures."""

    run: Run
    triple: Triple
    states: tuple[State, State, State]


class FieldTestScenario:
    """Triples of pictures of a helicopter's flights, measured as the paper did and given to an estimator: DIMES."""

    name = "fieldtest"
    parameters_type = FieldTestParameters
    task = VELOCITY
    algorithm_table = ()
    part_keys: Mapping[str, Kind] = {"scores": SCORE}

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the sites."""
        return tuple(range(len(_checked(parameters).site_names)))

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds the terrain of one site."""
        _bank(parameters, shared_input).terrain(0)

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The site of the case's run. Raises ValueError where the runs have no triple of this number."""
        p = _checked(parameters)
        number, _ = case_order(p)[_place(p, case)]
        return (p.site_names.index(p.runs[number].site),)

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Bytes of a site's terrain that is not on disk."""
        return _bank(parameters, shared_input).missing_bytes(0)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One triple."""
        p = _checked(parameters)
        case = chosen_case(p, streams)
        # one camera took all pictures
        response = Streams(streams.seed, streams.campaign, 0).generator("detector response")
        detector = Detector.drawn(field_optics().fall_off, p.detector, response)
        noise = streams.generator("detector noise")
        taken = [take_picture(case.run, state, detector, noise) for state in case.states]
        pictures = [one.counts for one in taken]
        measurements = measure(p, case, pictures, detector, calibrated_camera(p, streams))
        truth = truth_velocities(p, case)[1, :2]
        known = {
            **_conditions(p, case, measurements),
            **_clouding(case, taken[1].ground_m),
            **rendered(p.backend, pictures),
        }

        def judge(algorithm: str) -> Judged:
            estimator = partial(VELOCITY.make, algorithm, DimesOptions(), p.executable, streams.case)
            attempt = attempted_with(
                lambda given: estimator().estimate(given),
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
            return Judged(
                outcome=attempt.outcome(lambda answer: answer.outcome.name),
                answered=velocity is not None,
                row=row,
                products=velocity_products(pictures, estimate, truth),
                failure=attempt.failure,
            )

        return case_result(p.algorithms, judge, known)


def _bank(parameters: BaseModel, site_number: int) -> TerrainBank:
    p = _checked(parameters)
    return TerrainBank(p.terrain(p.site_names[site_number]), p.bank_seed)


def calibrated_camera(p: FieldTestParameters, streams: Streams) -> CameraModel:
    """The camera of the delivered pictures as calibrated before the field test: the same in all cases."""
    rng = Streams(streams.seed, streams.campaign, 0).generator("camera calibration")
    return draw_calibrated(field_camera(), p.calibration, rng).binned(columns=1, rows=p.detector.rows_summed)


def _checked(parameters: BaseModel) -> FieldTestParameters:
    if not isinstance(parameters, FieldTestParameters):
        raise TypeError(f"the field test takes FieldTestParameters, not {type(parameters).__name__}")
    return parameters


def chosen_case(p: FieldTestParameters, streams: Streams) -> Case:
    """The triple of a case.

    Raises
    ------
    ValueError
        If the runs have no triple of this number.
    """
    number, place = case_order(p)[_place(p, streams.case)]
    run = worked_out(RunKey(p, number, streams.seed, streams.campaign))
    triple = run.triples[place]
    times = run.truth.times_s[list(triple.pictures)]
    first, second, third = (run.flight.state(float(time)) for time in times)
    return Case(run, triple, (first, second, third))


def _place(p: FieldTestParameters, case: int) -> int:
    total = sum(run.triples for run in p.runs)
    if case >= total:
        raise ValueError(f"case {case} is asked for, but the runs state {total} triples; allowed: 0 to {total - 1}")
    return case


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


def _conditions(p: FieldTestParameters, case: Case, measurements: DescentMeasurements) -> dict[str, Scalar]:
    """What the case was like, read from the simulated objects."""
    run, numbers = case.run, list(case.triple.pictures)
    sun = measurements.sun_direction
    surface = TerrainBank(p.terrain(run.parameters.site), p.bank_seed).terrain(0)
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
        "sun_azimuth_deg": float(np.degrees(np.arctan2(sun[0], sun[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(sun[2]))),
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
        row[f"off_nadir_{number}_deg"] = _off_nadir_deg(state)
        row[f"attitude_rate_{number}_deg_s"] = float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))
        row[f"attitude_error_{number}_deg"] = float(np.degrees(np.linalg.norm(errors[-1])))
    for pair in (1, 2):
        row[f"attitude_change_{pair}_deg"] = float(np.degrees(np.linalg.norm(errors[pair] - errors[pair - 1])))
        row[f"apart_{pair}_s"] = abs(case.states[pair].time_s - case.states[pair - 1].time_s)
    row["off_nadir_max_deg"] = max(_off_nadir_deg(state) for state in case.states)
    row["attitude_rate_max_deg_s"] = max(float(row[f"attitude_rate_{k}_deg_s"]) for k in range(1, PICTURES + 1))
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


def _off_nadir_deg(state: State) -> float:
    """Angle between the camera's axis and nadir."""
    return float(np.degrees(np.arccos(np.clip(state.attitude.as_matrix()[2, 2], -1.0, 1.0))))
