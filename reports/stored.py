"""Read a campaign's folder: rows, record, and products of kept cases."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from marsyard.campaigns.definition.configuration import stored_columns_now, stored_configuration_now
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.products import load_products
from marsyard.reports.wording import axis_columns, driver_columns, primary_metric

#: Maximum number of cases of which all columns are read; of more cases, all columns of the first ones are read.
LARGEST_WHOLE, FIRST_CASES = 50_000, 20_000

TABLE_FILE = "cases.parquet"
RECORD_FILE = "campaign.json"


@dataclass(frozen=True)
class StoredRun:
    """Contents of a campaign's folder.

    frame: rows in the order of the cases; of very many, the first ones
    whole: all cases; of very many, only the columns of verdicts, outcomes and errors
    record: `campaign.json`; empty if it cannot be read
    showcases: kept cases, the one chosen for the report first
    """

    directory: Path
    frame: pd.DataFrame
    whole: pd.DataFrame
    record: Mapping[str, Any]
    showcases: tuple[int, ...]

    @property
    def sampled_from(self) -> int | None:
        """Number of all cases if `frame` holds only the first ones; else None."""
        return len(self.whole) if len(self.whole) > len(self.frame) else None

    @property
    def configuration(self) -> Mapping[str, Any]:
        """The configuration as run."""
        return table(self.record.get("configuration"))

    @property
    def name(self) -> str:
        """The campaign's name; the folder's if the record has none."""
        return str(self.recorded("name") or self.directory.resolve().name)

    @property
    def requirements(self) -> list[Mapping[str, Any]]:
        """The requirements of the campaign."""
        stored_requirements = self.recorded("requirements")
        return (
            [item for item in stored_requirements if isinstance(item, Mapping)]
            if isinstance(stored_requirements, list | tuple)
            else []
        )

    @property
    def command(self) -> tuple[str, tuple[str, ...]] | None:
        """Working folder and words of the command that ran the campaign; None if unknown."""
        stored = table(self.record.get("command"))
        words = stored.get("words")
        if not isinstance(words, list) or not words:
            return None
        return str(stored.get("folder") or ""), tuple(str(word) for word in words)

    def recorded(self, key: str) -> Any:
        """Value of a key in the record or in its configuration; None if missing."""
        value = self.record.get(key)
        return value if value is not None else self.configuration.get(key)

    def parameter(self, *path: str) -> Any:
        """A parameter of the campaign's file; None if missing."""
        value: Any = self.configuration.get("parameters")
        for name in path:
            value = table(value).get(name)
        return value

    def products(self, case: int) -> dict[str, Any]:
        """The products of a kept case; empty if they cannot be read."""
        try:
            return load_products(self.directory / "cases" / str(case))
        except (StoreError, AttributeError, TypeError):
            return {}


def read_run(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> StoredRun:
    """Read a campaign's folder; `requirements` replace the campaign's own. Raises StoreError without rows."""
    path = directory / TABLE_FILE
    if not path.is_file():
        raise StoreError(f"{directory} holds no {TABLE_FILE}; a report needs the rows of a campaign")
    try:
        record = dict(table(json.loads((directory / RECORD_FILE).read_text(encoding="utf-8"))))
    except (OSError, ValueError):
        record = {}
    configuration = table(record.get("configuration"))
    record["configuration"] = configuration = stored_configuration_now(configuration) if configuration else {}
    record["requirements"] = configuration.get("requirements", record.get("requirements"))
    if requirements is not None:
        record["requirements"] = list(requirements)
    try:
        frame, total = _frames(path, record)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from error
    try:
        names = [entry.name for entry in (directory / "cases").iterdir() if (entry / "products.json").is_file()]
    except OSError:
        names = []
    kept = sorted(int(name) for name in names if name.isascii() and name.isdigit())
    kept.sort(key=lambda case: case != record.get("showcase"))
    return StoredRun(directory, frame, total, record, tuple(kept))


def _frames(path: Path, record: Mapping[str, Any]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows with all columns, and rows of all cases; the same unless there are very many."""
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    stored = file.schema_arrow.names
    renamed = stored_columns_now(stored, str(table(record.get("configuration")).get("scenario")))
    if file.metadata.num_rows <= LARGEST_WHOLE:
        frame = _sort_columns(pd.read_parquet(path).rename(columns=renamed))
        return frame, frame
    first = next(file.iter_batches(batch_size=FIRST_CASES)).to_pandas().rename(columns=renamed)
    asked, names = record.get("requirements"), [renamed.get(name, name) for name in stored]
    requirements = [one for one in asked if isinstance(one, Mapping)] if isinstance(asked, list) else []
    wanted = {"case", "outcome", "answered", "terrain", "feasible_overlap", "error", "traceback"}
    for one in requirements:
        wanted.update(str(one.get("metric", "")).split(" + "), str(one.get("population", "")).split(" and "))
    metric = primary_metric(first, requirements)
    if metric is not None:
        wanted.update([metric, *axis_columns(metric, names), *driver_columns(first, metric, max_columns=3)])
    whole = pd.read_parquet(path, columns=[name for name in stored if renamed.get(name, name) in wanted])
    return _sort_columns(first), _sort_columns(whole.rename(columns=renamed))


def _sort_columns(frame: pd.DataFrame) -> pd.DataFrame:
    if "case" not in frame or frame["case"].is_monotonic_increasing:
        return frame
    return frame.sort_values("case", kind="stable").reset_index(drop=True)


def table(value: object) -> Mapping[str, Any]:
    """The value if it is a table, else an empty table."""
    return value if isinstance(value, Mapping) else {}
