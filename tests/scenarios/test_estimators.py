"""Tests of algorithm selection by name, import path and entry point, and of several algorithms in one case.

An algorithm `x` has the published options, `x-plus` has improved ones, and `x-custom` those of the campaign file.
"""

from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

from marsyard.algorithms.dimes import DimesEstimator, DimesOptions
from marsyard.algorithms.dimes.baselines import HomographyEstimator
from marsyard.algorithms.exchange import ExecutableAlgorithm, ExecutableLimits, ExecutableTargetTracker
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.algorithms.vtt import VttOptions
from marsyard.reports.comparison import select_algorithm
from marsyard.scenarios import custom_algorithms
from marsyard.scenarios.algorithm_labels import labels
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_algorithm
from marsyard.scenarios.algorithm_selection import AlgorithmSelection, check_algorithms
from marsyard.scenarios.case_evaluation import Runs, Score, evaluate_case
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.imports import import_object, source_files
from marsyard.scenarios.interface import CaseResult, Failure, Scalar
from marsyard.scenarios.landing_task import LANDING
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.streamed import StreamedEstimator
from marsyard.scenarios.tasks import Task
from marsyard.scenarios.velocity import VELOCITY
from marsyard.scenarios.velocity_score import consistency_row

LIMITS = ExecutableLimits(isolated=False)


def test_algorithm_is_imported_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "local_algorithm.py").write_text("class Mine:\n    def estimate(self, measurements): ...\n")
    monkeypatch.chdir(tmp_path)
    VELOCITY.check("local_algorithm:Mine")
    assert type(VELOCITY.make("local_algorithm:Mine", DimesOptions(), LIMITS)).__name__ == "Mine"
    with pytest.raises(ValueError, match="target tracker: missing members: designate, aim, update, clear, state"):
        TRACKING.check("local_algorithm:Mine")


def test_sources_are_those_of_the_package() -> None:
    path = "marsyard.algorithms.dimes:DimesEstimator"
    assert import_object(path) is DimesEstimator
    names = [name for name, _ in source_files(path)]
    assert "algorithms/dimes/estimator.py" in names
    assert {name.partition("/")[0] for name in names} == {"algorithms"}


def test_module_that_raises_gives_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "raising_module.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="cannot import algorithm 'raising_module:Mine': ZeroDivisionError"):
        VELOCITY.check("raising_module:Mine")


def test_entry_point_is_an_algorithm_name_unless_it_is_built_in(monkeypatch: pytest.MonkeyPatch) -> None:
    group = custom_algorithms.GROUP
    entry_points = [
        EntryPoint(name, "marsyard.algorithms.dimes.baselines:HomographyEstimator", group)
        for name in ("installed", "dimes")
    ]
    installed_entry_points = {entry_point.name: entry_point for entry_point in entry_points}
    monkeypatch.setattr(custom_algorithms, "list_installed", lambda: installed_entry_points)
    assert isinstance(VELOCITY.make("installed", DimesOptions(), LIMITS), HomographyEstimator)
    assert not isinstance(VELOCITY.make("dimes", DimesOptions(), LIMITS), HomographyEstimator)
    with pytest.raises(ValueError, match=r"did you mean 'installed'.*dimes-plus.*homography, installed"):
        VELOCITY.check("installedd")


def test_programs_are_accepted_as_algorithms() -> None:
    algorithm = VELOCITY.make("exec:cat --number", DimesOptions(), LIMITS)
    assert isinstance(algorithm, ExecutableAlgorithm)
    assert algorithm.command.words == ("cat", "--number")
    LANDING.check("serve:cat")
    TRACKING.check("exec:cat")
    assert isinstance(TRACKING.make("serve:cat", VttOptions(), LIMITS), ExecutableTargetTracker)


def test_labels_are_unique_column_names() -> None:
    names = labels(["dimes", "phase-correlation", "a.b:Mine", "exec:./x/mine-1 --fast", "c:Mine", "exec:./7"])
    assert names == ("dimes", "phase_correlation", "Mine", "mine_1", "Mine_2", "a_7")


@pytest.mark.parametrize(
    ("task", "name", "key", "improved_value"),
    [
        (VELOCITY, "dimes", "correct_tilt", True),
        (TRACKING, "vtt", "warp", "bend"),
        (LANDING, "hda", "check_footprints", True),
    ],
)
def test_only_the_custom_variant_accepts_an_improvement(
    task: Task[Any, Any], name: str, key: str, improved_value: Any
) -> None:
    defaults = task.options()
    improved_options = replace(defaults, **{key: improved_value})
    assert task.make(name, defaults, LIMITS).options == defaults
    assert getattr(task.make(f"{name}-plus", defaults, LIMITS).options, key) == improved_value
    assert task.make(f"{name}-custom", improved_options, LIMITS).options == improved_options
    for standard_name in (name, f"{name}-plus"):
        with pytest.raises(ValueError, match=f"define the option {key}; '{name}-custom' accepts it"):
            task.make(standard_name, improved_options, LIMITS)


def test_improvement_of_a_published_algorithm_is_rejected_before_the_campaign() -> None:
    with pytest.raises(
        ValueError, match="'dimes' and 'dimes-plus' define the option correct_tilt; 'dimes-custom' accepts it"
    ):
        DescentScenarioParameters.model_validate({"dimes": {"correct_tilt": True}})
    DescentScenarioParameters.model_validate({"dimes": {"correct_tilt": True}, "algorithm": "dimes-custom"})


