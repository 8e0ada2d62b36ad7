"""Tests of external programs as algorithms: exchanged files, answers and program faults."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.answers import check_site, check_velocity
from marsyard.algorithms.exchange import (
    VELOCITY_REQUESTS,
    ExecutableAlgorithm,
    ExecutableLimits,
    ProgramDetails,
    parse_command,
    process,
    read_case,
    write_case,
)
from marsyard.algorithms.exchange.process import AwakeClock, RunningProgram
from marsyard.algorithms.exchange.serving import Command, acquire_server, end_idle_programs, release_server
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.algorithms.processes import processor_time_s
from marsyard.scenarios.conformance import inputs
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements, PoseMeasurement
from tests.algorithms.synthetic_descent import valid_velocity

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
TRUE_VELOCITY = inputs.DESCENT_VELOCITY_M_S[:2]


@pytest.fixture
def measurements() -> DescentMeasurements:
    return inputs.descent()


def write_program(folder: Path, body: str) -> str:
    """Write a Python program with these lines and return its command line specification."""
    path = folder / "program.py"
    path.write_text(f"import json, os, sys, time\n{body}\n")
    return f"{sys.executable} {path}"


def run_program(spec: str, measurements: DescentMeasurements, **limits: float) -> VelocityEstimate:
    """Estimate the velocity with a program; limits: those of `ExecutableLimits`."""
    command = parse_command(spec)
    assert command is not None
    program_limits = ExecutableLimits.model_validate({"time_s": 60.0, **limits})
    answer = ExecutableAlgorithm(command, program_limits, VELOCITY_REQUESTS).estimate(measurements)
    assert isinstance(answer, VelocityEstimate)
    return answer


@pytest.mark.parametrize("image_format", ["pgm", "png"])
def test_case_files_round_trip(measurements: DescentMeasurements, tmp_path: Path, image_format: str) -> None:
    write_case(tmp_path, measurements, image_format)  # type: ignore[arg-type]
    restored_case = read_case(tmp_path)
    assert isinstance(restored_case, DescentMeasurements)
    for image, copy in zip(measurements.images, restored_case.images, strict=True):
        np.testing.assert_array_equal(image.counts, copy.counts)
        np.testing.assert_array_equal(image.calibration.flat_field, copy.calibration.flat_field)
        assert dataclasses.replace(image.calibration, flat_field=np.zeros((1, 1))) == dataclasses.replace(
            copy.calibration, flat_field=np.zeros((1, 1))
        )
        for letter in "cahvor":
            np.testing.assert_array_equal(getattr(image.camera, letter), getattr(copy.camera, letter))
    np.testing.assert_array_equal(measurements.interval_velocities_m_s, restored_case.interval_velocities_m_s)
    np.testing.assert_array_equal(measurements.sun_direction, restored_case.sun_direction)
    assert measurements.altitudes == restored_case.altitudes
    for reference, actual in zip(measurements.attitudes, restored_case.attitudes, strict=True):
        # normalising the quaternion again changes the last digits
        assert (reference.world_from_body.inv() * actual.world_from_body).magnitude() < 1e-14
    # one flat field for three images of one camera
    cameras, images = [f"camera_{k}.cahvor" for k in (1, 2, 3)], [f"image_{k}.{image_format}" for k in (1, 2, 3)]
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [*cameras, "case.json", "flat_field_1.f64", *images]


def test_landing_without_range_round_trips(measurements: DescentMeasurements, tmp_path: Path) -> None:
    pose = RigidTransform.from_components([1.0, 2.0, 30.0], Rotation.from_rotvec([0.1, 0.2, 0.3]))
    landing = LandingMeasurements(
        images=(measurements.images[0], measurements.images[1]),
        poses=(PoseMeasurement(pose, 1.0), PoseMeasurement(pose, 2.0)),
        slant_range_m=float("nan"),
        up_body=np.array([0.0, 0.0, 1.0]),
        apriori_site_world=np.array([3.0, 4.0, 5.0]),
    )
    write_case(tmp_path, landing)
    restored_case = read_case(tmp_path)
    assert isinstance(restored_case, LandingMeasurements)
    assert np.isnan(restored_case.slant_range_m)
    np.testing.assert_allclose(restored_case.poses[1].world_from_body.as_matrix(), pose.as_matrix(), atol=1e-15)
    np.testing.assert_array_equal(restored_case.apriori_site_world, landing.apriori_site_world)


def test_case_files_contain_no_truth(measurements: DescentMeasurements, tmp_path: Path) -> None:
    write_case(tmp_path, measurements)
    # Each number in the files is a measurement, or an index or size; the true velocity is absent.
    case = json.loads((tmp_path / "case.json").read_text())
    numbers = np.array(list(_iterate_numbers(case)))
    measured = np.array(list(_iterate_numbers(_to_plain_values(measurements))))
    indices = {float(k) for k in range(max(512, *measurements.images[0].counts.shape) + 1)}
    assert set(numbers) <= set(measured) | indices
    assert not np.isclose(numbers[:, None], TRUE_VELOCITY, atol=1e-3).any()


def _to_plain_values(value: object) -> object:
    """Convert a measurement to lists and dictionaries, with rotations as quaternions."""
    if dataclasses.is_dataclass(value):
        return {field.name: _to_plain_values(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Rotation):
        return value.as_quat().tolist()
    if isinstance(value, np.ndarray):
        return value.ravel().tolist() if value.size < 100 else []
    return [_to_plain_values(item) for item in value] if isinstance(value, (tuple, list)) else value


def _iterate_numbers(value: object) -> Iterator[float]:
    """Yield all numbers of nested lists and dictionaries."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _iterate_numbers(item)
    elif isinstance(value, (int, float)):
        yield float(value)


