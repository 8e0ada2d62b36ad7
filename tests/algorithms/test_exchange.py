"""Programs as algorithms: files that come back as they were, answers, and everything that a program can do wrong."""

import dataclasses
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.answers import AlgorithmError, Fault, check_site, check_velocity
from marsyard.algorithms.exchange import (
    ExecutableLimits,
    ExecutableVelocityEstimator,
    ProgramDetails,
    parse_command,
    read_case,
    write_case,
)
from marsyard.algorithms.exchange.serving import end_persistent
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements, PoseMeasurement
from tests.algorithms.synthetic_descent import Flight, render, tilted

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
TRUE = np.array([12.0, -7.0])


@pytest.fixture(scope="module")
def measured() -> DescentMeasurements:
    """Pictures of a nearly level descent with noise; the inertial velocity is off by (3, -2) m/s."""
    attitudes = (tilted(3.0, 20.0, 40.0), tilted(4.0, 60.0, 40.0), tilted(5.0, 90.0, 40.0))
    steps = np.outer([0.0, 3.75, 7.5], [*TRUE, -75.0])
    flown = Flight(np.array([1000.0, 1000.0, 2000.0]) + steps, attitudes)
    exact = render(flown, noise=np.random.default_rng(1))
    return dataclasses.replace(exact, interval_velocities_m_s=flown.velocities + np.array([3.0, -2.0, 0.0]))


def program(folder: Path, body: str) -> str:
    """A Python program of these lines, as it is named on the command line."""
    path = folder / "program.py"
    path.write_text(f"import json, os, sys, time\n{body}\n")
    return f"{sys.executable} {path}"


def ask(spec: str, measured: DescentMeasurements, **limits: float) -> VelocityEstimate:
    command = parse_command(spec)
    assert command is not None
    return ExecutableVelocityEstimator(command, ExecutableLimits(**{"time_s": 60.0, **limits})).estimate(measured)


@pytest.mark.parametrize("pictures", ["pgm", "png"])
def test_a_case_comes_back_as_it_was(measured: DescentMeasurements, tmp_path: Path, pictures: str) -> None:
    write_case(tmp_path, measured, pictures)  # type: ignore[arg-type]
    back = read_case(tmp_path)
    assert isinstance(back, DescentMeasurements)
    for one, other in zip(measured.images, back.images, strict=True):
        np.testing.assert_array_equal(one.counts, other.counts)
        np.testing.assert_array_equal(one.calibration.flat_field, other.calibration.flat_field)
        assert dataclasses.replace(one.calibration, flat_field=np.zeros((1, 1))) == dataclasses.replace(
            other.calibration, flat_field=np.zeros((1, 1))
        )
        for letter in "cahvor":
            np.testing.assert_array_equal(getattr(one.camera, letter), getattr(other.camera, letter))
    np.testing.assert_array_equal(measured.interval_velocities_m_s, back.interval_velocities_m_s)
    np.testing.assert_array_equal(measured.sun_direction, back.sun_direction)
    assert measured.altitudes == back.altitudes
    for mine, its in zip(measured.attitudes, back.attitudes, strict=True):
        # a quaternion that is normalised again: some units in the last place
        assert (mine.world_from_body.inv() * its.world_from_body).magnitude() < 1e-14
    assert len(list(tmp_path.glob("*.f64"))) == 1  # one flat field for three pictures of one camera


def test_a_landing_comes_back_without_its_range(measured: DescentMeasurements, tmp_path: Path) -> None:
    pose = RigidTransform.from_components([1.0, 2.0, 30.0], Rotation.from_rotvec([0.1, 0.2, 0.3]))
    landing = LandingMeasurements(
        images=(measured.images[0], measured.images[1]),
        poses=(PoseMeasurement(pose, 1.0), PoseMeasurement(pose, 2.0)),
        slant_range_m=float("nan"),
        up_body=np.array([0.0, 0.0, 1.0]),
        apriori_site_world=np.array([3.0, 4.0, 5.0]),
    )
    write_case(tmp_path, landing)
    back = read_case(tmp_path)
    assert isinstance(back, LandingMeasurements)
    assert np.isnan(back.slant_range_m)
    np.testing.assert_allclose(back.poses[1].world_from_body.as_matrix(), pose.as_matrix(), atol=1e-15)
    np.testing.assert_array_equal(back.apriori_site_world, landing.apriori_site_world)


