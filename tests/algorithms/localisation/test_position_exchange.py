"""Tests of position answers: exchanged values, validation, external programs, separate processes, and faults."""

import gc
import io
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.exchange import ExecutableLimits, ProgramDetails
from marsyard.algorithms.exchange.serving import end_idle_programs, idle_processes
from marsyard.algorithms.exchange.values import decode, encode
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.localisation.baselines import InertialEstimator
from marsyard.algorithms.localisation.exchange import (
    POSITION_FORM,
    POSITION_STREAM,
    check_estimate,
    read_map,
    write_map,
)
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.scenarios.algorithm_run import run_algorithm
from marsyard.scenarios.input_copies import hash_inputs
from marsyard.scenarios.localisation.measurements import LocalisationMeasurements
from marsyard.scenarios.localisation.task import LOCALISATION
from marsyard.scenarios.streamed import StreamAnswers, StreamedEstimator
from marsyard.sim.camera import Cahv, Cahvore
from marsyard.sim.measurements import AltitudeMeasurement, DetectorCalibration, DetectorImage, ImuIncrements

RNG = np.random.default_rng(7)
#: Times of the inertial boundaries, 0.01 s apart; the image is at 0.5 s, and the altitude at 0.3 s.
TIMES_S = np.linspace(0.0, 1.0, 101)
RASTERS = RNG.random((2, 4, 6), dtype=np.float32)
MAP = MapProduct(RASTERS[0], RASTERS[1], np.array([-5.1, 0.3]), 6.0, 50.0, 6.0, 5.0)
INITIAL = InitialState(
    0.0, np.array([0.1, 0.2, 900.0]), np.array([3.0, 1.0, -50.0]), Rotation.from_rotvec([0.1, -0.2, 0.3]),
    np.diag(np.arange(1.0, 10.0)), 3.71,
)  # fmt: skip


def make_image() -> DetectorImage:
    pinhole = Cahv.from_axes((20.0, 20.0), (32, 24), axis=(0.0, 0.0, -1.0), right=(1.0, 0.0, 0.0))
    camera = Cahvore.from_cahv(pinhole, (0.0, 0.01, -0.005), (0.001, 0.0, 0.0), linearity=0.0)
    calibration = DetectorCalibration(RNG.uniform(0.8, 1.0, (24, 32)), 150e-6, 0.0, 0.0, 1, 2.0, 255)
    return DetectorImage(RNG.integers(0, 256, (24, 32), dtype=np.uint16), 0.5, camera, calibration)


IMAGE = make_image()
INCREMENTS = ImuIncrements(TIMES_S, 0.01, *RNG.normal(0.0, 1e-3, (2, 100, 3)))
DESCENT = LocalisationMeasurements(INITIAL, MAP, INCREMENTS, (AltitudeMeasurement(880.0, 0.3),), (IMAGE,))

#: A program that serves the inertial estimator, and writes the names of the calls and its process id.
SERVER = """
import os, sys
from marsyard.algorithms.localisation.baselines import InertialEstimator
from marsyard.algorithms.localisation.exchange import POSITION_STREAM
class Estimator(InertialEstimator):
    def start(self, initial, map_product):
        print("start", os.getpid())
        super().start(initial, map_product)
    def process_altitude(self, measurement):
        print("altitude", measurement.altitude_m, file=sys.stderr)
    def process_image(self, image):
        print("image", image.counts.sum())
        return super().process_image(image)
POSITION_STREAM.serve(Estimator())
"""


def write_program(folder: Path, text: str) -> str:
    """Write a Python program and return its command line specification."""
    path = folder / "estimator.py"
    path.write_text(text)
    return f"{sys.executable} {path}"


def run(spec: str, **limits: float) -> StreamAnswers[PositionEstimate]:
    """Run the algorithm of a specification on `DESCENT`; limits: those of `ExecutableLimits`."""
    estimator: Any = LOCALISATION.make(spec, LvsOptions(), ExecutableLimits.model_validate({"time_s": 60.0, **limits}))
    return DESCENT.check(estimator.estimate(DESCENT))


def test_exchanged_values_are_restored_exactly(tmp_path: Path) -> None:
    write_map(tmp_path, MAP)
    POSITION_STREAM.write_image(tmp_path, IMAGE)
    # JSON stores the shortest decimal text of a float64; quaternions are normalised again
    assert hash_inputs(read_map(tmp_path)) == hash_inputs(MAP)
    image = POSITION_STREAM.read_image(tmp_path)
    assert hash_inputs((image.counts, image.calibration, image.time_s)) == hash_inputs(
        (IMAGE.counts, IMAGE.calibration, IMAGE.time_s)
    )
    for letter in "cahvore":
        np.testing.assert_array_equal(getattr(image.camera, letter), getattr(IMAGE.camera, letter))
    increments = decode(ImuIncrements, json.loads(json.dumps(encode(INCREMENTS))))
    assert hash_inputs(increments) == hash_inputs(INCREMENTS)
    initial = decode(InitialState, json.loads(json.dumps(encode(INITIAL))))
    assert (initial.world_from_body.inv() * INITIAL.world_from_body).magnitude() < 1e-14
    same = replace(initial, world_from_body=INITIAL.world_from_body)
    assert hash_inputs(same) == hash_inputs(INITIAL)


