"""Store the figures as JSON and write docs/validation.md from figures and template."""

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
#: Versions that a figure can depend on.
PACKAGES = ("marsyard", "numpy", "scipy", "numba", "pyrender2", "trimesh")


def figure(value: float) -> str:
    """Format a number with two significant digits."""
    return f"{value:.2g}"


def shown(measure: Measure, value: float) -> str:
    """Format a value with its unit; fractions with a lower bound are given in per cent."""
    if measure.sense == "at least":
        return f"{100.0 * value:.2f} %"
    return f"{figure(value)} {measure.unit}".strip()


def keep(measured: dict[str, list[Measure]], quick: bool) -> dict[str, dict]:
    """Add the figures of these checks to the stored figures, and return all."""
    kept: dict[str, dict] = json.loads(RESULTS.read_text())["checks"] if RESULTS.exists() else {}
    environment = _environment(quick)
    for name, measures in measured.items():
        kept[name] = {"environment": environment, "measures": [asdict(measure) for measure in measures]}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps({"checks": {name: kept[name] for name in sorted(kept)}}, indent=1) + "\n")
    return kept


def _environment(quick: bool) -> dict[str, str]:
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {processor_features()}",
        "gl": renderer().description(),
        "versions": ", ".join(f"{name} {version(name)}" for name in PACKAGES),
        "samples": "few (--quick)" if quick else "all",
    }


def write(checks: Sequence[Check], kept: dict[str, dict]) -> None:
    """Write the page with rows in the order of the checks, so that only figures differ between runs."""
    text = TEMPLATE.read_text()
    sections: dict[str, list[str]] = {}
    for check in checks:
        rows = sections.setdefault(check.section, [])
        for stored in kept.get(check.name, {}).get("measures", []):
            rows.append(_row(Measure(**stored)))
    for section, rows in sections.items():
        head = ["| property | bound | measured | | method |", "|---|---|---|---|---|"]
        text = text.replace("{" + section + "}", "\n".join(head + rows) if rows else "Not measured yet.")
    text = text.replace("{environment}", _environments(checks, kept))
    DOCUMENT.write_text(text)


def _row(measure: Measure) -> str:
    verdict = "" if measure.limit is None else ("met" if measure.passed else "**missed**")
    limit = "reported" if measure.limit is None else f"{measure.sense} {shown(measure, measure.limit)}"
    return f"| {measure.claim} | {limit} | {shown(measure, measure.measured)} | {verdict} | {measure.how} |"


def _environments(checks: Sequence[Check], kept: dict[str, dict]) -> str:
    """Describe machine and versions: the common environment once, then exceptions with their checks."""
    stored = {check.name: kept[check.name]["environment"] for check in checks if check.name in kept}
    if not stored:
        return "Nothing has been measured yet."
    labels = {"machine": "", "gl": "OpenGL ", "versions": "", "samples": "samples: "}
    common, different = [], []
    for key, label in labels.items():
        groups: dict[str, list[str]] = {}
        for name, environment in stored.items():
            groups.setdefault(environment[key], []).append(name)
        usual = max(groups, key=lambda value: len(groups[value]))
        common.append(f"{label}{usual}")
        different += [f"{', '.join(names)}: {label}{value}" for value, names in groups.items() if value != usual]
    exceptions = "".join(f" Except {one}." for one in different)
    return f"Measured on {'; '.join(common)}.{exceptions}"