def test_the_files_hold_no_truth(measured: DescentMeasurements, tmp_path: Path) -> None:
    write_case(tmp_path, measured)
    names = sorted(path.name for path in tmp_path.iterdir())
    cameras, images = [f"camera_{k}.cahvor" for k in (1, 2, 3)], [f"image_{k}.pgm" for k in (1, 2, 3)]
    assert names == [*cameras, "case.json", "flat_field_1.f64", *images]
    # every number in the files is one of the measurement, and the true velocity is none of these
    written = json.loads((tmp_path / "case.json").read_text())
    numbers = np.array(list(_check_numbers(written)))
    given = np.array(list(_check_numbers(_plain(measured))))
    counted = {float(k) for k in range(max(512, *measured.images[0].counts.shape) + 1)}
    assert set(numbers) <= set(given) | counted
    assert not np.isclose(numbers[:, None], TRUE, atol=1e-3).any()


def _plain(value: object) -> object:
    """A measurement as lists and dictionaries; rotations as their quaternions."""
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Rotation):
        return value.as_quat().tolist()
    if isinstance(value, np.ndarray):
        return value.ravel().tolist() if value.size < 100 else []
    return [_plain(one) for one in value] if isinstance(value, (tuple, list)) else value


def _check_numbers(value: object) -> Iterator[float]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for one in value:
            yield from _check_numbers(one)
    elif isinstance(value, (int, float)):
        yield float(value)


def test_a_case_of_another_version_is_refused(measured: DescentMeasurements, tmp_path: Path) -> None:
    write_case(tmp_path, measured)
    path = tmp_path / "case.json"
    path.write_text(path.read_text().replace('"exchange": 1', '"exchange": 2'))
    with pytest.raises(ValueError, match="version 2 of the exchange; this program reads 1"):
        read_case(tmp_path)


ANSWER = (
    'json.dumps({"exchange": 1, "outcome": "VALID", "velocity_m_s": [1.5, -2], "covariance_m2_s2": [[1, 0], [0, 4]]})'
)


def test_a_program_answers_and_its_words_are_kept(measured: DescentMeasurements, tmp_path: Path) -> None:
    reads = 'assert json.load(open(sys.argv[-1] + "/case.json"))["task"] == "velocity"'
    body = f'{reads}\nprint("hm\\x07", file=sys.stderr)\nprint({ANSWER})'
    found = ask(f"exec:{program(tmp_path, body)} --flag", measured)
    assert found.outcome is VelocityOutcome.VALID
    np.testing.assert_array_equal(found.velocity_m_s, [1.5, -2.0])
    np.testing.assert_array_equal(found.covariance_m2_s2, [[1.0, 0.0], [0.0, 4.0]])
    assert isinstance(found.details, ProgramDetails)
    assert found.details.stderr == "hm�\n"


@pytest.mark.parametrize(
    ("body", "fault", "message"),
    [
        ("sys.exit(3)", Fault.CRASHED, "status 3"),
        ("os.abort()", Fault.CRASHED, "SIGABRT"),
        ("time.sleep(60)", Fault.TIMED_OUT, "no answer within 2 s"),
        ("while True: pass", Fault.TIMED_OUT, "no answer within 2 s"),
        ("import subprocess; subprocess.Popen(['sleep', '60'])", Fault.TIMED_OUT, "no answer within 2 s"),
        ("x = bytearray(400_000_000); time.sleep(60)", Fault.OUT_OF_MEMORY, "0.2 GB"),
        ("while True: print('and another thing')", Fault.TOO_MUCH_OUTPUT, "1 MB"),
        ("", Fault.BAD_ANSWER, "not one JSON object"),
        ("print('[1]')", Fault.BAD_ANSWER, "not one JSON object"),
        ("print('{}')", Fault.BAD_ANSWER, "exchange is None; allowed: 1"),
        (f"print({ANSWER}); print({ANSWER})", Fault.BAD_ANSWER, "not one JSON object"),
        (f"print({ANSWER}.replace('VALID', 'FINE'))", Fault.BAD_ANSWER, "outcome is 'FINE'; allowed: VALID, NO_TEMP"),
        (f"print({ANSWER}.replace('1.5', 'NaN'))", Fault.BAD_ANSWER, "velocity_m_s"),
        (f"print({ANSWER}.replace('1.5', '[1.5]'))", Fault.BAD_ANSWER, "velocity_m_s"),
        (f"print({ANSWER}.replace('4]', '-4]'))", Fault.BAD_ANSWER, "not positive definite"),
        (f"print({ANSWER}.replace('covariance', 'kovariance'))", Fault.BAD_ANSWER, "unknown key 'kovariance_m2_s2'"),
        ('print(\'{"exchange": 1, "outcome": "VALID"}\')', Fault.BAD_ANSWER, "of velocity_m_s none is given"),
    ],
)
def test_whatever_a_program_does_wrong_is_a_fault(
    measured: DescentMeasurements, tmp_path: Path, body: str, fault: Fault, message: str
) -> None:
    spec = f"exec:{program(tmp_path, 'print(chr(33), file=sys.stderr, flush=True)' + chr(10) + body)}"
    started = time.monotonic()
    patient = fault in (Fault.TIMED_OUT,)
    with pytest.raises(AlgorithmError, match=message.replace("[", r"\[")) as caught:
        ask(spec, measured, time_s=2.0 if patient else 60.0, memory_gb=0.2 if fault is Fault.OUT_OF_MEMORY else 2.0)
    assert caught.value.fault is fault
    assert caught.value.stderr.startswith("!")
    assert time.monotonic() - started < 59.0  # what it started is not waited for


