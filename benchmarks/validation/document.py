"""Store the measurements as JSON, and write docs/validation.md and the packaged rows from the measurements.

The packaged rows (`marsyard.reports.validation_rows`) also contain the conditions of each row.
"""

import json
import os
import platform
import subprocess
from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from fnmatch import fnmatchcase
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import renderer
from marsyard.reports.fits import fitted_data
from marsyard.reports.validation_rows import (
    VALIDATION_FILE,
    Conditions,
    RowKind,
    ValidationCheck,
    ValidationRow,
    to_json,
)
from marsyard.sim.kernel_cache import processor_features

ROOT = Path(__file__).parents[2]
TEMPLATE = Path(__file__).parent / "template.md"
DOCUMENT = ROOT / "docs" / "validation.md"
RESULTS = ROOT / "benchmarks" / "results" / "validation.json"
#: Sources of the measurements, as patterns of git.
_SOURCES = (
    *("sim", "algorithms", "scenarios", "campaigns", "reports", "benchmarks/validation"),
    ":(exclude)reports/validation.json",
)
#: Packages whose versions a measurement can depend on.
PACKAGES = ("marsyard", "numpy", "scipy", "numba", "pyrender2", "trimesh")


def format_number(value: float) -> str:
    """Format a number with two significant digits."""
    return f"{value:.2g}"


def format_value(measure: Measure, value: float) -> str:
    """Format a value with its unit; fractions with a lower limit are formatted in per cent.

    The units "" (fraction) and "1" (other number without a unit) are explained in `Measure`.
    """
    if measure.unit == "1":
        return f"{value:.3g}"
    if measure.sense == "at least":
        return f"{100.0 * value:.2f} %"
    return f"{format_number(value)} {measure.unit}".strip()


def store(results: dict[str, list[Measure]], quick: bool) -> dict[str, dict]:
    """Add the measurements of these checks to the stored measurements, and return all."""
    stored = read_stored() if RESULTS.exists() else {}
    environment = _read_environment(quick)
    for name, measures in results.items():
        stored[name] = {"environment": environment, "measures": [asdict(measure) for measure in measures]}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps({"checks": {name: stored[name] for name in sorted(stored)}}, indent=1) + "\n")
    return stored


