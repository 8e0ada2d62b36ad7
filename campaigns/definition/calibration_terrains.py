"""Terrains that a confirmation shares with its calibration runs."""

from collections.abc import Mapping

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.parameter_paths import replace_values
from marsyard.scenarios.interface import IdentifiesTerrains
from marsyard.sim.terrain.bank import IMPORTED_TERRAIN


def calibration_overlap(campaign: Campaign, original_bank_seeds: Mapping[str, int]) -> float | None:
    """Compute the fraction of cases on terrains of the declared calibration runs; None if terrains have no identity.

    - campaign: a confirmation, with its seed and the seeds of its terrain banks
    - original_bank_seeds: seeds of the terrain banks of the campaign file, which its calibration runs used

    Calibration runs are assumed to have as many cases as the campaign.
    """
    definition, calibration = campaign.definition, campaign.definition.calibration
    runs = () if calibration is None else calibration.runs
    seeds = {run.seed for run in runs if run.campaign == definition.name}
    if not isinstance(campaign.scenario, IdentifiesTerrains):
        return None if seeds else 0.0
    parameters = replace_values(definition.parameters, original_bank_seeds)
    known_terrains: set[str] = set()
    for seed in seeds:
        changes = {"seed": seed, "parameters": parameters}
        calibration_run = Campaign(definition.model_copy(update=changes), campaign.scenario)
        known_terrains.update(*_list_terrains(calibration_run))
    if not known_terrains:
        return 0.0
    cases = _list_terrains(campaign)
    return sum(not known_terrains.isdisjoint(terrains) for terrains in cases) / len(cases)


def uses_imported_terrain(campaign: Campaign) -> bool:
    """Whether the cases are on an imported DTM, which a new seed of the terrain bank does not change."""
    if not isinstance(campaign.scenario, IdentifiesTerrains):
        return False
    identities = campaign.scenario.terrain_identities(campaign.base_parameters(), 0)
    return any(identity.startswith(IMPORTED_TERRAIN) for identity in identities)


def _list_terrains(campaign: Campaign) -> list[tuple[str, ...]]:
    """List the identities of the terrains of each case; a case with invalid draws has none."""
    assert isinstance(campaign.scenario, IdentifiesTerrains)  # noqa: S101  (checked by the caller)
    terrains = []
    for case in range(campaign.definition.total_cases):
        try:
            terrains.append(campaign.scenario.terrain_identities(campaign.parameters(case), case))
        except ValueError:
            terrains.append(())
    return terrains
