"""Selection of the cases whose products are stored: by their rows, and the cases that a report shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Requirement
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.rows import RowStore
from marsyard.sim.files import report_damage


@dataclass(frozen=True)
class ProductSelection:
    """Selection of the cases whose products are stored.

    - every: step between the numbers of selected cases; 0 to select none by number
    - requirements: a case that fails any of these requirements is selected
    - timelines: whether the products contain the timeline of the case (`marsyard.scenarios.timeline`)
    """

    every: int = 0
    requirements: tuple[Requirement, ...] = ()
    timelines: bool = False

    def selects(self, row: Mapping[str, Any]) -> bool:
        """Whether the case with this row is selected."""
        if self.every and row["case"] % self.every == 0:
            return True
        return any(compute_margin(row, requirement) < 0.0 for requirement in self.requirements)


#: Products of every case, without and with the timeline.
ALL_PRODUCTS = ProductSelection(every=1)
REPLAYED_PRODUCTS = ProductSelection(every=1, timelines=True)


def create_product_selection(definition: CampaignDefinition) -> ProductSelection:
    """Create the selection for a campaign's first run of its cases; the worst cases run again at the end."""
    retain = definition.retain
    if retain.products == "all":
        return ALL_PRODUCTS
    if retain.products == "every":
        return ProductSelection(every=retain.every)
    if retain.products == "failed":
        return ProductSelection(requirements=definition.requirements)
    return ProductSelection()


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
