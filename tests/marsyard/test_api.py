"""Tests of the notebook interface: exported names, types and example scripts."""

import inspect
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import marsyard
from marsyard import api

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
#: Text in the output of each example script; the first one draws altitudes of about 1900 m.
EXPECTED_OUTPUT = {
    "draw_and_plan.py": "descent.altitude_first_m: 19",
    "run_one_case.py": "products: ",
    "custom_camera.py": "Cahvor: 0.03 px off (RMS)",
}


def test_exported_names_are_documented_and_typed() -> None:
    functions = {
        name for name, function in inspect.getmembers(api, inspect.isfunction) if function.__module__ == api.__name__
    }
    assert {name for name in functions if not name.startswith("_")} <= set(marsyard.__all__)
    for name in marsyard.__all__:
        member = getattr(marsyard, name)
        assert inspect.getdoc(member), name
        if inspect.isfunction(member):
            assert "return" in member.__annotations__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'; it has"):
        _ = marsyard.nothing


def test_import_loads_no_heavy_packages() -> None:
    """Heavy imports would delay `marsyard --help`."""
    program = (
        "import sys, marsyard\n"
        "print([name for name in ('numpy', 'scipy', 'pandas', 'marsyard.api') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_changes_accept_values_of_python_and_numpy() -> None:
    changes = {
        "compared": ["homography"],
        "site": "meridiani",
        "terrain.rms_slope_deg": np.linspace(1.0, 2.0, 3)[1],
        "location.east_m": np.float32(3.5),
        "terrain.samples": np.int64(1024),
        "exact_instruments": np.bool_(True),
        "dimes.binned_size": np.array([128, 64]),
    }
    campaign = marsyard.load_campaign("dimes-smoke", changes, cases=3)
    parameters = campaign.definition.parameters
    assert (parameters["compared"], parameters["site"]) == (["homography"], "meridiani")
    assert "location.east_m" not in campaign.definition.dispersions
    assert len(marsyard.draws(campaign, 3)) == 3
    assert (parameters["terrain"]["rms_slope_deg"], parameters["location"]["east_m"]) == (1.5, 3.5)
    assert (parameters["terrain"]["samples"], parameters["exact_instruments"]) == (1024, True)
    assert list(parameters["dimes"]["binned_size"]) == [128, 64]


def test_metric_of_a_case_without_the_column_is_missing() -> None:
    results = [marsyard.CaseResult("VALID", True, {"error_m": 2.5}), marsyard.CaseResult("CRASHED", False, {})]
    values = marsyard.collect_metric(results, "error_m")
    assert (values.name, values.index.name, values[0]) == ("error_m", "case", 2.5)
    assert values.isna().tolist() == [False, True]


@pytest.mark.parametrize(
    "name", ["draw_and_plan.py", "custom_camera.py", pytest.param("run_one_case.py", marks=pytest.mark.slow)]
)
def test_example_scripts_run(tmp_path: Path, name: str) -> None:
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / name)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(EXAMPLES.parents[1])},
    )
    assert result.returncode == 0, result.stderr
    assert EXPECTED_OUTPUT[name] in result.stdout