def test_answers_are_restored_exactly() -> None:
    valid = PositionEstimate(
        PositionOutcome.VALID, 0.1, np.ones(3), np.zeros(3), Rotation.identity(), np.eye(9), details="not transmitted"
    )
    for estimate in (valid, PositionEstimate(PositionOutcome.UNCERTAIN, 0.7)):
        answer = {"exchange": 3, **json.loads(json.dumps(POSITION_FORM.encode(estimate)))}
        assert hash_inputs(POSITION_FORM.read(answer), ("details",)) == hash_inputs(estimate, ("details",))


def test_file_of_another_version_is_rejected(tmp_path: Path) -> None:
    write_map(tmp_path, MAP)
    path = tmp_path / "map.json"
    path.write_text(path.read_text().replace('"exchange": 3', '"exchange": 2'))
    with pytest.raises(ValueError, match="version 2 is not supported; supported: 3"):
        read_map(tmp_path)


def test_program_answers_like_its_python_class(tmp_path: Path) -> None:
    spec = f"serve:{write_program(tmp_path, SERVER)}"
    LOCALISATION.check(spec)
    answers = run(spec)
    expected = StreamedEstimator(InertialEstimator()).estimate(DESCENT)
    for answer, reference in zip(answers.estimates, expected.estimates, strict=True):
        assert (answer.outcome, answer.time_s) == (reference.outcome, reference.time_s)
        # the initial quaternion is normalised again: a rounding error of the attitude
        for name in ("position_m", "velocity_m_s", "covariance"):
            np.testing.assert_allclose(getattr(answer, name), getattr(reference, name), rtol=1e-9, atol=1e-12)
    image_details, details = (estimate.details for estimate in answers.estimates)
    assert isinstance(image_details, ProgramDetails)
    assert isinstance(details, ProgramDetails)
    assert image_details.stderr == f"image {IMAGE.counts.sum()}\n"
    assert details.stderr.splitlines()[1:] == ["altitude 880.0", f"image {IMAGE.counts.sum()}"]
    # times are those of the program's answers
    assert answers.image_times_s == (image_details.time_s,)
    assert details.time_s > image_details.time_s
    algorithm_run = run_algorithm(lambda: answers, lambda answer: answer)
    assert algorithm_run.row == {"estimation_time_s": details.time_s, "stderr": details.stderr}


#: A program in plain Python, as in any other language: `ANSWER` is its answer to an image and to finish.
PLAIN = """
import json, os, sys, time
ANSWER = {"outcome": "NO_COARSE_FIX", "time_s": 0.5}
COVARIANCE = [[float(row == column) for column in range(9)] for row in range(9)]
STATE = {"position_m": [1, 2, 3], "velocity_m_s": [0, 0, 0], "world_from_body_xyzw": [0, 0, 0, 1],
         "covariance": COVARIANCE}
actions = []
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
for line in sys.stdin:
    request = json.loads(line)
    if request["do"] == "start":
        actions.clear()
    actions.append(request["do"])
    answer = {"outcome": None}
    if request["do"] in ("process_image", "finish"):
        answer = {**ANSWER, "time_s": 0.5 if request["do"] == "process_image" else 1.0}
    # BODY
    print(json.dumps({"exchange": 3, "id": request["id"], **answer}), flush=True)
"""


#: Requests of `DESCENT` in their order.
CALLS = ["start", "process_increments", "process_altitude", "process_increments", "process_image"]
CALLS += ["process_increments", "finish"]


def test_process_answers_one_descent_or_many_in_order_of_messages(tmp_path: Path) -> None:
    body = "print(actions, os.getpid(), file=sys.stderr, flush=True) if request['do'] == 'finish' else None"
    program = write_program(tmp_path, PLAIN.replace("# BODY", body))
    outputs = [run(f"{prefix}:{program}").details for prefix in ("serve", "serve", "exec")]
    actions, process_ids = zip(*(item.stderr.rsplit(" ", 1) for item in outputs if item is not None), strict=True)
    assert set(actions) == {repr(CALLS)}
    serving, repeated, single = map(int, process_ids)
    assert serving == repeated != single
    gc.collect()
    assert serving in idle_processes()
    end_idle_programs()
    assert not any(Path(f"/proc/{number}").exists() for number in (serving, single))


