"""Reads a campaign's folder; nothing but these files goes into a report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from campaigns.errors import StoreError
from campaigns.store.products import load_products

TABLE_FILE = "cases.parquet"
RECORD_FILE = "campaign.json"


@dataclass(frozen=True)
class StoredRun:
    """What a campaign's folder holds.

    Attributes
    ----------
    directory
        The folder, as it was named.
    frame
        One row a case, in the order of the cases.
    record
        `campaign.json`; empty where there is none or it cannot be read.
    showcases
        Numbers of the cases whose products were kept, the one chosen for the report first.
    """

    directory: Path
    frame: pd.DataFrame
    record: Mapping[str, Any]
    showcases: tuple[int, ...]

    @property
    def configuration(self) -> Mapping[str, Any]:
        """The configuration as run."""
        return table(self.record.get("configuration"))

    @property
    def name(self) -> str:
        """The campaign's name; the folder's where the record has none."""
        return str(self.said("name") or self.directory.resolve().name)

    @property
    def requirements(self) -> list[Mapping[str, Any]]:
        """The requirements that the campaign asks."""
        asked = self.said("requirements")
        return [item for item in asked if isinstance(item, Mapping)] if isinstance(asked, list | tuple) else []

    def said(self, key: str) -> Any:
        """What the record says under a key, or its configuration; None where neither does."""
        found = self.record.get(key)
        return found if found is not None else self.configuration.get(key)

    def products(self, case: int) -> dict[str, Any]:
        """The products of a kept case; empty where they cannot be read."""
        try:
            return load_products(self.directory / "cases" / str(case))
        except (StoreError, AttributeError, TypeError):
            return {}


def read_run(directory: Path) -> StoredRun:
    """Reads a campaign's folder.

    Raises
    ------
    StoreError
        Where it holds no table of cases that can be read.
    """
    path = directory / TABLE_FILE
    if not path.is_file():
        raise StoreError(f"{directory} holds no {TABLE_FILE}; a report needs the rows of a campaign")
    try:
        frame = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from error
    if "case" in frame:
        frame = frame.sort_values("case", kind="stable").reset_index(drop=True)
    record = _record(directory / RECORD_FILE)
    return StoredRun(directory, frame, record, _showcases(directory / "cases", record.get("showcase")))


def table(value: object) -> Mapping[str, Any]:
    """A value if it is a table; an empty one otherwise."""
    return value if isinstance(value, Mapping) else {}


def _record(path: Path) -> Mapping[str, Any]:
    try:
        return table(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _showcases(cases: Path, chosen: object) -> tuple[int, ...]:
    try:
        names: Sequence[str] = [entry.name for entry in cases.iterdir() if (entry / "products.json").is_file()]
    except OSError:
        return ()
    kept = sorted(int(name) for name in names if name.isascii() and name.isdigit())
    return tuple(sorted(kept, key=lambda case: (case != chosen, case)))
