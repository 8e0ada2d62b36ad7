"""Run cases again whose images the report's gallery shows."""

from pathlib import Path

import typer

from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.running.replay import replay_in_executor
from marsyard.campaigns.running.stored_campaign import load_stored_campaign
from marsyard.campaigns.store.packed_products import save_packed
from marsyard.campaigns.store.products import case_directory
from marsyard.campaigns.store.record import stored_definition
from marsyard.campaigns.store.table import stored_row
from marsyard.reports.gallery import gallery_candidates
from marsyard.reports.stored import read_run


def rerun_gallery_cases(directory: Path) -> None:
    """Rerun the candidates of the gallery without stored products and store their products; report rows that differ.

    Raises CampaignError if the campaign's scenario or an algorithm cannot be imported.
    """
    run = read_run(directory)
    missing = [case for case in gallery_candidates(run) if case not in run.stored_cases]
    if not missing:
        return
    definition = stored_definition(directory)
    load_stored_campaign(directory, definition)
    with LocalExecutor(1) as workers:
        for case in missing:
            rerun = replay_in_executor(workers, definition, case, stored_row(directory, case))
            if rerun.products is None or rerun.failed:
                typer.echo(f"case {case}: rerun, but no images were produced")
                continue
            save_packed(case_directory(directory, case), rerun.products, rerun.row)
            differences = f"; the new row differs in: {', '.join(rerun.differing)}" if rerun.differing else ""
            typer.echo(f"case {case}: rerun for its images{differences}")
