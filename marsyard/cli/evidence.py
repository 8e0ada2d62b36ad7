"""Evidence of a campaign: limits of its requirements before the run, and sequential looks of `run --until-decided`."""

from __future__ import annotations

import os
from pathlib import Path

import typer

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import Watch, append_cases, run_campaign
from marsyard.campaigns.running.preparation import estimate
from marsyard.campaigns.store import record
from marsyard.cli.options import size_text
from marsyard.reports.evaluation import next_look
from marsyard.reports.sampling_design import sampled
from marsyard.reports.statistics.proportions import minimum_sample_size
from marsyard.reports.statistics.sequential import planned_looks
from marsyard.reports.verdicts import ESTIMATE, judge_campaign
from marsyard.reports.wording import count, stated

#: Terrains are counted of at most this many cases; a draw takes milliseconds.
_MAX_DRAWS = 5000


def evidence_limits(campaign: Campaign) -> list[str]:
    """Why requirements cannot be PASS even without a failure, with the remedy; empty where they can.

    Covers requirements that are decided at a confidence, each as of all cases: a smaller population needs more.
    """
    configuration = campaign.configuration
    asked = [one for one in configuration.requirements if one.decide_by != ESTIMATE]
    how = sampled(configuration.model_dump(mode="json"))
    if not asked:
        return []
    if not how.independent:
        return [how.no_probability]
    hardest = max(asked, key=lambda one: minimum_sample_size(one.probability, one.confidence))
    fewest = minimum_sample_size(hardest.probability, hardest.confidence)
    cases = configuration.total_cases
    what = f"{hardest.id}: {stated(hardest.probability)} at {stated(hardest.confidence)} confidence"
    limits = []
    if cases < fewest:
        limits.append(f"{what} takes at least {count(fewest, 'case')} without a failure, and {cases} are asked for.")
    supply = how.terrains
    if supply is None:
        return limits
    # the distinct terrains of the cases: in turn, or as drawn
    terrains = min(cases, supply.terrains) if supply.in_turn else cases
    path = next((path for path in ("location.terrain", "world.terrain") if path in configuration.dispersions), None)
    if not supply.in_turn and path is not None and cases <= _MAX_DRAWS:
        terrains = len({campaign.draws(case)[path] for case in range(int(configuration.design.nominal), cases)})
    # cases with a terrain each are limited by their number alone; others are counted by terrains
    if terrains < min(cases, fewest):
        limits.append(supply.advice(fewest, hardest.probability, hardest.confidence))
    return limits


def print_estimate(campaign: Campaign, executor: ExecutorConfig) -> None:
    """Print the estimated time and disk space of a campaign."""
    workers = executor.jobs if executor.cluster is None else os.cpu_count() or 1
    estimated = estimate(campaign, workers)
    total = campaign.configuration.total_cases
    low, high = estimated.case_range_s
    time_s = estimated.time_s
    duration = f"{time_s / 60.0:.0f} min" if time_s < 7200.0 else f"{time_s / 3600.0:.1f} h"
    duration = f"{time_s:.0f} s" if time_s < 120.0 else duration
    typer.echo(f"{count(total, 'case')} on {count(workers, 'worker')}: about {duration}")
    if estimated.inputs:
        typer.echo(f"  {count(estimated.inputs, 'terrain')} (shared inputs) to build, {estimated.input_s:.3g} s each")
    trials = count(estimated.trials, "trial case")
    typer.echo(f"  {estimated.case_s:.3g} s a case ({low:.3g} to {high:.3g} s in {trials})")
    if estimated.unfinished:
        typer.echo(f"  {estimated.unfinished} of the trial cases did not come to their end")
    rows, products = size_text(estimated.rows_bytes), size_text(estimated.products_bytes)
    typer.echo(f"disk: {rows} of rows, up to {products} of products")
    if estimated.inputs_bytes:
        limit = size_text(estimated.cache_limit_bytes)
        typer.echo(f"  {size_text(estimated.inputs_bytes)} of terrains in the cache, which keeps at most {limit}")


def print_limits(campaign: Campaign) -> None:
    """Print why the campaign's requirements cannot be PASS, and the remedy."""
    for limit in evidence_limits(campaign):
        typer.echo(f"note: {limit}")


def run_until_decided(campaign: Campaign, directory: Path, executor: ExecutorConfig, watch: Watch) -> None:
    """Run a campaign of at most its number of cases; see `marsyard.reports.statistics.sequential`.

    Raises CampaignError for dependent draws, or without a requirement to decide; and as `run_campaign`.
    """
    configuration = campaign.configuration
    how = sampled(configuration.model_dump(mode="json"))
    if not how.independent:
        raise CampaignError(f"--until-decided: {how.no_probability}")
    if all(asked.decide_by == ESTIMATE for asked in configuration.requirements):
        raise CampaignError("--until-decided: the campaign has no requirement that is decided at a confidence")
    limit = configuration.total_cases
    first = configuration.model_copy(
        update={"cases": planned_looks(limit)[0].cases, "appended": (), "max_cases": limit}
    )
    command = (*campaign.command, "--until-decided")
    run_campaign(Campaign(first, campaign.scenario, command), directory, executor, watch)
    continue_until_decided(directory, executor, watch)


def continue_until_decided(directory: Path, executor: ExecutorConfig, watch: Watch) -> None:
    """Add cases to a finished campaign with looks until it is decided."""
    from marsyard.cli.outcome import read_frame  # the reports, which `new` does not need

    while True:
        configuration = record.stored_configuration(directory)
        if configuration.max_cases is None:
            return
        plain = configuration.model_dump(mode="json")
        how, cases = sampled(plain), configuration.total_cases
        look = next_look(judge_campaign(read_frame(directory), plain["requirements"], how), how, cases)
        if look is None:
            watch.note(f"stopped after {cases} of at most {count(configuration.max_cases, 'case')}")
            return
        append_cases(directory, look - cases, executor, watch)
