"""Folder of a new campaign."""

from pathlib import Path

from marsyard.campaigns.errors import StoreError, report_write_errors
from marsyard.campaigns.store.record import RECORD_FILE
from marsyard.campaigns.store.rows import ROWS_FILE, is_empty_store

#: Files of a campaign; a folder that contains any of them is never used for another campaign.
_CAMPAIGN_FILES = (RECORD_FILE, "cases.parquet", ROWS_FILE, "report.html", "report.json", "cases")


def claim_folder(directory: Path) -> None:
    """Create the folder of a new campaign; the folder of a run that was killed before its first record can be reused.

    Raises StoreError if the folder contains a campaign or is not writable.
    """
    with report_write_errors(directory):
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise StoreError(f"{directory} is not a folder; choose another folder with --out") from error
        campaign_files = [name for name in _CAMPAIGN_FILES if (directory / name).exists()]
        if campaign_files and (campaign_files != [ROWS_FILE] or not is_empty_store(directory / ROWS_FILE)):
            raise StoreError(f"{directory} contains a campaign ({campaign_files[0]}); choose another folder with --out")