#: A line for `PLAIN` that makes the answers to image and finish valid.
VALID = 'answer = {**answer, **STATE, "outcome": "VALID"} if "outcome" in answer and answer["outcome"] else answer'
IF_IMAGE = "if request['do'] == 'process_image': "


@pytest.mark.parametrize(
    ("body", "fault", "message"),
    [
        ("if request['do'] == 'start': sys.exit(3)", Fault.CRASHED, "status 3"),
        (f"{IF_IMAGE}sys.exit(0)", Fault.CRASHED, "its output ended without an answer"),
        (f"{IF_IMAGE}time.sleep(60)", Fault.TIMED_OUT, "no answer within 0.5 s"),
        (f"{IF_IMAGE}print('position unknown')", Fault.BAD_ANSWER, "one line|not one JSON object"),
        ("if request['do'] == 'start': answer = ANSWER", Fault.BAD_ANSWER, "unknown key 'time_s'"),
        ("if request['do'] == 'process_increments': answer = {}", Fault.BAD_ANSWER, "None; .* allowed: null"),
        (f"{IF_IMAGE}answer = {{'outcome': None}}", Fault.BAD_ANSWER, "is a NoneType; allowed: a Posi"),
        (f"{IF_IMAGE}answer = {{'outcome': 'UNCERTAIN'}}", Fault.BAD_ANSWER, "time_s is missing"),
        (
            f"{IF_IMAGE}answer = {{**ANSWER, 'time_s': -1.0}}",
            Fault.BAD_ANSWER,
            "answer to image 1 is -1.0 s; allowed: 0.5 s, its time tag",
        ),
        (f"{IF_IMAGE}answer = {{**ANSWER, 'time_s': float('nan')}}", Fault.BAD_ANSWER, "time_s is 'NaN'; allowed"),
        (f"{IF_IMAGE}answer = {{**ANSWER, 'position': 1}}", Fault.BAD_ANSWER, "unknown key 'position'"),
        (f"{IF_IMAGE}answer = {{**ANSWER, 'outcome': 'VALID'}}", Fault.BAD_ANSWER, "VALID, but position_m is missing"),
        (f"{VALID}; STATE['world_from_body_xyzw'] = [0] * 4", Fault.BAD_ANSWER, "allowed: a unit quaternion"),
        (f"{VALID}; STATE['velocity_m_s'] = [1, 2]", Fault.BAD_ANSWER, "velocity_m_s is '.1, 2.'; allowed: numbers"),
    ],
)
def test_failures_of_a_program_are_faults(tmp_path: Path, body: str, fault: Fault, message: str) -> None:
    spec = f"serve:{write_program(tmp_path, PLAIN.replace('# BODY', body))}"
    start_s = time.monotonic()
    limits = {"time_s": 0.5} if fault is Fault.TIMED_OUT else {}
    with pytest.raises(AlgorithmError, match=message) as error:
        run(spec, **limits)
    assert error.value.fault is fault
    assert time.monotonic() - start_s < 30.0  # far below the pauses of 60 s


def test_a_failure_in_a_case_is_recorded_as_an_outcome(tmp_path: Path) -> None:
    spec = "serve:" + write_program(tmp_path, PLAIN.replace("# BODY", "sys.exit(repr(actions))"))
    algorithm_run = run_algorithm(lambda: run(spec), lambda answer: answer)
    assert algorithm_run.failure.outcome == "CRASHED"
    assert algorithm_run.row["stderr"] == "['start']\n"


def test_serve_rejects_an_unknown_request() -> None:
    answers = io.StringIO()
    with pytest.raises(ValueError, match="unknown request 'image'; allowed: start, process_inc"):
        POSITION_STREAM.serve(InertialEstimator(), ['{"exchange": 3, "id": 1, "do": "image"}\n'], answers)
    assert json.loads(answers.getvalue()) == {"exchange": 3, "ready": True}


#: Fields of the state, which a valid answer contains and a refusal does not.
STATE_FIELDS = ("position_m", "velocity_m_s", "world_from_body", "covariance")


def _make_valid() -> PositionEstimate:
    position, velocity = np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, -90.0])
    return PositionEstimate(
        PositionOutcome.VALID, 12.5, position, velocity, Rotation.from_rotvec([0.1, 0.0, 0.2]), np.eye(9), details="d"
    )


class _Malformed(PositionEstimate):
    """A `PositionEstimate` whose fields are not checked at creation, as without the run-time checks of the tests."""

    def __init__(self, **changes: object) -> None:
        for name, value in {**vars(_make_valid()), **changes}.items():
            object.__setattr__(self, name, value)


