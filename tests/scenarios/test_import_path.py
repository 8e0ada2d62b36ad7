"""Tests of import paths `module:name`."""

from pathlib import Path

import pytest

from marsyard.algorithms.dimes import DimesEstimator
from marsyard.scenarios.imports import import_object, source_files


def test_sources_are_those_of_the_package() -> None:
    path = "marsyard.algorithms.dimes:DimesEstimator"
    assert import_object(path) is DimesEstimator
    names = [name for name, _ in source_files(path)]
    assert "algorithms/dimes/estimator.py" in names
    assert {name.partition("/")[0] for name in names} == {"algorithms"}


def test_custom_module_is_imported_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "reports_custom.py").write_text("class Estimator: ...\n")
    monkeypatch.chdir(tmp_path)
    assert import_object("reports_custom:Estimator").__name__ == "Estimator"