SERVER = f"""
print(json.dumps({{"exchange": 1, "ready": True}}), flush=True)
for number, line in enumerate(sys.stdin):
    assert json.load(open(json.loads(line)["case"] + "/case.json"))["exchange"] == 1
    if number == 2: os.abort()
    print({ANSWER}.replace("1.5", str(number)), flush=True)
"""


def test_a_persistent_program_answers_many_cases_and_is_started_again(
    measured: DescentMeasurements, tmp_path: Path
) -> None:
    spec = f"serve:{program(tmp_path, SERVER)}"
    answers = [ask(spec, measured).velocity_m_s for _ in range(2)]
    assert [float(one[0]) for one in answers if one is not None] == [0.0, 1.0]
    with pytest.raises(AlgorithmError, match="SIGABRT"):
        ask(spec, measured)
    again = ask(spec, measured).velocity_m_s
    assert again is not None
    assert again[0] == 0.0
    end_persistent()


#: Answers each case with its number, `{pause_s}` after it was asked, and as long after that once more.
TWICE = """
print(json.dumps({"exchange": {version}, "ready": True}), flush=True)
for number, line in enumerate(sys.stdin):
    asked = json.loads(line)
    time.sleep({pause_s})
    answer = {"exchange": {version}, {identity}"outcome": "VALID", "velocity_m_s": [number, 0]}
    print(json.dumps(answer), flush=True)
    time.sleep({pause_s})
    print(json.dumps(answer), flush=True)
"""


def twice(version: int, pause_s: float = 0.05) -> str:
    identity = '"id": asked["id"], ' if version > 1 else ""
    text = TWICE.replace("{version}", str(version)).replace("{identity}", identity)
    return text.replace("{pause_s}", str(pause_s))


@pytest.mark.parametrize("version", [1, 2])
def test_a_late_second_line_is_not_the_answer_to_the_next_case(
    measured: DescentMeasurements, tmp_path: Path, version: int
) -> None:
    spec = f"serve:{program(tmp_path, twice(version))}"
    first = ask(spec, measured).velocity_m_s
    assert first is not None
    time.sleep(0.5)  # the second line stands in the pipe
    with pytest.raises(AlgorithmError, match="before it was asked it wrote") as caught:
        ask(spec, measured)
    assert caught.value.fault is Fault.BAD_ANSWER
    # the next case is answered by a new process, of which it is the first one
    again = ask(spec, measured).velocity_m_s
    assert again is not None
    assert again[0] == 0.0
    end_persistent()


