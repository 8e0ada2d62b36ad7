"""Algorithms under test, the traceability matrix of requirements (CSV), and verdicts as JUnit XML."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree as Xml

from marsyard.reports.evaluation import OverallVerdict
from marsyard.reports.stored import table
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import count


@dataclass(frozen=True)
class Algorithm:
    """An algorithm under test; text that the record lacks is empty.

    name: as in the campaign: a shipped name, `module:Class`, or a program
    tested: whether it is under test, or only compared
    path: its class as `module:name`, or its file
    version: of its installed distribution, or its `version` attribute
    """

    name: str
    tested: bool = True
    path: str = ""
    version: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    source_hash: str = ""

    @property
    def title(self) -> str:
        """Name and version."""
        return f"{self.name} {self.version}".strip()

    @property
    def options_text(self) -> str:
        """The options as JSON; empty where there are none."""
        return json.dumps(self.options, ensure_ascii=False) if self.options else ""


def tested_algorithms(record: Mapping[str, Any]) -> list[Algorithm]:
    """Read the algorithms from a campaign's record, the algorithm under test first; old records give names alone."""
    stored = record.get("algorithms")
    entries = [table(one) for one in stored] if isinstance(stored, list) else []
    items = [
        Algorithm(
            name=str(entry["spec"]),
            tested=entry.get("role") != "compared",
            path=str(entry.get("path") or ""),
            version=str(entry.get("version") or ""),
            options=table(entry.get("options")),
            source_hash=str(entry.get("source_hash") or ""),
        )
        for entry in entries
        if entry.get("spec")
    ]
    if not items:
        items = _named_algorithms(table(table(record.get("configuration")).get("parameters")))
    return sorted(items, key=lambda one: not one.tested)


def format_tested_algorithms(algorithms: Sequence[Algorithm]) -> str:
    """Names and versions of the algorithm under test."""
    return ", ".join(one.title for one in algorithms if one.tested)


def _named_algorithms(parameters: Mapping[str, Any]) -> list[Algorithm]:
    """The algorithms of the first table of parameters, at any depth, that has the key `algorithm`."""
    chosen = parameters.get("algorithm")
    if isinstance(chosen, str) and chosen:
        compared = parameters.get("compared")
        names = compared if isinstance(compared, list) else []
        return [Algorithm(chosen), *(Algorithm(str(name), tested=False) for name in names)]
    inner = (_named_algorithms(value) for value in parameters.values() if isinstance(value, Mapping))
    return next((found for found in inner if found), [])


#: Verdicts that show a requirement neither met nor missed at its confidence.
_SKIPPED = (Status.INSUFFICIENT, Status.MET_BY_RATE)
#: What XML 1.0 cannot hold.
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def algorithm_cells(algorithms: Iterable[Algorithm]) -> dict[str, str]:
    """Columns of the matrix that identify the algorithm under test, joined by "; "."""
    tested = [one for one in algorithms if one.tested]
    cells = {
        "algorithm": [one.name for one in tested],
        "algorithm_version": [one.version for one in tested],
        "algorithm_options": [one.options_text for one in tested],
        "algorithm_source": [one.source_hash for one in tested],
    }
    return {column: "; ".join(value for value in values if value) for column, values in cells.items()}


#: Columns of the matrix before and after those of the algorithm, and the properties of the verdict that they hold.
_REQUIREMENT = {"requirement": "requirement_id", "statement": "statement", "kind": "kind", "source": "source"}
_EVIDENCE = {
    "verdict": "status", "metric": "metric", "bound": "bound", "population": "population", "probability": "probability",
    "confidence": "confidence", "decided_by": "decide_by", "cases": "n", "failures": "failures", "terrains": "terrains",
    "rate": "estimate", "lower_bound": "lower", "upper_bound": "upper", "design_effect": "design_effect",
    "consumer_risk": "consumer_risk", "further_cases": "further_cases", "note": "note",
}  # fmt: skip
COLUMNS = (*_REQUIREMENT, "campaign", *algorithm_cells(()), *_EVIDENCE)


def requirement_evidence(
    campaign: str, verdicts: Iterable[Verdict], algorithms: Sequence[Algorithm] = ()
) -> list[dict[str, Any]]:
    """Rows of the traceability matrix: the evidence of a campaign for each requirement."""
    cells = {"campaign": campaign, **algorithm_cells(algorithms)}
    rows = []
    for one in verdicts:
        evidence = {column: getattr(one, name) for column, name in _EVIDENCE.items()}
        evidence["verdict"] = str(one.status)
        evidence["metric"] = one.metric if one.scale == 1.0 else f"{one.scale:g} * ({one.metric})"
        rows.append({column: getattr(one, name) for column, name in _REQUIREMENT.items()} | cells | evidence)
    return rows


def verification_csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """The traceability matrix; missing values and NaN are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_cell(row.get(column)) for column in COLUMNS] for row in rows)
    return text.getvalue()


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    text = f"{value:.9g}" if isinstance(value, float) else str(value)
    # the apostrophe keeps spreadsheets from reading a text as a formula
    return f"'{text}" if isinstance(value, str) and text[:1] in "=+-@\t\r" and text else text


def junit_xml(
    campaign: str, verdicts: Sequence[Verdict], whole: OverallVerdict, algorithms: Sequence[Algorithm] = ()
) -> str:
    """JUnit's XML: a test for each requirement, and one for the completion of all cases.

    FAIL is a failure; INSUFFICIENT and MET BY RATE are skipped. Properties of the suite name the algorithm under test.
    """
    statuses = [one.status for one in verdicts]
    suite = Xml.Element(
        "testsuite",
        name=_text(campaign),
        tests=str(len(verdicts) + 1),
        failures=str(statuses.count(Status.FAIL) + bool(whole.crashed)),
        skipped=str(sum(status in _SKIPPED for status in statuses)),
    )
    cells = {name: value for name, value in algorithm_cells(algorithms).items() if value}
    if cells:
        properties = Xml.SubElement(suite, "properties")
        for name, value in cells.items():
            Xml.SubElement(properties, "property", name=name, value=_text(value))
    tested = format_tested_algorithms(algorithms)
    subject = f"Under test: {tested}. " if tested else ""
    for one in verdicts:
        case = Xml.SubElement(suite, "testcase", classname=_text(campaign), name=_text(one.requirement_id))
        evidence = _text(
            f"{one.failures} of {one.n} failed; at least {one.lower:.6g}, asked {one.probability:g}. {one.note}"
        )
        if one.status is Status.FAIL:
            Xml.SubElement(case, "failure", message=evidence, type=str(one.status))
        elif one.status in _SKIPPED:
            Xml.SubElement(case, "skipped", message=f"{one.status}: {evidence}")
        Xml.SubElement(case, "system-out").text = _text(f"{subject}{one.statement} {evidence}")
    ended = Xml.SubElement(suite, "testcase", classname=_text(campaign), name="all cases end")
    if whole.crashed:
        Xml.SubElement(ended, "failure", message=f"{count(whole.crashed, 'case')} crashed", type="CRASHED")
    Xml.indent(suite)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{Xml.tostring(suite, encoding="unicode")}\n'


def _text(text: str) -> str:
    return _UNPRINTABLE.sub("�", text)
