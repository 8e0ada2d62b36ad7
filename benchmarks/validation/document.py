"""Store the measurements as JSON, and write docs/validation.md from the measurements and a template."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import renderer
from marsyard.sim.kernel_cache import processor_features

ROOT = Path(__file__).parents[2]
TEMPLATE = Path(__file__).parent / "template.md"
DOCUMENT = ROOT / "docs" / "validation.md"
RESULTS = ROOT / "benchmarks" / "results" / "validation.json"
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
    stored: dict[str, dict] = json.loads(RESULTS.read_text())["checks"] if RESULTS.exists() else {}
    environment = _read_environment(quick)
    for name, measures in results.items():
        stored[name] = {"environment": environment, "measures": [asdict(measure) for measure in measures]}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps({"checks": {name: stored[name] for name in sorted(stored)}}, indent=1) + "\n")
    return stored


def _read_environment(quick: bool) -> dict[str, str]:
    """Return machine, OpenGL library, package versions and number of samples of the measurements."""
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {processor_features()}",
        "gl": renderer().description(),
        "versions": ", ".join(f"{name} {version(name)}" for name in PACKAGES),
        "samples": "few (--quick)" if quick else "all",
    }


def write_page(checks: Sequence[Check], stored: dict[str, dict]) -> None:
    """Write the page with rows in the order of the checks, so that only values differ between runs."""
    text = TEMPLATE.read_text()
    sections: dict[str, list[str]] = {}
    columns = {check.section: ("property", "limit", "measured", "", *check.method_columns) for check in checks}
    for check in checks:
        rows = sections.setdefault(check.section, [])
        for row in stored.get(check.name, {}).get("measures", []):
            rows.append(_format_row(Measure(**row)))
    for section, rows in sections.items():
        header = [f"| {' | '.join(columns[section])} |".replace("|  |", "| |"), "|---" * len(columns[section]) + "|"]
        text = text.replace("{" + section + "}", "\n".join(header + rows) if rows else "Not measured yet.")
    text = text.replace("{environment}", _describe_environments(checks, stored))
    DOCUMENT.write_text(text)


def _format_row(measure: Measure) -> str:
    """Format a measurement as a row of the table."""
    verdict = "" if measure.limit is None else ("met" if measure.passed else "**missed**")
    limit = "reported" if measure.limit is None else f"{measure.sense} {format_value(measure, measure.limit)}"
    return f"| {measure.claim} | {limit} | {format_value(measure, measure.measured)} | {verdict} | {measure.how} |"


def _describe_environments(checks: Sequence[Check], stored: dict[str, dict]) -> str:
    """Describe machine and versions: the most frequent values, then exceptions with the names of their checks."""
    environments = {check.name: stored[check.name]["environment"] for check in checks if check.name in stored}
    if not environments:
        return "Nothing has been measured yet."
    labels = {"machine": "", "gl": "OpenGL ", "versions": "", "samples": "samples: "}
    common_values, exceptions = [], []
    for key, label in labels.items():
        groups: dict[str, list[str]] = {}
        for name, environment in environments.items():
            groups.setdefault(environment[key], []).append(name)
        common_value = max(groups, key=lambda value: len(groups[value]))
        common_values.append(f"{label}{common_value}")
        exceptions += [
            f"{', '.join(names)}: {label}{value}" for value, names in groups.items() if value != common_value
        ]
    exception_text = (
        f" Exceptions, by the names of checks (`--only NAME`): {'; '.join(exceptions)}." if exceptions else ""
    )
    return f"Measured on {'; '.join(common_values)}.{exception_text}"
