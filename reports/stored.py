"""Reader of a campaign's folder for reports: rows, record, and products of stored cases."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.origin import check_rows
from marsyard.campaigns.store.products import load_products
from marsyard.campaigns.store.record import reject_links
from marsyard.campaigns.store.table import check_table
from marsyard.reports.column_selection import axis_columns, driver_columns, looks_like_condition, primary_metric
from marsyard.scenarios.columns import Columns
from marsyard.scenarios.declared_columns import enabling_columns, row_columns
from marsyard.sim.files import report_damage

#: Maximum number of cases of which all columns are read. In a larger campaign, all columns are read only for the first
#: `FIRST_CASES` rows.
MAX_FULL_CASES, FIRST_CASES = 50_000, 20_000

TABLE_FILE = "cases.parquet"
RECORD_FILE = "campaign.json"


@dataclass(frozen=True)
class StoredRun:
    """Contents of a campaign's folder.

    - frame: rows with all columns, sorted by case; only the first `FIRST_CASES` rows if the campaign has more than
      `MAX_FULL_CASES` cases
    - all_cases: rows of all cases; only the columns of verdicts, margins, outcomes, errors and axes of figures if the
      campaign has more than `MAX_FULL_CASES` cases
    - record: contents of `campaign.json`; empty if the file cannot be read
    - stored_cases: numbers of the cases with stored products: first the case that the report shows, then the others in
      increasing order
    - unverified: reason why the rows have no chain of hashes; empty if they were verified
    """

    directory: Path
    frame: pd.DataFrame
    all_cases: pd.DataFrame
    record: Mapping[str, Any]
    stored_cases: tuple[int, ...]
    unverified: str = ""

    @property
    def shown_case(self) -> int | None:
        """The case that the report shows: the recorded one if it is stored, otherwise the first stored case, if any."""
        return self.stored_cases[0] if self.stored_cases else None

    @property
    def is_truncated(self) -> bool:
        """Whether `frame` contains only the first cases."""
        return len(self.all_cases) > len(self.frame)

    @property
    def definition(self) -> Mapping[str, Any]:
        """The definition with which the campaign was run."""
        return table(self.record.get("definition"))

    @property
    def name(self) -> str:
        """Name of the campaign, or of its folder if the record contains no name."""
        return str(self.recorded("name") or self.directory.resolve().name)

    @property
    def requirements(self) -> list[Mapping[str, Any]]:
        """The requirements of the campaign."""
        stored = self.recorded("requirements")
        return [item for item in stored if isinstance(item, Mapping)] if isinstance(stored, list | tuple) else []

    @property
    def dispersed_paths(self) -> tuple[str, ...]:
        """Paths of the dispersed parameters, whose sampled values are columns of the rows."""
        return tuple(str(path) for path in table(self.recorded("dispersions")))

    def is_condition(self, name: str) -> bool:
        """Return whether a column is a sampled value, or a condition that the scenario declares.

        A scenario without declared columns has the conditions that their names suggest.
        """
        if any(name == path or name.startswith(f"{path}.") for path in self.dispersed_paths):
            return True
        columns = read_columns(str(self.recorded("scenario") or ""))
        return looks_like_condition(name) if columns is None else columns.is_condition(name)

    def driver_columns(self, metric: str, max_columns: int = 6) -> list[str]:
        """Select conditions that may affect a metric; see `marsyard.reports.column_selection.driver_columns`."""
        return driver_columns(self.frame, metric, max_columns, self.is_condition)

    @property
    def command(self) -> tuple[str, tuple[str, ...]] | None:
        """Working folder and words of the command that ran the campaign; None if unknown."""
        stored_command = table(self.record.get("command"))
        words = stored_command.get("words")
        if not isinstance(words, list) or not words:
            return None
        return str(stored_command.get("folder") or ""), tuple(str(word) for word in words)

    def recorded(self, key: str) -> Any:
        """Return the value of a key in the record or in its definition; None if missing."""
        value = self.record.get(key)
        return value if value is not None else self.definition.get(key)

    def parameter(self, *path: str) -> Any:
        """Return a parameter of the campaign's file; None if missing."""
        value: Any = self.definition.get("parameters")
        for name in path:
            value = table(value).get(name)
        return value

    def products(self, case: int) -> dict[str, Any]:
        """Read the products of a case; empty if they cannot be read."""
        try:
            return load_products(self.directory / "cases" / str(case))
        except (StoreError, AttributeError, TypeError):
            return {}


