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
#: Import a scenario, check the parameters of a case of its first campaign, and print the imported modules.
PROGRAM = """
import json, sys
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.systems import find_system, scenario
name = sys.argv[1]
scenario(name)
campaigns = (load_campaign(campaign) for campaign in find_system(name).campaigns)
campaign = next((campaign for campaign in campaigns if campaign.definition.scenario == name), None)
is_checked = campaign is not None and campaign.parameters(0) is not None
modules = [module.removeprefix("marsyard.") for module in sys.modules if module.startswith("marsyard.")]
print(json.dumps([is_checked, modules]))
"""


@pytest.mark.parametrize("name", sorted(scenario_paths()))
def test_scenario_imports_no_other_system(name: str) -> None:
    output = subprocess.run([sys.executable, "-c", PROGRAM, name], check=True, capture_output=True, text=True).stdout
    is_checked, modules = json.loads(output)
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
