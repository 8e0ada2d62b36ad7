"""Tests of `marsyard compile`: each system has a small case for compilation; compiled systems are skipped."""

from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.systems import scenario_names, systems
from marsyard.sim.kernel_cache import mark_ready
from tests.command import run_command


def test_every_system_has_a_compile_case() -> None:
    compile_cases = (entry for system in systems() for entry in system.compilation_campaigns.items())
    scenarios = {load_campaign(name, overrides).definition.scenario for name, overrides in compile_cases}
    # these scenarios use the kernels of other scenarios
    measured = {f"measured-{task}" for task in ("velocity", "landing", "matching", "map")}
    without_compile_case = {"fieldtest", "rover-drive", *measured}
    assert scenarios == set(scenario_names()) - without_compile_case


def test_compiled_systems_are_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    names = ("descent", "landing", "localisation", "rover")
    for name in names:
        mark_ready(name)
    assert run_command("compile") == (0, "".join(f"{name}: already compiled\n" for name in names))
