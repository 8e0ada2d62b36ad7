"""Descriptions of a campaign's algorithms for its record: class, version, options, hash of the sources."""

from __future__ import annotations

from importlib import metadata
from typing import Any

from marsyard.algorithms.exchange import parse_command
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.components import list_algorithms, list_compared_algorithms
from marsyard.campaigns.definition.identity import custom_sources, distribution_version, hash_sources
from marsyard.scenarios.custom_algorithms import custom_path, describe_custom
from marsyard.scenarios.imports import source_files
from marsyard.scenarios.interface import HasAlgorithms
from marsyard.scenarios.isolation.description import plain_options
from marsyard.scenarios.offline_algorithms import is_offline


def describe_algorithms(campaign: Campaign) -> list[dict[str, Any]]:
    """Describe the algorithms of a campaign, the one under test first; empty if the scenario has none.

    Keys of each entry: `spec` (name in the campaign), `role` (`tested` or `compared`), `path` (class as
    ``module:name``, or the file of the program or table), `version` (of the installed distribution, or the class's
    `version` attribute; None if there is neither), `options` and `source_hash` (SHA-256, 16 digits; None without a
    readable source).
    """
    selected_scenario = campaign.scenario
    if not isinstance(selected_scenario, HasAlgorithms):
        return []
    task = selected_scenario.task
    compared = list_compared_algorithms(campaign.definition)
    table: Any = campaign.base_parameters()
    for name in selected_scenario.algorithm_table:
        table = getattr(table, name)
    # the options of the shipped algorithms are one value of the table, if the scenario has any
    configured_options = next((value for _, value in table if isinstance(value, task.options)), task.options())
    entries = []
    for spec in list_algorithms(campaign.definition):
        # shipped algorithms are installed with Marsyard; their sources are all of `marsyard.algorithms`
        is_shipped = spec in task.shipped
        sources = list(source_files("marsyard.algorithms:") if is_shipped else custom_sources(spec))
        if is_shipped:
            algorithm = task.shipped[spec](configured_options)
            algorithm_class, version = type(algorithm), distribution_version("marsyard")
            path = f"{algorithm_class.__module__}:{algorithm_class.__qualname__}"
            options = plain_options(getattr(algorithm, "options", None))
        else:
            path, version, options = _describe_custom(spec)
        entries.append(
            {
                "spec": spec,
                "role": "compared" if spec in compared else "tested",
                "path": path,
                "version": version,
                "options": options,
                "source_hash": hash_sources(sources)[:16] if sources else None,
            }
        )
    return entries


def _describe_custom(spec: str) -> tuple[str, str | None, dict[str, Any]]:
    """Return class or file, version and options of a custom algorithm."""
    command = parse_command(spec)
    if command is not None or is_offline(spec):
        return (spec.partition(":")[2] if command is None else command.words[0]), None, {}
    path, description = custom_path(spec), describe_custom(spec)
    package = path.partition(":")[0].partition(".")[0]
    versions = map(distribution_version, metadata.packages_distributions().get(package, []))
    version = next((text for text in versions if text is not None), None) or description.version
    return path, version, dict(description.options)
