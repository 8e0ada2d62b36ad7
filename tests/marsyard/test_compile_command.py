"""`marsyard compile`: small cases of every system, none where it was done before; runs say when they wait for it."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.cli.app import app
from marsyard.scenarios.systems import scenario_names, systems
from marsyard.sim.kernel_cache import mark_ready


def test_every_system_has_a_small_case_that_the_catalogue_takes() -> None:
    small = (one for system in systems() for one in system.compiled_by.items())
    scenarios = {load_campaign(name, settings).configuration.scenario for name, settings in small}
    # the field test, recorded drives and real pictures call the kernels of these
    others = {"fieldtest", "rover-drive", "measured-velocity", "measured-landing", "measured-matching"}
    assert scenarios == set(scenario_names()) - others


def test_what_is_compiled_is_not_compiled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for scenario in ("descent", "rover", "landing"):
        mark_ready(scenario)
    done = CliRunner().invoke(app, ["compile"])
    assert (done.exit_code, done.output) == (
        0,
        "descent: compiled before\nrover: compiled before\nlanding: compiled before\n",
    )