def test_duplicate_algorithm_is_rejected() -> None:
    with pytest.raises(ValueError, match="'dimes' is listed twice"):
        check_algorithms(VELOCITY, ["dimes", "dimes"])
    with pytest.raises(ValueError, match="'dimes' is listed twice"):
        DescentScenarioParameters.model_validate({"compared": ["dimes"]})


def select(algorithm: str, compared: str) -> AlgorithmSelection:
    """Select two algorithms by names that no task checks."""
    return AlgorithmSelection.model_construct(algorithm=algorithm, compared=(compared,))


def test_failing_algorithm_does_not_affect_others() -> None:
    def evaluate(first: str, second: str) -> CaseResult:
        def divide(spec: str) -> AlgorithmRun[float]:
            return run_algorithm(lambda: 1.0 / float(spec), lambda answer: cast(float, answer))

        def score(spec: str, runs: Runs[float]) -> Score:
            answered = runs[spec].answer is not None
            return Score(answered, {"error_m": 0.5}, outcome="VALID" if answered else "")

        return evaluate_case(select(first, second), {"altitude_m": 7.0}, divide, score)

    case = evaluate("2", "0")
    assert (case.outcome, case.answered, case.failure) == ("VALID", True, None)
    assert case.row["algorithm"] == "a_2"
    assert case.row["a_0.outcome"] == "CRASHED"
    assert case.row["a_0.answered"] is False
    assert case.row["a_0.error"] == "ZeroDivisionError: float division by zero"
    assert "a_0.altitude_m" not in case.row
    swapped_case = evaluate("0", "2")
    assert swapped_case.outcome == swapped_case.failure.outcome == "CRASHED"
    assert swapped_case.row["altitude_m"] == 7.0
    assert swapped_case.row["a_2.outcome"] == "VALID"


def test_failed_algorithm_has_its_own_empty_columns() -> None:
    """Without them, a comparison would show the columns of the algorithm under test as those of the failed one."""

    def run(spec: str) -> AlgorithmRun[float]:
        return AlgorithmRun(0.0, None, {}) if spec == "tested" else AlgorithmRun(None, failure, {"time_s": 2.0})

    def score(spec: str, runs: Runs[float]) -> Score:
        return Score(True, answered_row, outcome="VALID") if spec == "tested" else Score(False, {})

    failure = Failure("CRASHED", "it crashed", "")
    answered_row: dict[str, Scalar] = {"error_m": 0.5, "in_time": True, "note": "text"}
    row = evaluate_case(select("tested", "other"), {"altitude_m": 7.0}, run, score).row
    assert np.isnan(row["other.error_m"])
    assert (row["other.in_time"], row["other.time_s"]) == (False, 2.0)
    assert "other.note" not in row
    frame = pd.DataFrame([row, row])
    assert select_algorithm(frame, "other")["error_m"].isna().all()
    assert select_algorithm(frame, "other")["altitude_m"].eq(7.0).all()


def test_normalised_error_uses_the_covariance() -> None:
    # Standard deviations 3 and 2, correlation 0.5, error (3, 2): (1 + 1 - 2 * 0.5) / (1 - 0.5**2) = 4 / 3.
    covariance = np.array([[9.0, 3.0], [3.0, 4.0]])
    estimate = VelocityEstimate(VelocityOutcome.VALID, np.array([3.0, 2.0]), covariance_m2_s2=covariance)
    row = consistency_row(estimate, np.zeros(2))
    assert row["velocity_nees"] == pytest.approx(4.0 / 3.0)
    assert (row["velocity_normalised_x"], row["velocity_normalised_y"]) == (1.0, 1.0)
    assert row["velocity_correlation"] == pytest.approx(0.5)
    assert consistency_row(VelocityEstimate(VelocityOutcome.VALID, np.zeros(2)), np.zeros(2)) == {}


STREAM_CLASS = "class Mine:\n    def start(self): ...\n    def process_image(self, frame): ...\n"


def test_stream_and_three_image_estimators_are_distinguished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finish = "    def finish(self): ...\n"
    (tmp_path / "stream_module.py").write_text(f"{STREAM_CLASS}{finish}\ndef make():\n    return Mine()\n")
    (tmp_path / "incomplete_stream.py").write_text(STREAM_CLASS)
    monkeypatch.chdir(tmp_path)
    entry_point = EntryPoint("installed", "stream_module:Mine", custom_algorithms.GROUP)
    monkeypatch.setattr(custom_algorithms, "list_installed", lambda: {"installed": entry_point})
    for spec in ("stream_module:Mine", "stream_module:make", "installed", "exec-stream:cat", "serve-stream:cat -u"):
        VELOCITY.check(spec)
        assert isinstance(VELOCITY.make(spec, DimesOptions(), LIMITS), StreamedEstimator)
    accepts = {spec: VELOCITY.accepts_stream(spec) for spec in ("installed", "serve-stream:cat", "exec:cat", "dimes")}
    assert accepts == {"installed": True, "serve-stream:cat": True, "exec:cat": False, "dimes": False}
    # The result of a factory function is unknown without a call.
    assert VELOCITY.accepts_stream("stream_module:make") is None
    with pytest.raises(ValueError, match="is not a valid velocity estimator: missing members: finish"):
        VELOCITY.check("incomplete_stream:Mine")
    with pytest.raises(ValueError, match="a target tracker does not accept a stream of images; allowed: exec:, serve:"):
        TRACKING.check("exec-stream:cat")
    with pytest.raises(ValueError, match="is not a valid estimator of landing sites: missing members: estimate"):
        LANDING.check("stream_module:Mine")
    assert labels(["exec-stream:./mine --fast", "serve-stream:./mine"]) == ("mine", "mine_2")
