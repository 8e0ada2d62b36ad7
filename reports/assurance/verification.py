"""Verification of an assurance package: hashes of files, chains of rows and confirmations, verdicts, and argument.

Without a signature, the hashes show accidental changes only: a person who changes a file can also write its new hash.
The other steps then still find rows, records and claims that contradict each other.
"""

import json
import math
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.store.confirmation_record import find_own_entry, read_record
from marsyard.campaigns.store.git_history import UNKNOWN
from marsyard.reports.assurance.case import AssuredRun, build_argument
from marsyard.reports.assurance.package import (
    CONFIRMATIONS,
    MANIFEST,
    SCHEMA,
    hash_files,
    read_run_evidence,
    render_argument,
)
from marsyard.reports.assurance.signature import check_signature, signature_path
from marsyard.reports.campaign_report import build_report, create_subject, format_verdict_files
from marsyard.reports.evaluation import Evaluation, evaluate_run
from marsyard.reports.joint import read_joint_evidence
from marsyard.reports.overall import QUALIFIED_EXIT_CODE, combine_verdicts
from marsyard.reports.report_file import REPORT_JSON, CampaignReport, read_report
from marsyard.reports.signature import hash_program
from marsyard.reports.stored import table
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import count

#: Numbers and texts of a verdict that follow from the requirement, the rows and the record of confirmations.
_NUMBERS = ("bound", "probability", "confidence", "scale", "n", "failures", "estimate", "lower", "upper")
_TEXTS = ("statement", "metric", "population", "decide_by", "source", "kind")
#: Relative difference of equal numbers: rounding errors of another processor.
_TOLERANCE = 1e-9
#: Folders of the author that texts hide (`hide_folders`), and their names in a regular expression.
_HIDDEN_FOLDER, _GROUPS = re.compile(r"(~|\$MARSYARD_CACHE)"), {"~": "home", "$MARSYARD_CACHE": "cache"}
#: Content of `report.json` that is verified by its hash only: data of the page's sections, and cases with images.
_BY_HASH_ONLY = ("sections", "showcases")


@dataclass(frozen=True)
class Verification:
    """Result of a verification: problems, each with the file or claim that it names, and what was verified."""

    problems: tuple[str, ...]
    notes: tuple[str, ...]


