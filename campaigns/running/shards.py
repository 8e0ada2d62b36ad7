"""Shards: parts of a campaign that run on separate machines, and their merging into one campaign.

Shard k of n has a contiguous range of the case numbers. A case depends on the seed and its number only, so the merged
rows equal those of one run.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.identity import Identity
from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors
from marsyard.campaigns.store import record
from marsyard.campaigns.store.origin import check_rows
from marsyard.campaigns.store.products import CASES_FOLDER
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, create_store, readable_store
from marsyard.campaigns.store.temporary_files import create_folder
from marsyard.sim.files import report_damage

#: State of a campaign folder in which all cases of a shard have rows, and its key in the record.
SHARD_STATE, SHARD_KEY = "shard", "shard"
#: Number of rows that are copied in one transaction.
_CHUNK = 1000


@dataclass(frozen=True)
class Shard:
    """Shard `number` (from 1) of `count`."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read a shard such as ``2/4``. Raises CampaignError for any other text."""
        match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
        number, count = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 1 <= number <= count:
            raise CampaignError(f"--shard {text}: expected NUMBER/COUNT with 1 <= NUMBER <= COUNT, such as 2/4")
        return cls(number, count)

    def cases(self, total: int) -> range:
        """Return the case numbers of the shard in a campaign with `total` cases."""
        return range(total * (self.number - 1) // self.count, total * self.number // self.count)

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


def read_shard(stored: dict[str, Any]) -> Shard | None:
    """Return the shard of a record; None if it is that of a complete campaign."""
    text = stored.get(SHARD_KEY)
    return None if text is None else Shard.parse(str(text))


def merge_shards(directories: Sequence[Path], target: Path, *, allow_changed: bool = False) -> None:
    """Create a campaign from the rows and products of all its shards; its table and report are not written yet.

    allow_changed: merge shards whose program or versions changed while they were run; the record lists these changes

    The folder of the campaign appears when it is complete: an interrupted merge leaves nothing that a new one rejects.
    Raises CampaignError, and changes nothing, if a folder is no finished shard, the shards are of different campaigns,
    programs or versions, cases are missing or contained twice, rows were changed after they were stored, or the folder
    of the campaign is not empty or the current folder.
    """
    records = [record.read(directory) for directory in directories]
    first = records[0]
    identity = Identity.read(first["identity"])
    covered: dict[int, Path] = {}
    for directory, stored in zip(directories, records, strict=True):
        shard = read_shard(stored)
        if shard is None:
            raise CampaignError(f"{directory} is no shard: it was run without --shard")
        if stored["state"] != SHARD_STATE:
            raise CampaignError(f"{directory} is not finished ({stored['state']}): marsyard resume {directory}")
        changes = identity.differences(Identity.read(stored["identity"]))
        if stored["definition"] != first["definition"]:
            changes.insert(0, "the definition")
        if changes:
            raise CampaignError(
                f"{directory} and {directories[0]} differ in {', '.join(changes)}: rows cannot be merged"
            )
        if stored["changes"] and not allow_changed:
            raise CampaignError(
                f"{directory} was continued with another program or other versions. To merge it nevertheless, with a "
                "note in the record: --allow-changed"
            )
        for case in shard.cases(stored["cases"]):
            if case in covered:
                raise CampaignError(f"{directory} and {covered[case]} both contain case {case}")
            covered[case] = directory
    missing = sorted(set(range(first["cases"])) - set(covered))
    if missing:
        text = f"{len(missing)} of {first['cases']} cases are missing, the first is case {missing[0]}"
        raise CampaignError(f"{text}: give the folders of all shards")
    if target.resolve() == Path.cwd() or (target.exists() and (not target.is_dir() or any(target.iterdir()))):
        raise StoreError(f"{target} exists and is not an empty folder; choose another folder with --out")
    for directory in directories:
        check_rows(directory)
    with create_folder(target) as folder:
        with readable_store(directories[0] / ROWS_FILE) as store:
            about = store.about
        create_store(folder / ROWS_FILE, about)
        with RowStore(folder / ROWS_FILE) as store:
            for directory in directories:
                _copy_rows(directory, store)
        for directory in directories:
            _copy_products(directory, folder)
        sessions = [session for stored in records for session in stored["sessions"]]
        started = min(stored["started_utc"] for stored in records)
        # like an interrupted run, the campaign lacks its table and report, which `continue_campaign` writes
        updates = {"sessions": sessions, "started_utc": started, "state": "interrupted", "merged": len(directories)}
        updates["changes"] = [change for stored in records for change in stored["changes"]]
        record.write(folder, {**{key: value for key, value in first.items() if key != SHARD_KEY}, **updates})


def _copy_rows(directory: Path, store: RowStore) -> None:
    """Copy all rows of a campaign folder into a store."""
    with (
        report_damage(directory / ROWS_FILE, StoreError, "is damaged"),
        readable_store(directory / ROWS_FILE) as source,
    ):
        columns = source.columns_by_layout()
        for chunk in source.chunks(_CHUNK):
            store.add(dict(zip(columns[layout], values, strict=True)) for layout, values in chunk)


def _copy_products(directory: Path, target: Path) -> None:
    """Copy the products of all cases of a campaign folder."""
    source = directory / CASES_FOLDER
    if not source.is_dir():
        return
    with report_write_errors(target):
        try:
            shutil.copytree(source, target / CASES_FOLDER, dirs_exist_ok=True)
        except shutil.Error as error:
            raise StoreError(f"{source} cannot be copied: {error}") from error