def test_an_answer_to_another_request_is_refused(measured: DescentMeasurements, tmp_path: Path) -> None:
    # the second line comes after the next request was written: only its id shows that it answers the one before
    spec = f"serve:{program(tmp_path, twice(2, pause_s=1.0))}"
    ask(spec, measured)
    with pytest.raises(AlgorithmError, match="the answer's id is 1; allowed: 2") as caught:
        ask(spec, measured)
    assert caught.value.fault is Fault.BAD_ANSWER
    end_persistent()


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        ('{"exchange": 1, "outcome": "NO_VALID_TRACK"}', "the answer's exchange is 1; allowed: 2"),
        ('{"exchange": 2, "outcome": "NO_VALID_TRACK"}', "the answer's id is None; allowed: 1"),
        ('{"exchange": 2, "id": true, "outcome": "NO_VALID_TRACK"}', "the answer's id is True; allowed: 1"),
        ('{"exchange": 2, "id": "1", "outcome": "NO_VALID_TRACK"}', "the answer's id is '1'; allowed: 1"),
    ],
)
def test_an_answer_must_repeat_the_id_of_its_request(
    measured: DescentMeasurements, tmp_path: Path, reply: str, message: str
) -> None:
    body = (
        f"""print('{{"exchange": 2, "ready": true}}', flush=True)\nsys.stdin.readline()\nprint('{reply}', flush=True)"""
    )
    with pytest.raises(AlgorithmError, match=message) as caught:
        ask(f"serve:{program(tmp_path, body)}", measured)
    assert caught.value.fault is Fault.BAD_ANSWER


def test_a_persistent_program_must_say_that_it_is_ready(measured: DescentMeasurements, tmp_path: Path) -> None:
    with pytest.raises(AlgorithmError, match="its first line is") as caught:
        ask(f"serve:{program(tmp_path, 'print({}, flush=True); time.sleep(60)')}", measured)
    assert caught.value.fault is Fault.BAD_ANSWER


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("exec:", "names no program"),
        ("exec:./nothing --here", "is not there, or may not be run"),
        ("exec:nothing-of-this-name", "not on the PATH"),
        ("exec:'unclosed", "cannot be read"),
    ],
)
def test_programs_that_are_not_there(spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_command(spec)


def test_answers_in_python_are_held_against_the_interface() -> None:
    velocity = np.array([1.0, 2.0])
    good = VelocityEstimate(VelocityOutcome.VALID, velocity)
    assert check_velocity(good).velocity_m_s is not velocity
    for wrong in (
        None,
        dataclasses.replace(good, velocity_m_s=None),
        VelocityEstimate(VelocityOutcome.IMU_MISMATCH, velocity),
        dataclasses.replace(good, velocity_m_s=np.array([1.0, np.inf])),
        dataclasses.replace(good, covariance_m2_s2=np.array([[1.0, 0.5], [0.4, 1.0]])),
    ):
        with pytest.raises(AlgorithmError) as caught:
            check_velocity(wrong)
        assert caught.value.fault is Fault.BAD_ANSWER
    with pytest.raises(AlgorithmError, match="NO_SAFE_SITE"):
        check_site(SiteEstimate(SiteOutcome.NO_SAFE_SITE, np.zeros(3)))


def test_the_example_in_c(measured: DescentMeasurements, tmp_path: Path) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc")
    assert compiler is not None, "the set-up script installs a C compiler"
    built = tmp_path / "velocity_estimator"
    warnings = ("-Wall", "-Wextra", "-Werror", "-Wno-format-truncation")
    source = str(EXAMPLES / "velocity_estimator.c")
    subprocess.run([compiler, "-O2", "-std=c11", *warnings, "-o", str(built), source, "-lm"], check=True)
    for spec in (f"exec:{built}", f"serve:{built} --serve"):
        found = ask(spec, measured)
        assert found.velocity_m_s is not None
        # whole pixels of 1.6 m (4 rows: 6.5 m) over 3.75 s, a quarter of that in the median of 25
        assert np.hypot(*(found.velocity_m_s - TRUE)) < 1.0
        assert isinstance(found.details, ProgramDetails)
        assert "templates found" in found.details.stderr
    end_persistent()
    flat = tuple(dataclasses.replace(one, counts=np.full_like(one.counts, 4095)) for one in measured.images)
    blank = dataclasses.replace(measured, images=flat)
    assert ask(f"exec:{built}", blank).outcome is VelocityOutcome.NO_VALID_TRACK


def test_the_example_in_python(measured: DescentMeasurements, monkeypatch: pytest.MonkeyPatch) -> None:
    from marsyard.algorithms.dimes import DimesOptions
    from marsyard.scenarios.estimators import VELOCITY

    monkeypatch.chdir(EXAMPLES)
    estimator = VELOCITY.make("velocity_estimator:MedianShift", DimesOptions(), ExecutableLimits())
    found = check_velocity(estimator.estimate(measured))
    assert found.velocity_m_s is not None
    assert np.hypot(*(found.velocity_m_s - TRUE)) < 1.0
    assert found.covariance_m2_s2 is not None
