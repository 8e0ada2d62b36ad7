"""The names for notebooks: there, typed, and used by scripts that run as they are."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

import marsyard
from marsyard import api

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
#: What each script says, among others.
SCRIPTS = {
    "draw_and_plan.py": "descent.altitude_first_m: 19",
    "run_one_case.py": "products: ",
    "custom_camera.py": "Cahvor: 0.03 px off (RMS)",
}


def test_every_name_is_there_documented_and_typed() -> None:
    own = {name for name, one in inspect.getmembers(api, inspect.isfunction) if one.__module__ == api.__name__}
    assert {name for name in own if not name.startswith("_")} <= set(marsyard.__all__)
    for name in marsyard.__all__:
        found = getattr(marsyard, name)
        assert inspect.getdoc(found), name
        if inspect.isfunction(found):
            assert "return" in found.__annotations__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'; it has"):
        _ = marsyard.nothing


def test_importing_it_loads_nothing_else() -> None:
    """So that `marsyard --help` answers at once."""
    asked = "import sys, marsyard; print([m for m in ('numpy', 'scipy', 'pandas', 'marsyard.api') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_changes_are_written_as_toml_writes_them() -> None:
    changes = {"terrain.samples": 1024, "location.east_m": 3.5, "compared": ["homography"], "site": "meridiani"}
    campaign = marsyard.load_campaign("dimes-smoke", changes, cases=3)
    parameters = campaign.configuration.parameters
    assert parameters["terrain"]["samples"] == 1024
    assert parameters["compared"] == ["homography"]
    assert parameters["site"] == "meridiani"
    assert "location.east_m" not in campaign.configuration.dispersions
    assert len(marsyard.draws(campaign, 3)) == 3


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_run_as_they_are(tmp_path: Path, name: str) -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(EXAMPLES.parents[1])},
    )
    assert done.returncode == 0, done.stderr
    assert SCRIPTS[name] in done.stdout
