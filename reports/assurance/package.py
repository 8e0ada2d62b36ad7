"""Assurance package: a folder with the assurance case, its evidence, and the hashes of all files; written and read.

Layout: `index.html`, `case.json`, `case.svg`; `evidence` with the validation rows, the register of fitted constants
and the credibility factors; `runs/NAME` with the record, rows and report of each campaign, and the record of its
confirmations; `manifest.json` with the SHA-256 of every other file.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from markupsafe import Markup

from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.campaigns.store.confirmation_record import read_record
from marsyard.campaigns.store.record import utc_now
from marsyard.campaigns.store.rows import ROWS_FILE, readable_store
from marsyard.campaigns.studies.results import ROBUST_FOLDER
from marsyard.reports.assurance.argument import draw_argument
from marsyard.reports.assurance.case import CREDIBILITY, REGISTER, VALIDATION, AssuranceCase, AssuredRun, build_argument
from marsyard.reports.assurance.signature import signature_path
from marsyard.reports.campaign_report import write_evaluation
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.fits import REGISTER as REGISTER_FILE
from marsyard.reports.page_environment import page_environment
from marsyard.reports.report_file import REPORT_JSON, read_report
from marsyard.reports.signature import SIGNATURE_FILE, hash_program
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE, table
from marsyard.reports.validation_rows import VALIDATION_FILE

#: Files of the package that are computed from its evidence, and the file of the hashes.
PAGE, ARGUMENT, DRAWING, MANIFEST = "index.html", "case.json", "case.svg", "manifest.json"
#: Version of the layout of a package.
SCHEMA = 1
#: Copy of the record of confirmations in the folder of a campaign.
CONFIRMATIONS = "confirmations.jsonl"
_CREDIBILITY_FILE = REGISTER_FILE.with_name("credibility.toml")


def write_package(directories: Sequence[Path], folder: Path) -> AssuranceCase:
    """Write the package of stored campaigns into an existing empty folder.

    Raises CampaignError for a study or an unfinished campaign, StoreError for rows that were changed, and OSError if
    the package cannot be written.
    """
    copies = {VALIDATION: VALIDATION_FILE, REGISTER: REGISTER_FILE, CREDIBILITY: _CREDIBILITY_FILE}
    for name, source in copies.items():
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copyfile(source, folder / name)
    names: list[str] = []
    for directory in directories:
        names.append(_write_run(directory, folder, names))
    argument = build_argument([read_run_evidence(folder, f"runs/{name}") for name in names], folder)
    for name, content in render_argument(argument).items():
        (folder / name).write_text(content, encoding="utf-8")
    manifest = {
        "schema": SCHEMA,
        "marsyard": version("marsyard"),
        "program": hash_program(),
        "written_utc": utc_now(),
        "runs": names,
        "files": hash_files(folder),
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return argument


def _write_run(directory: Path, folder: Path, names: Sequence[str]) -> str:
    """Copy a campaign into the package, with a new report; return the name of its folder."""
    if not (directory / ROWS_FILE).is_file():
        raise StoreError(f"{directory} has no {ROWS_FILE}; an assurance package needs the rows of a campaign")
    evaluation = evaluate_run(directory)
    run = evaluation.run
    if run.recorded("study"):
        raise CampaignError(f"{directory} contains a study: its cases are chosen and give no verdict on a requirement")
    if run.recorded("state") != "finished":
        raise CampaignError(f"{directory} is not finished; to continue: marsyard resume {directory}")
    base = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in run.name)
    name = next(
        text
        for number in range(1, len(names) + 2)
        if (text := base if number == 1 else f"{base}-{number}") not in names
    )
    target = folder / "runs" / name
    _copy_rows(directory, target)
    for study in sorted((directory / ROBUST_FOLDER).glob("*/")):  # those of `marsyard robust`
        if all((study / file).is_file() for file in (RECORD_FILE, TABLE_FILE, ROWS_FILE)):
            _copy_rows(study, target / ROBUST_FOLDER / study.name)
    write_evaluation(evaluation, target)
    (target / SIGNATURE_FILE).unlink(missing_ok=True)  # it is for the dashboard of this user
    if evaluation.evidence.is_confirmation and Path(evaluation.evidence.record).is_file():
        shutil.copyfile(evaluation.evidence.record, target / CONFIRMATIONS)
    return name


def _copy_rows(directory: Path, target: Path) -> None:
    """Copy record and rows of a campaign or of a study into a new folder."""
    target.mkdir(parents=True)
    for file in (RECORD_FILE, TABLE_FILE):
        shutil.copyfile(directory / file, target / file)
    with readable_store(directory / ROWS_FILE) as store:
        store.copy(target / ROWS_FILE)


def read_run_evidence(folder: Path, name: str) -> AssuredRun:
    """Read a campaign of a package. Raises StoreError if a file is missing or damaged."""
    directory = folder / name
    try:
        text = (directory / REPORT_JSON).read_text(encoding="utf-8")
        record = dict(table(json.loads((directory / RECORD_FILE).read_text(encoding="utf-8"))))
        data = table(json.loads(text))
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(f"{directory} cannot be read: {error}") from error
    report = read_report(text)
    if report is None:
        raise StoreError(f"{directory / REPORT_JSON} is damaged, or of another version")
    with readable_store(directory / ROWS_FILE) as store:
        head = store.head
    confirmations = read_record(directory / CONFIRMATIONS)
    entries = confirmations.of_claim(report.evidence.claim) if report.evidence.claim else []
    record_head = confirmations.head if entries else ""
    return AssuredRun(name, report, data, record, head, entries, record_head)


def render_argument(argument: AssuranceCase) -> Mapping[str, str]:
    """Render the files that are computed from the evidence: the argument as JSON, its drawing, and the page."""
    drawing = draw_argument(argument.root)
    content = hide_folders(json.dumps(argument.to_json(), indent=1, ensure_ascii=False)) + "\n"
    # the drawing escapes all texts
    context = {"argument": argument, "drawing": Markup(drawing), "verify": "marsyard assure --verify FOLDER"}  # noqa: S704
    page = page_environment().get_template("assurance.html.j2").render(context)
    return {ARGUMENT: content, DRAWING: hide_folders(drawing), PAGE: hide_folders(page)}


def hash_files(folder: Path) -> dict[str, str]:
    """Compute the SHA-256 of all files of a package except the manifest and its signature, by relative path."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() or path.is_symlink())
    names = {path.relative_to(folder).as_posix(): path for path in paths}
    signed = (MANIFEST, signature_path(Path(MANIFEST)).name)
    return {name: _hash(path) for name, path in names.items() if name not in signed}


def _hash(path: Path) -> str:
    """Compute the SHA-256 of a file; a symbolic link, which a package never contains, has none."""
    if path.is_symlink():
        return "symbolic link"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