def _read_environment(quick: bool) -> dict[str, str]:
    """Return sources, machine, OpenGL library, package versions and number of samples of the measurements."""
    return {
        "sources": _describe_sources(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {processor_features()}",
        "gl": renderer().description(),
        "versions": ", ".join(f"{name} {version(name)}" for name in PACKAGES),
        "samples": "few (--quick)" if quick else "all",
    }


def _describe_sources() -> str:
    """Return the last commit that changed a source of the measurements, and whether there are uncommitted changes."""
    git = partial(subprocess.run, cwd=ROOT, capture_output=True, text=True, check=True)
    commit = git(["git", "log", "-1", "--format=%h", "--abbrev=8", "--", *_SOURCES]).stdout.strip()
    changed = git(["git", "status", "--porcelain", "-uno", "--", *_SOURCES]).stdout
    return f"commit {commit}{' with changes' * bool(changed)}"


def read_stored() -> dict[str, dict]:
    """Read the stored measurements by check."""
    stored: dict[str, dict] = json.loads(RESULTS.read_text())["checks"]
    return stored


def create_rows(checks: Sequence[Check], stored: dict[str, dict]) -> dict[str, ValidationCheck]:
    """Combine the stored measurements with the conditions of their checks, in the order of the checks."""
    return {
        check.name: ValidationCheck(
            check.section,
            stored[check.name]["environment"],
            tuple(
                _create_row(row, find_conditions(check.conditions, row["claim"]))
                for row in stored[check.name]["measures"]
            ),
        )
        for check in checks
        if check.name in stored
    }


def _create_row(row: dict[str, Any], conditions: Conditions) -> ValidationRow:
    """Combine a stored measurement with its conditions."""
    numbers = {name: None if row[name] is None else float(row[name]) for name in ("measured", "limit")}
    return ValidationRow(**row | numbers, conditions=conditions, kind=kind_of(conditions.data))


def kind_of(data: str) -> RowKind:
    """Return the kind of a comparison with these data; empty for an independent calculation."""
    if not data:
        return RowKind.VERIFICATION
    return RowKind.FIT if data in fitted_data() else RowKind.VALIDATION


def find_conditions(conditions: Collection[Conditions], claim: str) -> Conditions:
    """Return the first conditions whose pattern matches a claim; conditions without quantities if there are none."""
    found = next((item for item in conditions if fnmatchcase(claim, item.rows)), Conditions())
    return replace(found, rows="*")


def write_pages(checks: Sequence[Check], stored: dict[str, dict]) -> None:
    """Write page and packaged rows in the order of the checks, so that only values differ between runs."""
    text, rows = TEMPLATE.read_text(), create_rows(checks, stored)
    VALIDATION_FILE.write_bytes(to_json(rows))
    sections: dict[str, list[ValidationRow]] = {}
    method_columns = {check.section: check.method_columns for check in checks}
    for check in checks:
        sections.setdefault(check.section, []).extend(rows[check.name].rows if check.name in rows else ())
    for section, section_rows in sections.items():
        text = text.replace("{" + section + "}", _format_table(section_rows, method_columns[section]))
    text = text.replace("{environment}", _describe_environments(checks, stored))
    DOCUMENT.write_text(text)


def _format_table(rows: Sequence[ValidationRow], method_columns: Sequence[str]) -> str:
    """Format rows as a table; kind and conditions are columns if a row has them."""
    if not rows:
        return "Not measured yet."
    has_kinds = any(row.kind is not RowKind.VERIFICATION for row in rows)
    has_conditions = any(row.conditions.quantities for row in rows)
    extra = (*(["kind"] if has_kinds else []), *(["checked with"] if has_conditions else []))
    columns = ("property", "limit", "measured", "", *extra, *method_columns)
    lines = [f"| {' | '.join(columns)} |".replace("|  |", "| |"), "|---" * len(columns) + "|"]
    for row in rows:
        cells = [*([row.kind.value] if has_kinds else []), *([row.conditions.text] if has_conditions else [])]
        lines.append(_format_row(row, cells))
    return "\n".join(lines)


def _format_row(row: ValidationRow, cells: Sequence[str]) -> str:
    """Format a row of the table, with further cells before its method."""
    measure = Measure(row.claim, row.measured, row.unit, row.limit, row.how, row.sense)
    verdict = {None: "", True: "met", False: "**missed**"}[row.is_met]
    limit = "reported" if row.limit is None else f"{row.sense} {format_value(measure, row.limit)}"
    return f"| {' | '.join((row.claim, limit, format_value(measure, row.measured), verdict, *cells, row.how))} |"


def _describe_environments(checks: Sequence[Check], stored: dict[str, dict]) -> str:
    """Describe machine and versions: the most frequent values, then exceptions with the names of their checks."""
    environments = {check.name: stored[check.name]["environment"] for check in checks if check.name in stored}
    if not environments:
        return "Nothing has been measured yet."
    labels = {"sources": "", "machine": "", "gl": "OpenGL ", "versions": "", "samples": "samples: "}
    common_values, exceptions = [], []
    for key, label in labels.items():
        groups: dict[str, list[str]] = {}
        for name, environment in environments.items():
            groups.setdefault(environment.get(key, f"{key} unknown"), []).append(name)
        common_value = max(groups, key=lambda value: len(groups[value]))
        common_values.append(f"{label}{common_value}")
        exceptions += [
            f"{', '.join(names)}: {label}{value}" for value, names in groups.items() if value != common_value
        ]
    exception_text = (
        f" Exceptions, by the names of checks (`--only NAME`): {'; '.join(exceptions)}." if exceptions else ""
    )
    return f"Measured on {'; '.join(common_values)}.{exception_text}"
