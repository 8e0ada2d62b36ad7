"""Folders of synthetic campaigns with the chain of hashes of their rows."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.campaigns.definition.identity import stored_definition_hash
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, create_store
from marsyard.campaigns.store.table import TABLE_FILE, write_table
from tests.reports.synthetic_run import MIN_COLUMNS, VELOCITY, make_rows, synthetic_record


def write_stored_run(directory: Path, cases: int = 240, **changes: Any) -> Path:
    """Write a campaign over Gusev, each case on a terrain of its own; `changes` replace entries of the record."""
    columns = [*MIN_COLUMNS, "sun_elevation_deg", "altitude_1_m"]
    frame = make_rows(cases, answer_rate=1.0, error_scale=0.5)[columns]
    frame["terrain"], frame["site"] = np.arange(cases), "gusev"
    directory.mkdir(parents=True)
    record = synthetic_record(frame, [{**VELOCITY, "source": "the paper; the rate is assumed"}])
    (directory / "campaign.json").write_text(json.dumps(record | changes))
    create_store(directory / ROWS_FILE, {"identity": stored_definition_hash(record["definition"])})
    with RowStore(directory / ROWS_FILE) as store:
        store.add([{str(name): value for name, value in row.items()} for row in frame.to_dict("records")])
        write_table(directory / TABLE_FILE, store)
    return directory