def test_other_format_version_is_rejected(measurements: DescentMeasurements, tmp_path: Path) -> None:
    write_case(tmp_path, measurements)
    path = tmp_path / "case.json"
    path.write_text(path.read_text().replace('"exchange": 3', '"exchange": 2'))
    with pytest.raises(ValueError, match="version 2 is not supported; supported: 3"):
        read_case(tmp_path)


#: Python expression of a valid answer in JSON.
ANSWER = (
    'json.dumps({"exchange": 3, "outcome": "VALID", "velocity_m_s": [1.5, -2], "covariance_m2_s2": [[1, 0], [0, 4]]})'
)


def test_program_answer_and_stderr_are_stored(measurements: DescentMeasurements, tmp_path: Path) -> None:
    check_task = 'assert json.load(open(sys.argv[-1] + "/case.json"))["task"] == "velocity"'
    body = f'{check_task}\nprint("hm\\x07", file=sys.stderr)\nprint({ANSWER})'
    result = run_program(f"exec:{write_program(tmp_path, body)} --flag", measurements)
    assert result.outcome is VelocityOutcome.VALID
    np.testing.assert_array_equal(result.velocity_m_s, [1.5, -2.0])
    np.testing.assert_array_equal(result.covariance_m2_s2, [[1.0, 0.0], [0.0, 4.0]])
    assert isinstance(result.details, ProgramDetails)
    assert result.details.stderr == "hm�\n"


@pytest.mark.parametrize(
    ("body", "fault", "message"),
    [
        ("sys.exit(3)", Fault.CRASHED, "status 3"),
        ("os.abort()", Fault.CRASHED, "SIGABRT"),
        ("time.sleep(60)", Fault.TIMED_OUT, "no answer within 0.7 s"),
        ("while True: pass", Fault.TIMED_OUT, "no answer within 0.7 s"),
        ("import subprocess; subprocess.Popen(['sleep', '60'])", Fault.TIMED_OUT, "no answer within 0.7 s"),
        ("x = bytearray(400_000_000); time.sleep(60)", Fault.OUT_OF_MEMORY, "0.2 GB"),
        ("while True: print('more output')", Fault.TOO_MUCH_OUTPUT, "1 MB"),
        ("", Fault.BAD_ANSWER, "not one JSON object"),
        ("print('[1]')", Fault.BAD_ANSWER, "not one JSON object"),
        ("print('{}')", Fault.BAD_ANSWER, "exchange is None; allowed: 3"),
        (f"print({ANSWER}); print({ANSWER})", Fault.BAD_ANSWER, "not one JSON object"),
        (f"print({ANSWER}.replace('VALID', 'FINE'))", Fault.BAD_ANSWER, "outcome is 'FINE'; allowed: VALID, NO_TEMP"),
        (f"print({ANSWER}.replace('1.5', 'NaN'))", Fault.BAD_ANSWER, "velocity_m_s"),
        (f"print({ANSWER}.replace('1.5', '[1.5]'))", Fault.BAD_ANSWER, "velocity_m_s"),
        (f"print({ANSWER}.replace('4]', '-4]'))", Fault.BAD_ANSWER, "not positive definite"),
        (f"print({ANSWER}.replace('covariance', 'kovariance'))", Fault.BAD_ANSWER, "unknown key 'kovariance_m2_s2'"),
        (f"print({ANSWER}.replace('covariance_m2_s2', 'velocity_m_s'))", Fault.BAD_ANSWER, "it contains a key twice"),
        ('print(\'{"exchange": 3, "outcome": "VALID"}\')', Fault.BAD_ANSWER, "velocity_m_s is missing"),
    ],
)
def test_program_errors_are_reported_as_faults(
    measurements: DescentMeasurements, tmp_path: Path, body: str, fault: Fault, message: str
) -> None:
    # the program writes "!" to stderr before the error
    spec = f"exec:{write_program(tmp_path, 'print(chr(33), file=sys.stderr, flush=True)' + chr(10) + body)}"
    start_s = time.monotonic()
    limits = {"memory_gb": 0.2} if fault is Fault.OUT_OF_MEMORY else {}
    with pytest.raises(AlgorithmError, match=message) as error:
        run_program(spec, measurements, time_s=0.7 if fault is Fault.TIMED_OUT else 60.0, **limits)
    assert error.value.fault is fault
    assert error.value.stderr.startswith("!")
    assert time.monotonic() - start_s < 59.0  # the test does not wait for child processes


