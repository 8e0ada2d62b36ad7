"""Tests of import paths `module:name`, also with the package names of earlier releases."""

from pathlib import Path

import pytest

from marsyard.algorithms.dimes import DimesEstimator
from marsyard.scenarios.imports import current_module, import_object, source_files


def test_former_package_names_are_resolved() -> None:
    assert import_object("algorithms.dimes:DimesEstimator") is DimesEstimator
    assert current_module("sim") == "marsyard.sim"
    assert current_module("marsyard.algorithms.dimes") == "marsyard.algorithms.dimes"
    names = [name for name, _ in source_files("algorithms.dimes:DimesEstimator")]
    assert "algorithms/dimes/estimator.py" in names
    assert {name.partition("/")[0] for name in names} == {"algorithms"}


def test_module_of_a_user_package_with_a_former_name_is_unchanged() -> None:
    # `reports` is a former package name, but Marsyard has no module `reports.mine`
    assert current_module("reports.mine") == "reports.mine"


def test_custom_module_is_imported_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # the module's name begins like a former package name
    (tmp_path / "reports_custom.py").write_text("class Estimator: ...\n")
    monkeypatch.chdir(tmp_path)
    assert import_object("reports_custom:Estimator").__name__ == "Estimator"
