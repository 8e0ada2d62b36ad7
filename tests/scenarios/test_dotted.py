"""What `module:name` stands for."""

from pathlib import Path

import pytest

from marsyard.algorithms.dimes import DimesEstimator
from marsyard.scenarios.dotted import current_module, found_at, sources_at


def test_former_module_names_are_still_found() -> None:
    assert found_at("algorithms.dimes:DimesEstimator") is DimesEstimator
    assert current_module("marsyard.algorithms.dimes") == "marsyard.algorithms.dimes"
    names = [name for name, _ in sources_at("algorithms.dimes:DimesEstimator")]
    assert "algorithms/dimes/estimator.py" in names
    assert {name.partition("/")[0] for name in names} == {"algorithms"}


def test_a_users_own_module_may_have_such_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "reports_of_mine.py").write_text("class Estimator: ...\n")
    monkeypatch.chdir(tmp_path)
    assert current_module("reports.mine") == "reports.mine"
    assert current_module("sim") == "marsyard.sim"
    assert found_at("reports_of_mine:Estimator").__name__ == "Estimator"