def read_run(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> StoredRun:
    """Read a campaign's folder, and verify its rows; `requirements` replace the campaign's requirements.

    Raises StoreError without rows, if rows were changed after they were stored, or if the folder contains a symbolic
    link.
    """
    path = directory / TABLE_FILE
    if not path.is_file():
        raise StoreError(f"{directory} contains no {TABLE_FILE}; a report needs the rows of a campaign")
    reject_links(directory)
    unverified = check_rows(directory)
    if not unverified:
        check_table(directory)
    try:
        record = dict(table(json.loads((directory / RECORD_FILE).read_text(encoding="utf-8"))))
    except (OSError, ValueError):
        record = {}
    definition = table(record.get("definition"))
    record["definition"] = definition
    record["requirements"] = definition.get("requirements", record.get("requirements"))
    if requirements is not None:
        record["requirements"] = list(requirements)
    try:
        case_folders = [entry.name for entry in (directory / "cases").iterdir() if (entry / "products.json").is_file()]
    except OSError:
        case_folders = []
    stored_cases = sorted(int(name) for name in case_folders if name.isascii() and name.isdigit())
    stored_cases.sort(key=lambda case: case != record.get("showcase"))
    empty = StoredRun(directory, pd.DataFrame(), pd.DataFrame(), record, tuple(stored_cases), unverified)
    with report_damage(path, StoreError, "cannot be read"):
        return _read_rows(path, empty)


def read_cases(directory: Path, cases: Sequence[int]) -> dict[int, dict[str, str]]:
    """Read the rows of some cases of a campaign's folder as texts, by case; cases without a row are missing."""
    import pyarrow.parquet as pq

    with report_damage(directory / TABLE_FILE, StoreError, "cannot be read"):
        has_cases = bool(cases) and "case" in pq.read_schema(directory / TABLE_FILE).names
        rows = pq.read_table(directory / TABLE_FILE, filters=[("case", "in", cases)]).to_pylist() if has_cases else []
    return {row["case"]: {name: str(value) for name, value in row.items()} for row in rows}


def _read_rows(path: Path, run: StoredRun) -> StoredRun:
    """Add the rows to a run; `frame` and `all_cases` are one table if there are at most `MAX_FULL_CASES` cases."""
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    stored_names = file.schema_arrow.names
    if file.metadata.num_rows <= MAX_FULL_CASES:
        frame = _sort_rows(pd.read_parquet(path))
        return replace(run, frame=frame, all_cases=frame)
    first_rows = next(file.iter_batches(batch_size=FIRST_CASES)).to_pandas()
    run = replace(run, frame=first_rows)
    # columns of all cases that verdicts, outcomes and figures use
    columns = {"case", "outcome", "answered", "terrain", "case_attempts", "error", "traceback"}
    columns.update(column.name for column in enabling_columns(stored_names))
    for requirement in run.requirements:
        columns.update(
            str(requirement.get("metric", "")).split(" + "),
            str(requirement.get("population", "")).split(" and "),
            [str(requirement.get("margin", ""))],
        )
    metric = primary_metric(first_rows, run.requirements)
    if metric is not None:
        columns.update([metric, *axis_columns(metric, stored_names), *run.driver_columns(metric, max_columns=3)])
    all_cases = pd.read_parquet(path, columns=[name for name in stored_names if name in columns])
    return replace(run, frame=_sort_rows(first_rows), all_cases=_sort_rows(all_cases))


def read_columns(scenario: str) -> Columns | None:
    """Return the columns of a scenario; None if they are unknown, or invalid in another package."""
    try:
        return row_columns(scenario)
    except ValueError:
        return None


def _sort_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """Sort rows by case number."""
    if "case" not in frame or frame["case"].is_monotonic_increasing:
        return frame
    return frame.sort_values("case", kind="stable").reset_index(drop=True)


def table(value: object) -> Mapping[str, Any]:
    """Return the value if it is a table; otherwise return an empty table."""
    return value if isinstance(value, Mapping) else {}
