"""Estimates printed before a campaign runs: time, disk space, and requirements that cannot be PASS."""

import bisect
from dataclasses import replace

import numpy as np
import pandas as pd
import typer

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.execution.executors import ExecutorConfig, available_cores
from marsyard.campaigns.running.estimate import estimate_campaign
from marsyard.cli.terminal import size_text
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.sampling_design import SamplingDesign, read_sampling_design
from marsyard.reports.statistics.proportions import minimum_sample_size
from marsyard.reports.verdicts import ESTIMATE, Status
from marsyard.reports.wording import count, format_fraction

#: Maximum number of cases that are drawn to count their distinct terrains; the draws of a case take milliseconds.
_MAX_DRAWS = 5000


def evidence_limits(campaign: Campaign) -> list[str]:
    """Return the reasons why the strictest requirement cannot be PASS even without a failure; empty if it can.

    Each reason contains a remedy. Only requirements that are decided at a confidence are considered. The population is
    assumed to be all cases; a smaller population requires more cases.
    """
    definition = campaign.definition
    requirements = [item for item in definition.requirements if item.decide_by != ESTIMATE]
    design = read_sampling_design(definition.model_dump(mode="json"))
    if not requirements:
        return []
    if not design.independent:
        return [design.no_probability_reason]
    needed = {item.id: _min_cases(item, design) for item in requirements}
    strictest = max(requirements, key=lambda item: needed[item.id])
    min_cases, cases = needed[strictest.id], definition.total_cases
    requirement_text = f"{format_fraction(strictest.probability)} at {format_fraction(strictest.confidence)} confidence"
    limits = []
    if cases < min_cases:
        condition = f"{requirement_text} takes at least {count(min_cases, 'case')} without a failure"
        limits.append(f"{strictest.id}: {condition}; the campaign has {cases}.")
    terrain_supply = design.terrains
    if terrain_supply is None:
        return limits
    # number of distinct terrains: assigned in turn, or drawn at random
    terrains = min(cases, terrain_supply.terrains)
    path = next((path for path in ("location.terrain", "world.terrain") if path in definition.dispersions), None)
    if not terrain_supply.in_turn and path is not None and cases <= _MAX_DRAWS:
        terrains = len({campaign.draws(case)[path] for case in range(int(definition.design.nominal), cases)})
    # if several cases share a terrain, the evidence is limited by the number of terrains
    if terrains < min(cases, min_cases):
        limits.append(terrain_supply.advice(min_cases, strictest.probability, strictest.confidence))
    return limits


def _min_cases(requirement: Requirement, design: SamplingDesign) -> int:
    """Return the minimum number of cases, each on its own terrain, of which the verdict can be PASS.

    It is that of a run without a failure under the rule of the verdict: with a nominal case, planned looks, or appended
    cases.
    """
    rule = requirement.model_dump(mode="json") | {"population": "all"}
    value = True if requirement.bound is None else 0.0

    def can_pass(cases: int) -> bool:
        numbers = np.arange(cases)
        columns = {"case": numbers, "outcome": "VALID", "answered": True, "terrain": numbers}
        rows = pd.DataFrame(columns | dict.fromkeys(requirement.metric_columns, value))
        looks = design if design.max_cases is None else replace(design, max_cases=cases)
        return evaluate_requirements(rows, [rule], looks)[0].status is Status.PASS

    first = minimum_sample_size(requirement.probability, requirement.confidence)
    upper = first
    while not can_pass(upper):
        upper *= 2
    return first + bisect.bisect_left(range(first, upper), True, key=can_pass)


def print_estimate(campaign: Campaign, executor: ExecutorConfig) -> None:
    """Print the estimated time and disk space of a campaign."""
    workers = executor.jobs if executor.cluster is None else _cluster_workers(executor.cluster)
    estimate = estimate_campaign(campaign, workers)
    total = campaign.definition.total_cases
    low, high = estimate.case_range_s
    typer.echo(f"{count(total, 'case')} on {count(workers, 'worker')}: about {_duration_text(estimate.time_s)}")
    if estimate.inputs:
        typer.echo(f"  {count(estimate.inputs, 'terrain')} (shared inputs) to build, {estimate.input_s:.3g} s each")
    trials = count(estimate.trials, "trial case")
    typer.echo(f"  {estimate.case_s:.3g} s per case ({low:.3g} to {high:.3g} s in {trials})")
    if estimate.unfinished:
        typer.echo(f"  {estimate.unfinished} of the trial cases did not finish")
    rows, products = size_text(estimate.rows_bytes), size_text(estimate.products_bytes)
    typer.echo(f"disk: {rows} of rows, up to {products} of products")
    if estimate.inputs_bytes:
        limit = size_text(estimate.cache_limit_bytes)
        typer.echo(f"  {size_text(estimate.inputs_bytes)} of terrains in the cache (maximum {limit})")


def _cluster_workers(address: str) -> int:
    """Return the number of workers of a new cluster ``local:N``; that of another cluster is assumed."""
    kind, _, number = address.partition(":")
    if kind == "local" and number.isdecimal() and int(number):
        return int(number)
    typer.echo("note: the cluster is assumed to have one worker per core of this machine")
    return available_cores()


def _duration_text(time_s: float) -> str:
    """Format a duration in the largest unit of which there are at least two."""
    if time_s < 120.0:
        return f"{time_s:.0f} s"
    return f"{time_s / 60.0:.0f} min" if time_s < 7200.0 else f"{time_s / 3600.0:.1f} h"


def print_limits(campaign: Campaign) -> None:
    """Print which requirements of the campaign cannot be PASS, and the remedy (see `evidence_limits`)."""
    for limit in evidence_limits(campaign):
        typer.echo(f"note: {limit}")