def verify_package(folder: Path, signers: Path | None = None) -> Verification:
    """Verify a package. Raises CampaignError if it has no valid manifest, or its layout is of another version.

    signers: file of allowed signers; a signature by another key is then a problem
    """
    manifest = _read_manifest(folder)
    problems = list(_compare_hashes(folder, table(manifest.get("files"))))
    notes = [f"{len(table(manifest.get('files')))} files with their hashes"]
    signature_problems, note = _check_signature(folder, signers)
    problems += signature_problems
    notes.append(note)
    is_same_program = manifest.get("program") == hash_program()
    runs = []
    # a copy, because SQLite writes into the folder of its file even for reading
    with tempfile.TemporaryDirectory(prefix="marsyard-") as name:
        copy = Path(name, "package")
        shutil.copytree(folder, copy, symlinks=True)
        names: Sequence[str] = manifest["runs"]
        if not names:
            problems.append(f"{MANIFEST}: the package contains no campaign")
        for run_name in names:
            try:
                directory = copy / "runs" / run_name
                record = directory / CONFIRMATIONS
                evaluation = evaluate_run(directory, record=record if record.is_file() else None)
                if not is_same_program and read_report((directory / REPORT_JSON).read_bytes()) is None:
                    notes.append(f"runs/{run_name}: verdicts by their hash only; the report has another layout")
                    continue
                run = read_run_evidence(copy, f"runs/{run_name}")
                problems += _verify_run(run, evaluation, directory, is_same_program)
                runs.append(run)
            except (CampaignError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
                problems.append(f"runs/{run_name}: {_relative(error, copy)}")
        if not is_same_program:
            notes.append(f"claims and page by their hashes only; {_describe_program(manifest)}")
        elif len(runs) == len(names):
            problems += _compare_argument(copy, runs)
            notes.append("claims and page, computed again from the evidence")
    notes.append(f"rows and confirmations of {count(len(names), 'campaign')}, verdicts of {len(runs)}")
    return Verification(tuple(dict.fromkeys(problems)), tuple(notes))


def _read_manifest(folder: Path) -> Mapping[str, Any]:
    """Read the manifest; its key `runs` is a list of names of folders in the folder `runs` of the package."""
    try:
        manifest = table(json.loads((folder / MANIFEST).read_text(encoding="utf-8")))
    except OSError as error:
        raise CampaignError(f"{folder} is no assurance package: {MANIFEST} cannot be read") from error
    except (ValueError, RecursionError) as error:
        raise CampaignError(f"{folder / MANIFEST} is damaged: {error}") from error
    if manifest.get("schema") != SCHEMA:
        raise CampaignError(f"{folder / MANIFEST} has schema {manifest.get('schema')}; allowed: {SCHEMA}")
    runs = manifest.get("runs") or []
    if not isinstance(runs, list) or not all(map(_is_folder_name, runs)):
        raise CampaignError(f"{folder / MANIFEST} is damaged: runs is not a list of names of folders")
    return {**manifest, "runs": runs}


def _is_folder_name(name: object) -> bool:
    """Whether a name is that of a folder inside of another one, not a path that leads out of it."""
    return isinstance(name, str) and name not in ("", "..") and Path(name).name == name


def _compare_hashes(folder: Path, stored: Mapping[str, Any]) -> Iterator[str]:
    """Compare the files with their hashes."""
    present = hash_files(folder)
    for name in sorted({*stored, *present}):
        if name not in present:
            yield f"{name}: the file is missing"
        elif name not in stored:
            yield f"{name}: the file is not in {MANIFEST}"
        elif stored[name] != present[name]:
            yield f"{name}: the file was changed after the package was written"


def _check_signature(folder: Path, signers: Path | None) -> tuple[list[str], str]:
    """Check the signature of the manifest; a missing one is a problem only if a signer is required."""
    path = folder / MANIFEST
    if not signature_path(path).is_file():
        problems = [] if signers is None else [f"{signature_path(path).name}: the package is not signed"]
        return problems, "no signature: who wrote the package is unknown"
    is_valid, text = check_signature(path, signers)
    identity = "" if signers is not None else " (to check who signed: --signers FILE)"
    return ([] if is_valid else [f"{signature_path(path).name}: {text}"]), f"signature: {text}{identity}"


def _describe_program(manifest: Mapping[str, Any]) -> str:
    """Describe that another program wrote the package."""
    own = f"marsyard {version('marsyard')} ({hash_program()[:8]})"
    return f"written by marsyard {manifest.get('marsyard')} ({str(manifest.get('program'))[:8]}), this is {own}"


def _verify_run(run: AssuredRun, evaluation: Evaluation, directory: Path, is_same_program: bool) -> Iterator[str]:
    """Verify that record and verdicts agree with the rows, and for the same program all data of the report."""
    record = directory / CONFIRMATIONS
    evidence = run.report.evidence
    for key in ("name", "seed"):
        value, defined = run.record.get(key), run.definition.get(key)
        if value != defined:
            yield f"{run.folder}/campaign.json: {key} is {value!r}, {defined!r} in the definition"
    if run.record.get("cases_finished") != len(evaluation.run.all_cases):
        yield f"{run.folder}/campaign.json: cases_finished is not the number of rows"
    if evidence.is_confirmation and evidence.record:
        entry = find_own_entry(read_record(record), evidence)
        if entry is None:
            yield f"{run.folder}/{CONFIRMATIONS}: the record does not contain confirmation {evidence.number}"
    if len(evaluation.run.all_cases) != run.report.cases:
        yield f"{run.folder}/report.json: {run.report.cases} cases, but {len(evaluation.run.all_cases)} rows"
    stored = {verdict.requirement_id: verdict for verdict in run.report.verdicts}
    computed = {verdict.requirement_id: verdict for verdict in evaluation.verdicts}
    for name in dict.fromkeys((*stored, *computed)):
        if name not in stored or name not in computed:
            yield f"{run.folder}/report.json: the requirement {name} is missing, or not in campaign.json"
        elif difference := _find_difference(stored[name], computed[name]):
            yield f"{run.folder}/report.json: {name} does not follow from the rows: {difference}"
    joint = read_joint_evidence(replace(evaluation.evidence, record=str(record)))
    for name, verdict in stored.items():
        if verdict.status is Status.PASS and joint.has_unpassed_variant(name):
            yield f"{run.folder}/report.json: {name} is PASS in spite of other claims in {CONFIRMATIONS}"
    if is_same_program and stored.keys() == computed.keys():
        yield from _compare_report(run, _adopt_registration(evaluation, run.report), directory)


def _adopt_registration(evaluation: Evaluation, report: CampaignReport) -> Evaluation:
    """Return an evaluation with what a report states about the registration of the record of confirmations.

    It determines the qualification of PASS and some texts, and cannot be verified without the repository.
    """
    statuses = {verdict.requirement_id: verdict.status for verdict in report.verdicts}
    registration = [note for note in report.evidence.notes if note.startswith(UNKNOWN)]
    own_notes = [note for note in evaluation.evidence.notes if not note.startswith(UNKNOWN)]
    evidence = replace(
        evaluation.evidence,
        record=report.evidence.record,
        registration=report.evidence.registration,
        notes=(*registration, *own_notes),
    )
    verdicts = [
        replace(
            verdict,
            status=statuses[verdict.requirement_id],
            reason=verdict.reason.replace(evaluation.evidence.text, evidence.text),
        )
        for verdict in evaluation.verdicts
    ]
    overall = combine_verdicts(verdicts, evaluation.run.all_cases, evaluation.sampling, evidence)
    is_qualified = report.exit_code == QUALIFIED_EXIT_CODE
    return replace(evaluation, evidence=evidence, verdicts=verdicts, overall_verdict=overall, is_qualified=is_qualified)


def _compare_report(run: AssuredRun, evaluation: Evaluation, directory: Path) -> Iterator[str]:
    """Compare the data of a report, and its files for other programs, with those that follow from the rows."""
    for key, value in build_report(evaluation, create_subject(evaluation), ()).to_json().items():
        if key not in _BY_HASH_ONLY and not _is_equal(run.data.get(key), value):
            yield f"{run.folder}/report.json: {key} does not follow from the rows and campaign.json"
    # from the stored numbers, which can differ in their last digits
    stated = replace(evaluation, verdicts=run.report.verdicts)
    for name, text in format_verdict_files(stated).items():
        path = directory / name
        if path.is_file() and not _is_same_text(path.read_text(encoding="utf-8"), text):
            yield f"{run.folder}/{name}: the content does not follow from report.json"


def _find_difference(stored: Verdict, computed: Verdict) -> str:
    """Describe the first number or status that differs; the registration of a record cannot be verified here."""
    for name in _NUMBERS:
        first, second = float(getattr(stored, name)), float(getattr(computed, name))
        if not (math.isclose(first, second, rel_tol=_TOLERANCE) or (math.isnan(first) and math.isnan(second))):
            return f"{name} {first:g}, from the rows {second:g}"
    for name in _TEXTS:
        if getattr(stored, name) != getattr(computed, name):
            return f"{name} '{getattr(stored, name)}', in campaign.json '{getattr(computed, name)}'"
    statuses = [Status.PASS if item.status.is_qualified else item.status for item in (stored, computed)]
    return "" if statuses[0] is statuses[1] else f"{stored.status}, from the rows {computed.status}"


def _is_equal(first: Any, second: Any) -> bool:
    """Compare JSON values; numbers with a tolerance for the rounding errors of another processor."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(_is_equal(first[key], second[key]) for key in first)
    if isinstance(first, list) and isinstance(second, list):
        return len(first) == len(second) and all(map(_is_equal, first, second))
    if isinstance(first, float) and isinstance(second, float):
        return math.isclose(first, second, rel_tol=_TOLERANCE)
    if isinstance(first, str) and isinstance(second, str):
        return _is_same_text(first, second)
    return bool(first == second)


def _is_same_text(first: str, second: str) -> bool:
    """Compare texts, of which one can name a folder that the other one hides."""
    if first == second:
        return True
    return any(re.fullmatch(_create_pattern(a), b) is not None for a, b in ((first, second), (second, first)))


def _create_pattern(text: str) -> str:
    """Create a regular expression for a text with named folders in place of hidden ones, each one folder everywhere."""
    pattern, groups = "", set()
    for part in _HIDDEN_FOLDER.split(text):
        group = _GROUPS.get(part)
        if group is None:
            pattern += re.escape(part)
        else:
            pattern += f"(?P={group})" if group in groups else rf"(?P<{group}>/[^\s\"',;]*)"
            groups.add(group)
    return pattern


def _compare_argument(folder: Path, runs: Sequence[AssuredRun]) -> Iterator[str]:
    """Compare the files that are computed from the evidence, and name the first element that differs."""
    try:
        argument = build_argument(runs, folder)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        yield f"evidence: {_relative(error, folder)}"
        return
    for name, content in render_argument(argument).items():
        path = folder / name
        if path.is_file() and path.read_text(encoding="utf-8") == content:
            continue
        yield f"{name}: {_locate_difference(path, content) or 'the content does not follow from the evidence'}"


def _locate_difference(path: Path, content: str) -> str:
    """Describe the first element of an argument in JSON that differs; empty for other files."""
    if path.suffix != ".json" or not path.is_file():
        return ""
    try:
        stored = table(json.loads(path.read_text(encoding="utf-8"))).get("elements") or []
    except ValueError:
        return "the file is damaged"
    for found, expected in zip(stored, json.loads(content)["elements"], strict=False):
        if found != expected:
            return f"element {expected['id']} does not follow from the evidence: {expected['statement']}"
    return ""


def _relative(error: Exception, folder: Path) -> str:
    """Return the message of an error without the path of the temporary folder."""
    text = str(error) or type(error).__name__
    return text.replace(f"{folder}/", "")
