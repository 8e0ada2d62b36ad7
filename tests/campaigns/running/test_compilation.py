"""Tests of the compilation of kernels, before the first case of a campaign and by `marsyard compile`."""

import re
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running import compilation
from marsyard.campaigns.running.compilation import compile_kernels, list_compilations
from marsyard.scenarios.systems import scenario_names, systems
from marsyard.sim.kernel_cache import mark_ready
from tests.command import run_command
from tests.inline_workers import InlineExecutor


def test_missing_kernels_are_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    compiled, notes = [], list[str]()

    def compile_campaign(name: str, overrides: tuple[str, ...]) -> None:
        compiled.append((name, overrides))
        mark_ready("descent")

    monkeypatch.setattr(compilation, "compile_campaign", compile_campaign)
    compile_kernels(InlineExecutor(), "descent", notes.append)
    assert compiled == [("dimes-smoke", ("terrain.samples=512",))]
    assert notes[0].startswith("compiling numeric kernels once on this machine, about a minute")
    assert re.fullmatch(r"numeric kernels are compiled, \d+ s", notes[1])
    # neither compiled kernels nor a scenario without kernels of its own cause notes
    compile_kernels(InlineExecutor(), "descent", notes.append)
    compile_kernels(InlineExecutor(), "tests.campaigns.fake_scenario:FakeScenario", notes.append)
    assert len(compiled) == 1
    assert len(notes) == 2


def test_failed_compilation_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def fail(name: str, overrides: tuple[str, ...]) -> None:
        raise RuntimeError("no renderer")

    monkeypatch.setattr(compilation, "compile_campaign", fail)
    notes = list[str]()
    compile_kernels(InlineExecutor(), "descent", notes.append)
    assert notes[-1].startswith("numeric kernels could not be compiled: no renderer")


def test_scenarios_share_the_compilation_of_their_system() -> None:
    rover = [scenario for scenario, _name, _settings in list_compilations("rover-drive")]
    assert rover == [scenario for scenario, _name, _settings in list_compilations("rover")]
    assert "rover" in rover
    assert len(list_compilations()) > len(rover)


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
