"""Custom algorithms in processes of their own: life cycle, devices, answers, and no access to the truth."""

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.dimes import DimesOptions
from marsyard.algorithms.exchange import ExecutableLimits
from marsyard.algorithms.exchange.serving import end_idle_programs
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.algorithms.vtt import VttOptions
from marsyard.campaigns.definition.components import algorithm_process_limits
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.conformance.trackers import drive_to_target
from marsyard.scenarios.isolation import remote
from marsyard.scenarios.isolation.plain import decode, encode
from marsyard.scenarios.isolation.remote import is_remote
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.stored_objects import store_object
from marsyard.scenarios.velocity import VELOCITY, run_estimator
from marsyard.sim.streams import Streams
from tests.campaigns.fake_campaign import RecordingWatch, read_case_rows, run
from tests.campaigns.fake_velocity import FakeVelocityParameters, FakeVelocityScenario

MODULE = "tests.scenarios.isolation.searching"


@pytest.fixture(autouse=True)
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let the algorithms write into a file; end their processes after the test."""
    path = tmp_path / "log"
    path.touch()
    monkeypatch.setenv("LOG", str(path))
    yield path
    end_idle_programs()


def run_case(algorithm: str, case: int = 0, **executable: Any) -> Any:
    """Run a case of the fake scenario."""
    parameters = FakeVelocityParameters.model_validate({"algorithm": f"{MODULE}:{algorithm}", "executable": executable})
    return FakeVelocityScenario().run(parameters, Streams(7, "isolation", case))


def test_algorithm_is_constructed_once_and_reset_before_each_case(log: Path) -> None:
    for case in range(4):
        run_case("Counting", case)
    lines = [line.split() for line in log.read_text().splitlines()]
    assert Counter(line[0] for line in lines) == {"construct": 1, "reset": 4, "estimate": 4}
    assert len({line[1] for line in lines if line[0] != "reset"}) == 1
    assert lines[0][2] == "cpu"


def test_workers_get_the_devices_in_turn(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for worker in range(3):
        monkeypatch.setenv("MARSYARD_WORKER_NUMBER", str(worker))
        run_case("Counting", devices=["cuda:0", "cuda:1"])
        end_idle_programs()
    lines = log.read_text().splitlines()
    assert [line.split()[2] for line in lines if line.startswith("construct")] == ["cuda:0", "cuda:1", "cuda:0"]


def test_time_of_a_process_that_has_ended_after_its_answer_is_not_negative(monkeypatch: pytest.MonkeyPatch) -> None:
    times_s = [5.0]

    def processor_time_s(_process: int) -> float:
        if not times_s:
            raise ProcessLookupError
        return times_s.pop()

    monkeypatch.setattr(remote, "processor_time_s", processor_time_s)
    assert run_case("Counting").row["estimation_time_s"] >= 0.0


def test_random_numbers_depend_on_the_inputs_and_not_on_earlier_cases() -> None:
    velocities = [
        [run_case("Counting", case).row["velocity_estimated_x_m_s"] for case in order] for order in ((0, 1), (1, 0))
    ]
    assert velocities[0] == velocities[1][::-1]
    assert velocities[0][0] != velocities[0][1]


def test_random_numbers_of_construction_and_reset_do_not_depend_on_the_process() -> None:
    columns = [f"velocity_estimated_{axis}_m_s" for axis in "xy"]
    answers = []
    for case in (0, 1, 1):  # the last one in a new process
        row = run_case("Wandering", case).row
        answers.append([row[name] for name in columns])
        # processor time of the call, without the start of the process
        assert 0.2 <= row["estimation_time_s"] < 0.3
        if case == 1:
            end_idle_programs()
    assert answers[0] == answers[1] == answers[2]


def test_truth_is_not_in_the_memory_or_files_of_the_process(log: Path) -> None:
    """The true inertial error and velocity are not found; in the worker itself they are."""
    case = Streams(7, "isolation", 0).generator("inertial").normal(size=3)
    measured = inputs.descent().interval_velocities_m_s + case
    truths = {float(value) for value in case}
    found = {}
    for isolated in (True, False):
        log.write_text("")
        run_case("Searching", isolated=isolated)
        found[isolated] = {float(number) for number in log.read_text().split()}
    assert set(measured.ravel().tolist()) <= found[True]  # its measurements
    assert not truths & found[True]
    assert truths <= found[False]


def test_classes_of_the_simulation_are_not_loaded_in_the_process(log: Path) -> None:
    run_case("Modules")
    modules = set(log.read_text().split())
    assert "marsyard.sim.measurements" in modules
    simulation = ("marsyard.sim.terrain", "marsyard.sim.render", "marsyard.sim.dynamics", "marsyard.sim.sensor")
    assert not [name for name in modules if name.startswith((*simulation, "marsyard.campaigns", "tests.campaigns"))]


def test_stream_receives_images_one_by_one(log: Path) -> None:
    measurements = inputs.inertial_descent(4)
    stream = VELOCITY.make(f"{MODULE}:Stream", DimesOptions(), ExecutableLimits())
    assert is_remote(stream)
    for _ in range(2):
        estimate = run_estimator(lambda: stream, measurements).answer
        assert isinstance(estimate, VelocityEstimate)
        assert estimate.velocity_m_s.tolist() == [4.0, 0.0]
        assert estimate.after_images == (None,) * 4
    assert log.read_text().splitlines() == [f"DescentFrame {number}" for number in (1, 2, 3, 4)] * 2


@pytest.mark.slow
def test_answers_to_one_case_have_a_limit_together() -> None:
    limits = ExecutableLimits(time_s=60.0, total_s=1.2)
    for _ in range(2):
        stream = VELOCITY.make(f"{MODULE}:Slow", DimesOptions(), limits)
        with pytest.raises(AlgorithmError, match=r"no answers to the case within 1\.2 s") as raised:
            stream.estimate(inputs.inertial_descent(8))
        assert raised.value.fault is Fault.TIMED_OUT
    slow_enough = VELOCITY.make(f"{MODULE}:Slow", DimesOptions(), ExecutableLimits(total_s=60.0))
    assert slow_enough.estimate(inputs.inertial_descent(3)).outcome is VelocityOutcome.NO_VALID_TRACK


@pytest.mark.slow
def test_limit_of_an_algorithm_does_not_end_the_case(tmp_path: Path) -> None:
    """The algorithm hangs longer than the limit of a case, and its limit is longer too."""
    path = tmp_path / "hanging.toml"
    path.write_text(
        f"""
        name = "hanging"
        scenario = "tests.campaigns.fake_velocity:FakeVelocityScenario"
        cases = 2
        seed = 1
        [limits]
        case_time_s = 2.0
        memory_gb = 1.0
        [parameters]
        algorithm = "homography"
        compared = ["{MODULE}:Hanging"]
        executable = {{ time_s = 3.0, total_s = 4.0, loading_s = 60.0 }}
        """
    )
    rows = read_case_rows(run(path, tmp_path / "run", RecordingWatch()))
    assert algorithm_process_limits(load_campaign(str(path)).definition) == (64.0, 2e9)
    assert [(row["outcome"], row["Hanging.outcome"]) for row in rows] == [("VALID", "TIMED_OUT")] * 2


def test_tracker_in_its_own_process_gives_the_same_answers() -> None:
    remote = TRACKING.make("marsyard.algorithms.vtt:VisualTargetTracker", VttOptions(), ExecutableLimits())
    local = TRACKING.make("vtt", VttOptions(), ExecutableLimits())
    for update, expected in zip(drive_to_target(remote), drive_to_target(local), strict=True):
        assert (update.state, update.losses) == (expected.state, expected.losses)
        np.testing.assert_array_equal(update.position_rover, expected.position_rover)
    assert remote.state is local.state


def test_stored_object_runs_in_its_own_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = store_object(lambda measurements: VelocityEstimate(VelocityOutcome.VALID, np.ones(2)), tmp_path / "objects")
    monkeypatch.chdir(tmp_path)
    relative = f"objects/{Path(spec.rpartition(':')[0]).name}:{spec.rpartition(':')[2]}"
    for name in (spec, relative):
        VELOCITY.check(name)
        estimate = VELOCITY.make(name, DimesOptions(), ExecutableLimits()).estimate(inputs.descent())
        assert estimate.velocity_m_s.tolist() == [1.0, 1.0]


def test_module_is_not_imported_in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_module.py").write_text(
        "class Mine:\n    version = '3'\n    def estimate(self, measurements): ...\n"
    )
    monkeypatch.chdir(tmp_path)
    VELOCITY.check("own_module:Mine")
    VELOCITY.make("own_module:Mine", DimesOptions(), ExecutableLimits())
    assert "own_module" not in sys.modules


def test_answers_survive_their_representation_and_unknown_types_do_not() -> None:
    classes = {"VelocityEstimate": VelocityEstimate, "VelocityOutcome": VelocityOutcome}
    answer = VelocityEstimate(VelocityOutcome.VALID, np.array([0.1, -3.0], dtype=np.float32), details=object())
    restored = decode(encode((answer, [1, None, "text", 1e-300])), classes)
    assert restored[1] == [1, None, "text", 1e-300]
    assert restored[0].outcome is VelocityOutcome.VALID
    assert restored[0].details is None
    np.testing.assert_array_equal(restored[0].velocity_m_s, answer.velocity_m_s)
    assert restored[0].velocity_m_s.dtype == np.float32
    assert type(decode(encode(Streams(1, "text", 0)), classes)).__name__ == "Streams"
    assert not vars(decode(encode({"key": 1}), classes))
