"""Tests of the Python interface: algorithms given as objects, campaigns without files, and results."""

import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import marsyard
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.running.replay import differing_columns
from marsyard.result import Result, open_result
from marsyard.scenarios.imports import import_object, source_files
from marsyard.scenarios.stored_objects import store_object
from tests.reports.synthetic_run import VELOCITY, make_rows, write_run

SCENARIO = "tests.campaigns.fake_velocity:FakeVelocityScenario"
REQUIREMENT = {"id": "V", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.2, "confidence": 0.5}
MODULE = """
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome

class MyEstimator:
    version = "2.0"

    def __init__(self, gain=1.0):
        self.gain = gain

    def estimate(self, measurements):
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
"""


def refuse(_measurements: Any) -> VelocityEstimate:
    return VelocityEstimate(VelocityOutcome.IMU_MISMATCH, None)


def _create_campaign(**changes: Any) -> marsyard.Campaign:
    values: dict[str, Any] = {"cases": 3, "seed": 9, "requirements": [REQUIREMENT], **changes}
    return marsyard.create_campaign("notebook", SCENARIO, **values)


@pytest.fixture
def estimator_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import a module with an estimator, as from the folder of a notebook."""
    (tmp_path / "my_notebook_module.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    module = __import__("my_notebook_module")
    yield module
    del sys.modules["my_notebook_module"]


@pytest.mark.slow
def test_object_has_the_rows_of_its_import_path(estimator_module: Any, tmp_path: Path) -> None:
    campaign = _create_campaign()
    results = [
        marsyard.run(campaign, algorithm, directory=tmp_path / name)
        for name, algorithm in (("path", "my_notebook_module:MyEstimator"), ("object", estimator_module.MyEstimator()))
    ]
    expected, rows = (list[Any](result.evaluation.run.all_cases.to_dict("records")) for result in results)
    assert [differing_columns(*pair) for pair in zip(rows, expected, strict=True)] == [()] * 3
    assert store_object(estimator_module.MyEstimator, tmp_path) == "my_notebook_module:MyEstimator"
    tested = results[1].evaluation.run.record["algorithms"][0]
    assert (tested["version"], tested["role"]) == ("2.0", "tested")
    assert tested["source_hash"]


def test_classes_and_functions_of_a_notebook_are_stored_with_their_code(tmp_path: Path) -> None:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(MODULE, namespace)  # noqa: S102  (as a notebook does)
    by_class = store_object(namespace["MyEstimator"], tmp_path)
    assert by_class.startswith(str(tmp_path))
    estimate = import_object(by_class)().estimate(None)
    assert estimate.outcome is namespace["VelocityOutcome"].NO_VALID_TRACK
    by_function = store_object(refuse, tmp_path)
    assert import_object(by_function)().estimate(None).outcome is VelocityOutcome.IMU_MISMATCH


def test_instances_are_copied_and_their_state_identifies_them(estimator_module: Any, tmp_path: Path) -> None:
    first, equal, other = (store_object(estimator_module.MyEstimator(gain), tmp_path) for gain in (1.0, 1.0, 2.0))
    assert first == equal != other
    factory = import_object(other)
    algorithm = factory()
    algorithm.gain = 5.0
    assert factory().gain == 2.0
    ((name, path),) = source_files(other)
    assert name.endswith(".py")
    assert "class MyEstimator" in path.read_text()


def _refuse_with(outcome: VelocityOutcome, span_s: float = 0.0) -> Callable[[Any], VelocityEstimate]:
    def answer(_measurements: Any, span_s: float = span_s) -> VelocityEstimate:
        return VelocityEstimate(outcome, None)

    return answer


def _wrap(function: Callable[[Any], VelocityEstimate]) -> Callable[[Any], VelocityEstimate]:
    return lambda measurements: function(measurements)


def _create_class(outcome: VelocityOutcome) -> type:
    class Refusing:
        def estimate(self, _measurements: Any) -> VelocityEstimate:
            return VelocityEstimate(outcome, None)

    return Refusing


def test_captured_values_identify_functions_and_classes(tmp_path: Path) -> None:
    outcomes = VelocityOutcome.IMU_MISMATCH, VelocityOutcome.NO_VALID_TRACK
    functions = [_refuse_with(outcome) for outcome in outcomes]
    wrapped, classes = [_wrap(function) for function in functions], [_create_class(outcome) for outcome in outcomes]
    for kinds in (functions, wrapped, classes, [item() for item in classes]):
        specs = [store_object(item, tmp_path) for item in kinds]
        answers = [import_object(spec)().estimate(None) for spec in specs]
        assert tuple(answer.outcome for answer in answers) == outcomes
    first, equal, other = (store_object(_refuse_with(outcomes[0], span_s), tmp_path) for span_s in (1.0, 1.0, 2.0))
    assert first == equal != other


@pytest.mark.parametrize(
    "source",
    [
        "def Algorithm(measurements):\n    return gain\n",
        "def Algorithm(measurements):\n    return [gain for _ in range(3)]\n",
        "class Algorithm:\n    @staticmethod\n    def estimate(measurements):\n        return gain\n",
        "class Algorithm:\n    @property\n    def gain(self):\n        return gain\n",
        "class Algorithm:\n    gain = gain\n",
        "class Base:\n    def estimate(self, measurements):\n        return gain\nclass Algorithm(Base):\n    pass\n",
    ],
)
def test_global_variables_identify_code_of_a_notebook(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the source of a class is found through its module
    monkeypatch.setattr(inspect, "getsource", lambda _: source)
    specs = []
    for gain in (1.0, 1.0, 2.0):
        namespace: dict[str, Any] = {"__name__": "__main__", "gain": gain}
        exec(source, namespace)  # noqa: S102  (as a notebook does)
        specs.append(store_object(namespace["Algorithm"], tmp_path))
    assert specs[0] == specs[1] != specs[2]


@dataclass(frozen=True, slots=True)
class _Slotted:
    gain: float


def test_state_in_slots_identifies_an_instance(tmp_path: Path) -> None:
    first, equal, other = (store_object(_Slotted(gain), tmp_path) for gain in (1.0, 1.0, 2.0))
    assert first == equal != other


def test_objects_that_cannot_be_stored_are_reported(tmp_path: Path) -> None:
    class HoldsGenerator:
        def __init__(self) -> None:
            self.items = (item for item in range(3))

        def estimate(self, _measurements: Any) -> None: ...

    with pytest.raises(CampaignError, match="the algorithm HoldsGenerator cannot be stored: TypeError"):
        marsyard.run(_create_campaign(), HoldsGenerator(), directory=tmp_path / "run")
    assert not (tmp_path / "run" / "campaign.json").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"requirements": ["NO-SUCH"]}, "NO-SUCH"),
        ({"dispersions": {"no.such": {"distribution": "uniform", "low": 0.0, "high": 1.0}}}, "no.such"),
        ({"cases": 0}, "cases"),
    ],
)
def test_invalid_campaigns_are_reported_by_key(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CampaignError, match=message) as caught:
        _create_campaign(**changes)
    assert "campaign 'notebook'" in str(caught.value)


def test_campaign_has_a_view_for_notebooks() -> None:
    text = _create_campaign()._repr_html_()
    assert "<h4>notebook</h4>" in text
    assert "<td>V</td>" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cases": 3}, "given by its name or file"),
        ({"compare": ["dimes"]}, "compare needs an algorithm under test"),
        ({"algorithm": "dimse"}, r"unknown algorithm 'dimse' \(did you mean"),
    ],
)
def test_invalid_arguments_are_rejected_for_a_campaign(tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(CampaignError, match=message):
        marsyard.run(_create_campaign(), directory=tmp_path / "run", **arguments)


@pytest.fixture
def result(tmp_path: Path) -> Result:
    """Return the result of a synthetic campaign with violations."""
    available = {"id": "A", "metric": "answered", "probability": 0.5, "confidence": 0.5}
    return Result(write_run(tmp_path / "run", make_rows(60, error_scale=4.0), [VELOCITY, available]))


def test_result_has_tables_of_cases_verdicts_and_violations(result: Result) -> None:
    errors = result.cases["velocity_error_m_s"]
    assert errors.index.name == "case"
    assert result.verdicts.loc["DIMES-VEL", "failures"] == (errors > 5.0).sum()
    assert result.verdict == result.verdicts["status"].iloc[0]
    failures = result.failures("DIMES-VEL")
    assert failures.index.tolist() == errors[errors > 5.0].sort_values(ascending=False).index.tolist()
    unanswered = result.cases.index[~result.cases["answered"]]
    assert set(result.failures().index) == {*failures.index, *unanswered}
    with pytest.raises(CampaignError, match="unknown requirement 'B'"):
        result.failures("B")


def test_cases_and_figures_are_shown(result: Result) -> None:
    worst = int(result.failures("DIMES-VEL").index[0])
    case = result.case(worst)
    assert case.row["velocity_error_m_s"] == result.cases["velocity_error_m_s"].max()
    assert case.summary.statuses[0].word == "violated"
    for name in ("errors", "histogram", "distribution"):
        assert isinstance(result.figure(name), Figure)
    # the requirement on this boolean column has no bound
    assert not [text.get_text() for text in result.figure("histogram", "answered").axes[0].texts]
    assert "violated" in case._repr_html_()
    assert "DIMES-VEL" in result._repr_html_()
    for call, message in (
        (lambda: result.case(60), "no case 60; allowed: 0 to 59"),
        (lambda: result.figure("pie"), "unknown figure 'pie'"),
        (lambda: result.figure(metric="nothing"), "no column 'nothing'"),
    ):
        with pytest.raises(CampaignError, match=message):
            call()


def test_bound_of_a_figure_is_in_the_unit_of_the_column(tmp_path: Path) -> None:
    """A requirement of 5 on a tenth of the error draws its bound at an error of 50."""
    scaled = {**VELOCITY, "scale": 0.1}
    result = Result(write_run(tmp_path / "run", make_rows(60), [scaled]))
    lines = result.figure("histogram").axes[0].lines
    (bound,) = (np.asarray(line.get_xdata())[0] for line in lines if line.get_linestyle() == "--")
    assert bound == pytest.approx(10.0 * VELOCITY["bound"])


def test_results_are_compared(result: Result, tmp_path: Path) -> None:
    other = Result(write_run(tmp_path / "other", make_rows(60, seed=2), [VELOCITY]))
    differences = result.compare(other)
    assert len(differences) >= 2
    assert result.compare(other.directory).equals(differences)


@pytest.mark.slow
def test_replayed_case_has_products_and_figures(tmp_path: Path) -> None:
    campaign = _create_campaign(retain={"showcase": "none", "products": "none"})
    result = marsyard.run(campaign, refuse, directory=tmp_path / "run")
    assert np.all(result.cases["outcome"] == "IMU_MISMATCH")
    case = result.case(1).replay()
    assert case.row["outcome"] == "IMU_MISMATCH"
    assert open_result(tmp_path / "run").case(1).figures(tmp_path / "figures") == []
