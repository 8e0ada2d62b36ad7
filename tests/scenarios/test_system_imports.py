"""Test that a case of one system imports no module of another: in a process of its own, for each scenario."""

import json
import subprocess
import sys

import pytest

from marsyard.scenarios.systems import find_system, own_paths, scenario_paths

#: Algorithms of each scenario. The field test evaluates DIMES, and recorded images the algorithms of their task.
ALGORITHMS = {
    "descent": {"dimes"},
    "fieldtest": {"dimes"},
    "landing": {"hda"},
    "localisation": {"localisation"},
    "measured-landing": {"hda"},
    "measured-matching": set(),
    "measured-velocity": {"dimes"},
    "rover": {"navigation", "vtt"},
    "rover-drive": {"navigation", "vtt"},
}
#: Modules of the simulation that only rovers have.
ROVER_MODULES = {
    "sim.dynamics.driving",
    "sim.dynamics.rover",
    "sim.render.rover",
    "sim.sensor.mast",
    "sim.sensor.odometry",
}
#: Import a scenario, check the parameters of a case of its first campaign, and print the imported modules.
PROGRAM = """
import json, sys
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.systems import find_system, scenario
name = sys.argv[1]
scenario(name)
campaigns = (load_campaign(campaign) for campaign in find_system(name).campaigns)
campaign = next((campaign for campaign in campaigns if campaign.configuration.scenario == name), None)
is_checked = campaign is not None and campaign.parameters(0) is not None
modules = [module.removeprefix("marsyard.") for module in sys.modules if module.startswith("marsyard.")]
print(json.dumps([is_checked, modules]))
"""


def test_each_scenario_is_in_the_table() -> None:
    assert set(ALGORITHMS) == set(scenario_paths())


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_scenario_imports_no_other_system(name: str) -> None:
    output = subprocess.run([sys.executable, "-c", PROGRAM, name], check=True, capture_output=True, text=True).stdout
    is_checked, modules = json.loads(output)
    system = find_system(name)
    assert system is not None
    assert is_checked or not system.campaigns
    folder = scenario_paths()[name].split(".")[2]
    others = {f"scenarios.{other}" for other in own_paths() if other != folder}
    others |= {f"algorithms.{other}" for other in set().union(*ALGORITHMS.values()) - ALGORITHMS[name]}
    others |= set() if folder == "rover" else ROVER_MODULES
    # the registry reads the declaration of each system, which imports nothing
    declarations = {f"scenarios.{other}{module}" for other in own_paths() for module in ("", ".system")}
    prefixes = tuple(f"{other}." for other in others)
    imported = [module for module in modules if f"{module}.".startswith(prefixes)]
    assert set(imported) <= declarations
    assert [module for module in modules if module.startswith("reports.")] == []