def _expect_bad(answer: object, message: str) -> None:
    """Assert that the answer raises BAD_ANSWER with this message on one line."""
    with pytest.raises(AlgorithmError, match=message) as caught:
        check_estimate(answer)
    assert caught.value.fault is Fault.BAD_ANSWER
    assert "\n" not in str(caught.value)


def test_values_of_another_type_are_refused() -> None:
    for answer in (None, 3.0, SimpleNamespace(**vars(_make_valid())), PositionOutcome.VALID):
        _expect_bad(answer, rf"the answer is a {type(answer).__name__}; allowed: a PositionEstimate")
    for outcome in ("VALID", None, 1):
        _expect_bad(_Malformed(outcome=outcome), rf"outcome is a {type(outcome).__name__}; allowed: a PositionOutcome")
    for time_s in (np.nan, np.inf, None, "12.5", np.array(12.5)):
        _expect_bad(_Malformed(time_s=time_s), r"time_s is .*; allowed: a finite number")


@pytest.mark.parametrize("name", STATE_FIELDS)
def test_valid_answers_have_all_state_fields_and_refusals_none(name: str) -> None:
    _expect_bad(_Malformed(**{name: None}), rf"outcome is VALID, but {name} is missing; allowed: all parts")
    no_state: dict[str, Any] = dict.fromkeys(STATE_FIELDS)
    fields = {**no_state, name: getattr(_make_valid(), name)}
    for outcome in set(PositionOutcome) - {PositionOutcome.VALID}:
        _expect_bad(_Malformed(outcome=outcome, **fields), rf"outcome is {outcome.name}, but {name} is given; allowed")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("position_m", np.zeros(2), r"position_m has the shape \(2,\); allowed: \(3,\)"),
        ("position_m", np.zeros((3, 1)), r"position_m has the shape \(3, 1\); allowed: \(3,\)"),
        ("position_m", [1.0, 2.0, 3.0], r"position_m is a list; allowed: a NumPy array of floats"),
        ("position_m", np.arange(3), r"position_m is an array of int64; allowed: a NumPy array of floats"),
        ("position_m", np.array([1.0, np.nan, 0.0]), r"position_m is not finite: \[1.0, nan, 0.0\]"),
        ("velocity_m_s", np.zeros(4), r"velocity_m_s has the shape \(4,\); allowed: \(3,\)"),
        ("velocity_m_s", np.array([np.inf, 0.0, 0.0]), r"velocity_m_s is not finite"),
        ("world_from_body", np.eye(3), r"world_from_body is a ndarray; allowed: a Rotation"),
        ("world_from_body", Rotation.from_rotvec(np.zeros((2, 3))), r"world_from_body contains 2 rotations; allowed"),
        ("covariance", np.eye(3), r"covariance has the shape \(3, 3\); allowed: \(9, 9\)"),
        ("covariance", np.full((9, 9), np.nan), r"covariance is not finite"),
        ("covariance", np.eye(9) + np.eye(9, k=1), r"covariance is not symmetric"),
        ("covariance", np.zeros((9, 9)), r"covariance is not positive definite"),
        ("covariance", np.diag([1.0] * 8 + [-1.0]), r"covariance is not positive definite"),
    ],
)
def test_malformed_state_is_refused(name: str, value: object, message: str) -> None:
    _expect_bad(_Malformed(**{name: value}), message)


def test_valid_answer_is_copied() -> None:
    """A later change of the algorithm's arrays does not change the copy."""
    answer = replace(_make_valid(), time_s=-0.2)
    checked = check_estimate(answer)
    assert checked.outcome is PositionOutcome.VALID
    assert (checked.details, checked.time_s) == ("d", -0.2)
    for name in ("position_m", "velocity_m_s", "covariance"):
        original = getattr(answer, name)
        expected = original.copy()
        original += 100.0
        np.testing.assert_array_equal(getattr(checked, name), expected)
        assert getattr(checked, name).dtype == np.float64
    assert checked.world_from_body.approx_equal(Rotation.from_rotvec([0.1, 0.0, 0.2]), atol=1e-12)
    # other types of numbers are converted
    single = np.array([1.0, 2.0, 3.0], dtype=np.float32)
    converted = check_estimate(_Malformed(position_m=single, time_s=3))
    assert (converted.position_m.dtype, type(converted.time_s)) == (np.float64, float)


def test_refusal_without_a_state_is_valid() -> None:
    for outcome in set(PositionOutcome) - {PositionOutcome.VALID}:
        answer = PositionEstimate(outcome, 2.0, details=("diagnosis",))
        checked = check_estimate(answer)
        assert checked == answer
        assert checked is not answer
