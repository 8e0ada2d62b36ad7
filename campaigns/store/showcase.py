"""Cases that a report shows: the showcase, and those with the largest errors."""

from pathlib import Path

import numpy as np

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.rows import RowStore
from marsyard.sim.files import report_damage


def find_showcase(definition: CampaignDefinition, table: Path, store: RowStore) -> int | None:
    """Select the case that the report shows; None if the campaign requests none, or no case is finished."""
    if definition.retain.showcase == "none":
        return None
    worst = find_worst_cases(definition, table, 1) if definition.retain.showcase == "worst" else []
    return worst[0] if worst else store.find_first_finished_case()


def find_worst_cases(definition: CampaignDefinition, table: Path, number: int) -> list[int]:
    """List the answered cases with the largest metric of the first requirement with a single column, worst first."""
    # metrics that are sums of columns are computation times, which are not suitable to rank cases
    ranking = (item for item in definition.requirements if item.bound is not None and len(item.metric_columns) == 1)
    metric = next((item.metric for item in ranking), None)
    if metric is None:
        return []
    import pyarrow.parquet as pq

    with report_damage(table, StoreError, "not a table of cases"):
        rows = pq.read_table(table, columns=["case", "answered", metric])
    magnitudes = np.abs(np.asarray(rows[metric].to_numpy(), dtype=np.float64))
    magnitudes = np.where(np.asarray(rows["answered"].to_numpy(), dtype=np.bool_), magnitudes, np.nan)
    order = np.argsort(-magnitudes, kind="stable")[:number]
    return [int(rows["case"][int(index)].as_py()) for index in order if not np.isnan(magnitudes[index])]
