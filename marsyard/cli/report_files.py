"""Report and rows of a campaign as PDF and CSV."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from marsyard.campaigns.errors import CampaignError, report_write_errors
from marsyard.campaigns.store.table import TABLE_FILE
from marsyard.campaigns.store.temporary_files import replace_file

#: Browsers that can print pages, in order of preference, and the time limit of printing.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINT_TIMEOUT_S = 600.0


def write_csv(directory: Path) -> Path:
    """Write all rows as CSV in batches, atomically."""
    path = directory / "cases.csv"
    with report_write_errors(path), replace_file(path) as partial_path:
        table = pq.ParquetFile(directory / TABLE_FILE)
        with pa_csv.CSVWriter(partial_path, table.schema_arrow) as writer:
            for batch in table.iter_batches():
                writer.write_batch(batch)
    return path


def print_page(directory: Path) -> Path:
    """Print the report page `report.html` to `report.pdf` with a headless browser; return the path of the PDF."""
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise CampaignError(f"--pdf requires a browser; install chromium ({', '.join(_BROWSERS)})")
    target, page = ((directory / name).resolve() for name in ("report.pdf", "report.html"))
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        command += ["--no-pdf-header-footer", f"--print-to-pdf={target}", page.as_uri()]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_PRINT_TIMEOUT_S)  # noqa: S603
        except (subprocess.SubprocessError, OSError) as error:
            raise CampaignError(f"{browser} failed to print {target}: {error}") from error
    return target
