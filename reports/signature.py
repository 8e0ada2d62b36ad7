"""Signature of a report: it shows that this user's installation wrote it from the present rows of a campaign."""

import hmac
from pathlib import Path

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.key import sign
from marsyard.campaigns.store.temporary_files import write_atomic
from marsyard.reports import explorer
from marsyard.reports.report_file import PAGE_FILE, REPORT_JSON
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE

#: Layout of a page, and the names of its elements, which the dashboard depends on.
_LAYOUT_FILES = tuple(
    Path(__file__).parent / name
    for name in ("templates/report.html.j2", "templates/parts.html.j2", "page_environment.py")
)
#: Hash of page and data with the key of the user who wrote them; others' reports are written again for the dashboard.
SIGNATURE_FILE = "report.signature"


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
    """Sign page and data of a report, the script and the layout of this version's pages, and the record and rows."""
    files = (directory / PAGE_FILE, directory / REPORT_JSON, campaign / RECORD_FILE, campaign / TABLE_FILE)
    contents = [explorer.read_script().encode(), *map(Path.read_bytes, _LAYOUT_FILES)]
    return sign(*contents, *(path.read_bytes() if path.is_file() else b"" for path in files))
