"""Tests of import paths `module:name`, also with the deprecated module names of earlier releases."""

from pathlib import Path

import pytest

from marsyard.algorithms.dimes import DimesEstimator
from marsyard.scenarios.user_files import current_module, import_object, source_files


def test_deprecated_module_names_are_resolved() -> None:
    assert import_object("algorithms.dimes:DimesEstimator") is DimesEstimator
    assert current_module("marsyard.algorithms.dimes") == "marsyard.algorithms.dimes"
    names = [name for name, _ in source_files("algorithms.dimes:DimesEstimator")]
    assert "algorithms/dimes/estimator.py" in names
    assert {name.partition("/")[0] for name in names} == {"algorithms"}


def test_custom_module_may_have_a_deprecated_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "reports_custom.py").write_text("class Estimator: ...\n")
    monkeypatch.chdir(tmp_path)
    assert current_module("reports.mine") == "reports.mine"
    assert current_module("sim") == "marsyard.sim"
    assert import_object("reports_custom:Estimator").__name__ == "Estimator"
