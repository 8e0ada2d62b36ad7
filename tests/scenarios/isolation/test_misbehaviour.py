"""Misbehaviours of a custom algorithm: its own outcome, and the unchanged row of the other algorithm of the case."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from marsyard.algorithms.exchange.serving import end_idle_programs
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.sim.streams import Streams
from tests.campaigns.fake_velocity import FakeVelocityParameters, FakeVelocityScenario
from tests.scenarios.isolation.misbehaving import ACTIONS, ANSWERS

SPEC = "tests.scenarios.isolation.misbehaving:Misbehaving"
TIME = "homography.estimation_time_s"


def run_case(monkeypatch: pytest.MonkeyPatch, folder: Path, misbehaviour: str, case: int = 0) -> CaseResult:
    """Run a case with a misbehaving algorithm under test, compared with `homography`."""
    time_s = 1.5 if EXPECTED.get(misbehaviour) == "TIMED_OUT" else 60.0
    name_file = folder / "misbehaviour"
    name_file.write_text(misbehaviour)
    monkeypatch.setenv("MISBEHAVIOUR", str(name_file))
    parameters = FakeVelocityParameters.model_validate(
        {"algorithm": SPEC, "compared": ["homography"], "executable": {"time_s": time_s, "memory_gb": 0.6}}
    )
    return FakeVelocityScenario().run(parameters, Streams(3, "misbehaviour", case))


def compared_row(result: CaseResult) -> dict[str, Scalar]:
    """Return the columns of the other algorithm, without its computation time."""
    return {name: value for name, value in result.row.items() if name.startswith("homography.") and name != TIME}


@pytest.fixture(scope="module")
def healthy_rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Scalar]]:
    """Return the rows of `homography` in two cases next to an algorithm that behaves."""
    folder = tmp_path_factory.mktemp("healthy")
    with pytest.MonkeyPatch.context() as patch:
        results = [run_case(patch, folder, "none", case) for case in range(2)]
    end_idle_programs()
    assert [result.outcome for result in results] == ["VALID", "VALID"]
    return [compared_row(result) for result in results]


EXPECTED = {name: outcome for name, (_, outcome) in ACTIONS.items()}
EXPECTED |= dict.fromkeys(ANSWERS, "BAD_ANSWER") | {"change its inputs": "CRASHED", "a nested list": "CRASHED"}


#: The other misbehaviours are tested in `make validate`.
QUICK = {"exit", "kill its parent", "close all descriptors", "loop", "allocate", "patch libraries", "leave an orphan"}
QUICK |= {"an object that runs code", "valid without a velocity"}


@pytest.mark.parametrize(
    "misbehaviour", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in EXPECTED]
)
def test_misbehaviour_affects_only_its_own_row(
    misbehaviour: str, healthy_rows: list[dict[str, Scalar]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("UNPICKLED", str(tmp_path / "unpickled"))
    result = run_case(monkeypatch, tmp_path, misbehaviour)
    assert result.outcome == EXPECTED[misbehaviour], result.failure
    assert compared_row(result) == healthy_rows[0]
    # without an answer there is no computation time
    assert np.isnan(result.row["estimation_time_s"]) == (result.failure is not None)
    assert not (tmp_path / "unpickled").exists()
    # the next case of the other algorithm is not affected either, and no process remains
    assert compared_row(run_case(monkeypatch, tmp_path, "none", case=1)) == healthy_rows[1]
    end_idle_programs()
    assert not subprocess.run(["pgrep", "-f", "sleep 721[12]"], capture_output=True, check=False).stdout


def test_traceback_of_the_algorithm_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    failure = run_case(monkeypatch, tmp_path, "raise").failure
    assert failure.error == "RuntimeError: no"
    assert "misbehaving.py" in failure.trace
