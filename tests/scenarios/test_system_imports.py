"""Test that a case of one system imports no module of another: in a process of its own, for each scenario."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from marsyard.scenarios.systems import find_system, own_paths, scenario_paths, systems

#: Packages of algorithms that a scenario uses in addition to that with the name of its system.
FURTHER_ALGORITHMS = {
    "fieldtest": {"dimes"},
    "measured-landing": {"hda"},
    "measured-map": {"dimes", "localisation"},
    "measured-velocity": {"dimes"},
    "rover": {"navigation"},
    "rover-drive": {"navigation"},
}
#: Folders of scenarios that a scenario uses in addition to that of its system.
FURTHER_SCENARIOS = {"measured-map": {"localisation"}}
#: Modules of the simulation that only rovers have.
ROVER = {"sim.dynamics.driving", "sim.dynamics.rover", "sim.render.rover", "sim.sensor.mast", "sim.sensor.odometry"}
#: For each scenario, in a process of its own: import the scenario, check the parameters of a case of its first
#: campaign, and print the imported modules. The processes share the imported libraries, which takes less time.
PROGRAM = """
import json, os, sys
import cv2, drjit, numba, numpy, pandas, pydantic, scipy.ndimage, scipy.optimize, scipy.spatial.transform, scipy.stats

def check(name):
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.scenarios.systems import find_system, scenario
    scenario(name)
    campaigns = (load_campaign(campaign) for campaign in find_system(name).campaigns)
    campaign = next((campaign for campaign in campaigns if campaign.definition.scenario == name), None)
    is_checked = campaign is not None and campaign.parameters(0) is not None
    modules = [module.removeprefix("marsyard.") for module in sys.modules if module.startswith("marsyard.")]
    print(json.dumps([name, is_checked, modules]), flush=True)

assert not any(module.startswith("marsyard") for module in sys.modules)
for name in sys.argv[1:]:
    if os.fork() == 0:
        check(name)
        os._exit(0)
    assert os.wait()[1] == 0, name
"""


@pytest.fixture(scope="module")
def imports() -> dict[str, tuple[bool, list[str]]]:
    """Return for each scenario whether parameters of a case were checked, and the imported modules."""
    command = [sys.executable, "-c", PROGRAM, *scenario_paths()]
    lines = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    return {name: (is_checked, modules) for name, is_checked, modules in map(json.loads, lines)}


@pytest.mark.parametrize("name", sorted(scenario_paths()))
def test_scenario_imports_no_other_system(name: str, imports: dict[str, tuple[bool, list[str]]]) -> None:
    is_checked, modules = imports[name]
    system = find_system(name)
    assert is_checked or not system.campaigns
    folder = scenario_paths()[name].split(".")[2]
    algorithms = {entry.name for entry in systems()}.union(*FURTHER_ALGORITHMS.values())
    others = {f"algorithms.{other}" for other in algorithms - {system.name, *FURTHER_ALGORITHMS.get(name, ())}}
    own_folders = {folder, *FURTHER_SCENARIOS.get(name, ())}
    others |= {f"scenarios.{other}" for other in {*own_paths()} - own_folders} | (set() if folder == "rover" else ROVER)
    imported = {module for module in modules if f"{module}.".startswith(tuple(f"{other}." for other in others))}
    # the registry reads the declaration of each system, which imports nothing
    assert imported <= {f"scenarios.{other}{module}" for other in own_paths() for module in ("", ".system")}
    assert not any(module.startswith("reports.") for module in modules)


def test_packages_of_algorithms_have_the_names_of_systems() -> None:
    folder = Path(__file__).parents[2] / "algorithms"
    packages = {path.name for path in folder.iterdir() if path.is_dir() and not path.name.startswith("_")}
    assert packages - {system.name for system in systems()} == {"exchange", "image", "navigation"}
