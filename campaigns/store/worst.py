"""Which cases of a table came out worst, by the metric of the first requirement that bounds a single column."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.store.rows import RowStore


def showcase_case(configuration: CampaignConfiguration, table: Path, store: RowStore) -> int | None:
    """The case whose products are kept for the report; None where none is asked for or fit to be shown."""
    if configuration.retain.showcase == "none":
        return None
    worst = _ranked(configuration, table, 1) if configuration.retain.showcase == "worst" else []
    return worst[0] if worst else store.first_completed()


def worst_cases(configuration: CampaignConfiguration, table: Path) -> list[int]:
    """The answered cases with the largest metrics, as many as `retain.worst` asks for, the worst first."""
    return _ranked(configuration, table, configuration.retain.worst)


def _ranked(configuration: CampaignConfiguration, table: Path, number: int) -> list[int]:
    """The first so many answered cases by the size of their metric, the largest first; those without one are left."""
    # a sum of columns is one of times, by which no case is worse than another
    single = (one for one in configuration.requirements if one.bound is not None and len(one.metric_columns) == 1)
    metric = next((asked.metric for asked in single), None)
    if metric is None:
        return []
    rows = _columns(table, ["case", "answered", metric])
    sizes = np.abs(np.asarray(rows[metric].to_numpy(), dtype=np.float64))
    sizes = np.where(np.asarray(rows["answered"].to_numpy(), dtype=np.bool_), sizes, np.nan)
    order = np.argsort(-sizes, kind="stable")[:number]
    return [int(rows["case"][int(place)].as_py()) for place in order if not np.isnan(sizes[place])]


def _columns(table: Path, names: list[str]) -> Any:
    import pyarrow.parquet as pq

    return pq.read_table(table, columns=names)
