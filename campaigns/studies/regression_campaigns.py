"""Campaign files of the violations that a search has reduced: each runs its violation again with new random streams."""

from pathlib import Path
from typing import Any

import tomli_w

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import report_write_errors
from marsyard.campaigns.studies.results import SEARCH, SearchResult
from marsyard.campaigns.studies.runner import find_requirement


def write_regression_campaigns(campaign: Campaign, result: SearchResult, directory: Path) -> list[Path]:
    """Write one campaign file per reduced violation into DIR/failures, and a plan of nightly runs with all of them.

    Each file has the parameters of the reduced case, no dispersions, and new random streams for each of its cases.
    """
    folder, paths = directory / "failures", list[Path]()
    definition = campaign.definition
    requirement = find_requirement(campaign, SEARCH.read_parameters(directory).requirement)
    with report_write_errors(folder):
        folder.mkdir(exist_ok=True)
        for number, failure in enumerate(result.failures, start=1):
            name = f"{definition.name}-failure-{number}"
            values_text = ", ".join(f"{path} = {_short_text(value)}" for path, value in failure.values.items())
            tables = {
                "name": name,
                "scenario": definition.scenario,
                "description": f"Violation of {requirement.id} with {values_text or 'the parameters of the campaign'}.",
                "cases": max(failure.repetitions, 1),
                "seed": definition.seed,
                "parameters": campaign.with_values(failure.values).model_dump(mode="json"),
                "requirements": [requirement.model_dump(mode="json")],
            }
            paths.append(folder / f"{name}.toml")
            paths[-1].write_text(tomli_w.dumps(_without_none(tables)), encoding="utf-8")
        plan = {"campaigns": [{"campaign": path.name} for path in paths]}
        (folder / "nightly.toml").write_text(tomli_w.dumps(plan), encoding="utf-8")
    return paths


def _short_text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _without_none(value: Any) -> Any:
    """Remove keys without a value, which TOML cannot represent; they have their default."""
    if isinstance(value, dict):
        return {name: _without_none(inner) for name, inner in value.items() if inner is not None}
    return [_without_none(inner) for inner in value] if isinstance(value, list | tuple) else value