#: A persistent program that answers its first two cases with the number of the case as velocity, and then aborts.
SERVER = f"""
print(json.dumps({{"exchange": 3, "ready": True}}), flush=True)
for number, line in enumerate(sys.stdin):
    request = json.loads(line)
    assert json.load(open(request["case"] + "/case.json"))["exchange"] == 3
    if number == 2: os.abort()
    answer = json.loads({ANSWER}.replace("1.5", str(number)))
    print(json.dumps(answer | {{"id": request["id"]}}), flush=True)
"""


def test_persistent_program_restarts_after_a_crash(measurements: DescentMeasurements, tmp_path: Path) -> None:
    spec = f"serve:{write_program(tmp_path, SERVER)}"
    assert [valid_velocity(run_program(spec, measurements))[0] for _ in range(2)] == [0.0, 1.0]
    with pytest.raises(AlgorithmError, match="SIGABRT"):
        run_program(spec, measurements)
    assert valid_velocity(run_program(spec, measurements))[0] == 0.0
    end_idle_programs()


#: A program that answers each case twice: 0.05 s after the request, and again after the same time.
DOUBLE_ANSWERS = """
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
for number, line in enumerate(sys.stdin):
    request = json.loads(line)
    time.sleep(0.05)
    answer = {"exchange": 3, "id": request["id"], "outcome": "VALID", "velocity_m_s": [number, 0]}
    print(json.dumps(answer), flush=True)
    time.sleep(0.05)
    print(json.dumps(answer), flush=True)
"""


def test_late_second_answer_is_not_used_later(measurements: DescentMeasurements, tmp_path: Path) -> None:
    spec = f"serve:{write_program(tmp_path, DOUBLE_ANSWERS)}"
    run_program(spec, measurements)
    time.sleep(0.5)  # the second line is in the pipe
    with pytest.raises(AlgorithmError, match="before the request; expected one line") as error:
        run_program(spec, measurements)
    assert error.value.fault is Fault.BAD_ANSWER
    # a new process answers the next case
    assert valid_velocity(run_program(spec, measurements))[0] == 0.0
    end_idle_programs()


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        ('{"exchange": 2, "outcome": "NO_VALID_TRACK"}', "the answer's exchange is 2; allowed: 3"),
        ('{"exchange": 3, "outcome": "NO_VALID_TRACK"}', "the answer's id is None; allowed: 1"),
        ('{"exchange": 3, "id": true, "outcome": "NO_VALID_TRACK"}', "the answer's id is True; allowed: 1"),
        ('{"exchange": 3, "id": "1", "outcome": "NO_VALID_TRACK"}', "the answer's id is '1'; allowed: 1"),
    ],
)
def test_answer_needs_the_request_id(
    measurements: DescentMeasurements, tmp_path: Path, reply: str, message: str
) -> None:
    body = (
        f"""print('{{"exchange": 3, "ready": true}}', flush=True)\nsys.stdin.readline()\nprint('{reply}', flush=True)"""
    )
    with pytest.raises(AlgorithmError, match=message) as error:
        run_program(f"serve:{write_program(tmp_path, body)}", measurements)
    assert error.value.fault is Fault.BAD_ANSWER


