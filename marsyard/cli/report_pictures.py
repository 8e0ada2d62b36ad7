"""`marsyard report --gallery`: runs the cases again that a reader wants pictures of, and keeps their products."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def keep_notable_cases(directory: Path, say: Callable[[str], None]) -> None:
    """Runs a campaign's notable cases again, as far as their products are not kept yet, and says what became of them.

    A case whose row does not come out as it is stored is kept all the same, and said.

    Raises CampaignError where the campaign's scenario or an algorithm cannot be imported.
    """
    from marsyard.campaigns.execution.workers import LocalWorkers
    from marsyard.campaigns.running.replay import replay_with
    from marsyard.campaigns.running.stored import loaded_campaign
    from marsyard.campaigns.store.products import save_packed
    from marsyard.campaigns.store.record import stored_configuration
    from marsyard.campaigns.store.retention import case_directory
    from marsyard.campaigns.store.table import stored_row
    from marsyard.reports.cases import notable_cases
    from marsyard.reports.stored import read_run

    run = read_run(directory)
    lacking = [case for case in notable_cases(run) if case not in run.showcases]
    if not lacking:
        return
    configuration = stored_configuration(directory)
    loaded_campaign(directory, configuration)
    with LocalWorkers(1) as workers:
        for case in lacking:
            replayed = replay_with(workers, configuration, case, stored_row(directory, case))
            if replayed.products is None or replayed.failed:
                say(f"case {case}: ran again and left no pictures")
                continue
            save_packed(case_directory(directory, case), replayed.products, replayed.row)
            differs = f", and differs from its row in: {', '.join(replayed.differing)}" if replayed.differing else ""
            say(f"case {case}: ran again for its pictures{differs}")
