"""Signature of a report: it shows that this user's installation wrote it from the present rows of a campaign."""

import hmac
from functools import cache
from pathlib import Path

from marsyard.campaigns.definition.identity import hash_sources
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.key import sign
from marsyard.campaigns.store.temporary_files import write_atomic
from marsyard.reports.report_file import PAGE_FILE, REPORT_JSON
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE

#: Hash of page and data with the key of the user who wrote them; others' reports are written again for the dashboard.
SIGNATURE_FILE = "report.signature"
_REPORTS_FOLDER = Path(__file__).parent


def sign_report(directory: Path, campaign: Path) -> None:
    """Record that this user's installation wrote the report in a folder from the present rows of a campaign's folder.

    Raises StoreError if the key of the user cannot be read.
    """
    write_atomic(directory / SIGNATURE_FILE, _compute_signature(directory, campaign))


def is_own_report(directory: Path, campaign: Path) -> bool:
    """Whether this user's installation wrote the report in a folder from the present rows of a campaign's folder."""
    try:
        signature = (directory / SIGNATURE_FILE).read_bytes()
        return hmac.compare_digest(signature, _compute_signature(directory, campaign).encode())
    except (OSError, StoreError, RuntimeError):
        return False


def _compute_signature(directory: Path, campaign: Path) -> str:
    """Sign page and data of a report, the program that computes verdicts and pages, and the record and rows."""
    files = (directory / PAGE_FILE, directory / REPORT_JSON, campaign / RECORD_FILE, campaign / TABLE_FILE)
    return sign(hash_program().encode(), *(path.read_bytes() if path.is_file() else b"" for path in files))


@cache
def hash_program() -> str:
    """Compute the hash of the program that writes reports and packages: all files of `reports`, also its evidence."""
    files = sorted(path for path in _REPORTS_FOLDER.rglob("*") if path.is_file() and path.suffix != ".pyc")
    return hash_sources((path.relative_to(_REPORTS_FOLDER).as_posix(), path) for path in files)