@pytest.mark.parametrize("line", [{}, {"exchange": 2, "ready": True}])
def test_first_line_must_report_ready_and_the_version(
    measurements: DescentMeasurements, tmp_path: Path, line: dict[str, object]
) -> None:
    program = write_program(tmp_path, f"print(json.dumps({line}), flush=True); time.sleep(60)")
    with pytest.raises(AlgorithmError, match=r'its first line is .*; expected {"exchange": 3, "ready": true}') as error:
        run_program(f"serve:{program}", measurements)
    assert error.value.fault is Fault.BAD_ANSWER


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("exec:", "contains no program"),
        ("exec:./nothing --here", "does not exist or is not executable"),
        ("exec:nothing-of-this-name", "not on the PATH"),
        ("exec:'unclosed", "cannot be parsed"),
    ],
)
def test_missing_programs_are_reported(spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_command(spec)


def test_python_answers_are_validated() -> None:
    velocity = np.array([1.0, 2.0])
    valid = VelocityEstimate(VelocityOutcome.VALID, velocity)
    assert check_velocity(valid).velocity_m_s is not velocity
    for invalid in (
        None,
        dataclasses.replace(valid, velocity_m_s=None),
        VelocityEstimate(VelocityOutcome.IMU_MISMATCH, velocity),
        dataclasses.replace(valid, velocity_m_s=np.array([1.0, np.inf])),
        dataclasses.replace(valid, covariance_m2_s2=np.array([[1.0, 0.5], [0.4, 1.0]])),
    ):
        with pytest.raises(AlgorithmError) as error:
            check_velocity(invalid)
        assert error.value.fault is Fault.BAD_ANSWER
    with pytest.raises(AlgorithmError, match="NO_SAFE_SITE"):
        check_site(SiteEstimate(SiteOutcome.NO_SAFE_SITE, np.zeros(3)))
    apriori_m = np.array([3.0, 4.0, 0.2])
    rounded = SiteEstimate(SiteOutcome.NO_MOTION, apriori_m + 0.0005)
    assert check_site(rounded, apriori_m).outcome is SiteOutcome.NO_MOTION
    with pytest.raises(AlgorithmError, match=r"NO_MOTION, but site_world is 2 m from .*; allowed: the a-priori site"):
        check_site(SiteEstimate(SiteOutcome.NO_MOTION, apriori_m + np.array([0.0, 2.0, 0.0])), apriori_m)


def test_c_example_estimates_velocity(measurements: DescentMeasurements, tmp_path: Path) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc")
    assert compiler is not None, "the set-up script installs a C compiler"
    executable = tmp_path / "velocity_estimator"
    warnings = ("-Wall", "-Wextra", "-Werror", "-Wno-format-truncation")
    source = str(EXAMPLES / "velocity_estimator.c")
    subprocess.run([compiler, "-O2", "-std=c11", *warnings, "-o", str(executable), source, "-lm"], check=True)
    for spec in (f"exec:{executable}", f"serve:{executable} --serve"):
        result = run_program(spec, measurements)
        # Matches are whole pixels of 1.6 m (4 summed rows: 6.5 m) over 3.75 s. The median of 25 matches has a quarter
        # of the error of one match.
        assert np.hypot(*(result.velocity_m_s - TRUE_VELOCITY)) < 1.0
        assert isinstance(result.details, ProgramDetails)
        assert "templates found" in result.details.stderr
    end_idle_programs()
    images = tuple(dataclasses.replace(image, counts=np.full_like(image.counts, 4095)) for image in measurements.images)
    saturated = dataclasses.replace(measurements, images=images)
    assert run_program(f"exec:{executable}", saturated).outcome is VelocityOutcome.NO_VALID_TRACK


def test_python_example_estimates_velocity(measurements: DescentMeasurements, monkeypatch: pytest.MonkeyPatch) -> None:
    from marsyard.algorithms.dimes import DimesOptions
    from marsyard.scenarios.velocity import VELOCITY

    monkeypatch.chdir(EXAMPLES)
    estimator = VELOCITY.make("velocity_estimator:MedianShift", DimesOptions(), ExecutableLimits())
    result = check_velocity(estimator.estimate(measurements))
    assert np.hypot(*(result.velocity_m_s - TRUE_VELOCITY)) < 1.0


def test_long_request_that_is_not_read_and_time_of_a_case_are_limited() -> None:
    command = (sys.executable, "-c", "import time; time.sleep(60)")
    # longer than the buffer of a pipe, 64 kB on Linux
    with pytest.raises(AlgorithmError) as error:
        RunningProgram(command, ExecutableLimits(time_s=0.5)).read_line("x" * 1_000_000)
    assert error.value.fault is Fault.TIMED_OUT
    with pytest.raises(AlgorithmError, match=r"no answers to the case within 0\.3 s") as error:
        RunningProgram(command, ExecutableLimits(time_s=60.0, total_s=0.3)).read_all()
    assert error.value.fault is Fault.TIMED_OUT


#: A program that starts slowly, and answers its first and third request slowly.
SLOW_START = """
time.sleep(1.5)
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
for number in (1, 2, 3):
    input()
    time.sleep(0.0 if number == 2 else 1.5)
    print(json.dumps({"exchange": 3, "id": number}), flush=True)
"""


def test_start_up_is_not_part_of_the_time_for_a_case(tmp_path: Path) -> None:
    limits = ExecutableLimits(time_s=60.0, total_s=1.0)
    server = acquire_server(Command(tuple(write_program(tmp_path, SLOW_START).split()), True), limits)
    server.send_request({"do": "start"}, start_up_s=60.0)
    server.send_request({"do": "estimate"})
    with pytest.raises(AlgorithmError, match="no answers to the case within 1 s") as error:
        server.send_request({"do": "estimate"})
    assert error.value.fault is Fault.TIMED_OUT


def test_endless_standard_error_exceeds_the_output_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    program = RunningProgram((sys.executable, "-c", "print(1); input()"), ExecutableLimits())
    with monkeypatch.context() as patch:
        # a program that writes faster than its output is read
        patch.setattr(process, "_read_pending", lambda _: b"x" * 100_000)
        with pytest.raises(AlgorithmError, match="it wrote more than 1 MB") as error:
            program.read_line()
    assert error.value.fault is Fault.TOO_MUCH_OUTPUT
    assert not program.is_running()


#: A program that answers one request and ends.
ONE_ANSWER = """
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
request = json.loads(input())
print(json.dumps({"exchange": 3, "id": request["id"], "outcome": None}), flush=True)
"""


def test_folder_of_a_program_that_ended_while_idle_is_removed(tmp_path: Path) -> None:
    command, limits = Command(tuple(write_program(tmp_path, ONE_ANSWER).split()), True), ExecutableLimits()
    ended = acquire_server(command, limits)
    ended.send_request({"do": "start"})
    release_server(command, limits, ended)
    while ended.child.is_running():
        time.sleep(0.01)
    server = acquire_server(command, limits)
    assert server is not ended
    assert not ended.child.folder.exists()
    server.child.stop()


#: A program that ends with status 3 at the request `estimate`.
ENDING_PROGRAM = """
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
input()
sys.exit(3)
"""


def test_session_reports_that_its_program_has_ended(measurements: DescentMeasurements, tmp_path: Path) -> None:
    command = parse_command(f"serve:{write_program(tmp_path, ENDING_PROGRAM)}")
    assert command is not None
    estimator = ExecutableAlgorithm(command, ExecutableLimits(), VELOCITY_REQUESTS)
    for message in ("it ended with status 3", "its process ended after an earlier fault"):
        with pytest.raises(AlgorithmError, match=message) as error:
            estimator.estimate(measurements)
        assert error.value.fault is Fault.CRASHED


def test_suspension_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = iter([0.0, 0.5, 1.0, 3601.0, 3601.5])
    monkeypatch.setattr(time, "monotonic", lambda: next(readings))
    clock = AwakeClock()
    assert [clock.elapsed_s() for _ in range(4)] == [0.5, 1.0, 2.0, 2.5]


def test_processor_time_is_that_of_the_process() -> None:
    start_s, own_start_s = processor_time_s(os.getpid()), time.process_time()
    while time.process_time() < own_start_s + 0.05:
        pass
    assert processor_time_s(os.getpid()) - start_s == pytest.approx(time.process_time() - own_start_s, abs=0.02)
