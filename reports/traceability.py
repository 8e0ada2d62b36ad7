"""Algorithms of a campaign, traceability matrix of requirements (`verification.csv`), and verdicts as JUnit XML."""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree as Xml

from marsyard.reports.overall import OverallVerdict
from marsyard.reports.stored import table
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import count


@dataclass(frozen=True)
class Algorithm:
    """An algorithm of a campaign; text that is missing from the record is empty.

    - name: name in the campaign: a built-in algorithm, `module:Class`, or a program
    - tested: whether the algorithm is under test; False if it is only compared
    - path: class of the algorithm as `module:name`, or its file
    - version: version of the installed distribution, or attribute `version` of the algorithm
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
        """The options as JSON; empty for no options."""
        return json.dumps(self.options, ensure_ascii=False) if self.options else ""


def read_algorithms(record: Mapping[str, Any]) -> list[Algorithm]:
    """Read the algorithms from a campaign's record, the algorithm under test first."""
    stored_list = record.get("algorithms")
    entries = [table(entry) for entry in stored_list] if isinstance(stored_list, list) else []
    algorithms = [
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
    return sorted(algorithms, key=lambda algorithm: not algorithm.tested)


def format_tested_algorithms(algorithms: Sequence[Algorithm]) -> str:
    """Format names and versions of the algorithms under test."""
    return ", ".join(algorithm.title for algorithm in algorithms if algorithm.tested)


#: Characters that XML 1.0 does not allow.
_INVALID_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def algorithm_cells(algorithms: Iterable[Algorithm]) -> dict[str, str]:
    """Create the columns that identify the algorithms under test; several algorithms are joined by "; "."""
    tested_algorithms = [algorithm for algorithm in algorithms if algorithm.tested]
    cells = {
        "algorithm": [algorithm.name for algorithm in tested_algorithms],
        "algorithm_version": [algorithm.version for algorithm in tested_algorithms],
        "algorithm_options": [algorithm.options_text for algorithm in tested_algorithms],
        "algorithm_source": [algorithm.source_hash for algorithm in tested_algorithms],
    }
    return {column: "; ".join(value for value in values if value) for column, values in cells.items()}


#: Columns of the matrix in front of and after those of the algorithm, and the verdict's property in each column.
_REQUIREMENT_COLUMNS = {"requirement": "requirement_id", "statement": "statement", "kind": "kind", "source": "source"}
_EVIDENCE_COLUMNS = {
    "verdict": "status", "metric": "metric", "bound": "bound", "population": "population", "probability": "probability",
    "confidence": "confidence", "decided_by": "decide_by", "cases": "n", "failures": "failures", "terrains": "terrains",
    "rate": "estimate", "lower_bound": "lower", "upper_bound": "upper",
    "consumer_risk": "consumer_risk", "additional_cases": "additional_cases", "note": "note",
}  # fmt: skip
#: Columns of the result on all cases, and its fields.
_ALL_CASES_COLUMNS = {"all_cases": "n", "all_failures": "failures", "all_rate": "estimate", "all_verdict": "status"}
COLUMNS = (*_REQUIREMENT_COLUMNS, "campaign", *algorithm_cells(()), *_EVIDENCE_COLUMNS, *_ALL_CASES_COLUMNS, "evidence")


def requirement_evidence(
    campaign: str, verdicts: Iterable[Verdict], algorithms: Sequence[Algorithm] = (), evidence_kind: str = ""
) -> list[dict[str, Any]]:
    """Create the rows of the traceability matrix: the evidence of a campaign for each requirement."""
    cells = {"campaign": campaign, **algorithm_cells(algorithms), "evidence": evidence_kind}
    rows = []
    for verdict in verdicts:
        evidence = {column: getattr(verdict, name) for column, name in _EVIDENCE_COLUMNS.items()}
        if verdict.all_cases is not None:
            evidence |= {column: getattr(verdict.all_cases, name) for column, name in _ALL_CASES_COLUMNS.items()}
        evidence["verdict"] = str(verdict.status)
        evidence["metric"] = verdict.metric if verdict.scale == 1.0 else f"{verdict.scale:g} * ({verdict.metric})"
        rows.append(
            {column: getattr(verdict, name) for column, name in _REQUIREMENT_COLUMNS.items()} | cells | evidence
        )
    return rows


def verification_csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """Format the traceability matrix as CSV; missing values and NaN are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_format_cell(row.get(column)) for column in COLUMNS] for row in rows)
    return text.getvalue()


def _format_cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    text = f"{value:.9g}" if isinstance(value, float) else str(value)
    # the apostrophe prevents spreadsheets from reading a text as a formula
    return f"'{text}" if isinstance(value, str) and text[:1] in "=+-@\t\r" and text else text


def junit_xml(
    campaign: str, verdicts: Sequence[Verdict], overall: OverallVerdict, algorithms: Sequence[Algorithm] = ()
) -> str:
    """Format the verdicts as JUnit XML: a test for each requirement, and one for the completion of all cases.

    FAIL is a failure; INSUFFICIENT, MET BY RATE and PASS with a qualification are skipped. Properties of the suite: the
    tested algorithm.
    """
    statuses = [verdict.status for verdict in verdicts]
    suite = Xml.Element(
        "testsuite",
        name=_clean_xml(campaign),
        tests=str(len(verdicts) + 1),
        failures=str(statuses.count(Status.FAIL) + bool(overall.crashed)),
        skipped=str(sum(status not in (Status.PASS, Status.FAIL) for status in statuses)),
    )
    cells = {name: value for name, value in algorithm_cells(algorithms).items() if value}
    if cells:
        properties = Xml.SubElement(suite, "properties")
        for name, value in cells.items():
            Xml.SubElement(properties, "property", name=name, value=_clean_xml(value))
    tested_names = format_tested_algorithms(algorithms)
    tested_text = f"Under test: {tested_names}. " if tested_names else ""
    for verdict in verdicts:
        test_case = Xml.SubElement(
            suite, "testcase", classname=_clean_xml(campaign), name=_clean_xml(verdict.requirement_id)
        )
        message = _clean_xml(
            f"{verdict.failures} of {verdict.n} failed; {_format_lower_bound(verdict.lower)}, "
            f"required {verdict.probability:g}. {verdict.note}"
        )
        if verdict.status is Status.FAIL:
            Xml.SubElement(test_case, "failure", message=message, type=str(verdict.status))
        elif verdict.status is not Status.PASS:
            Xml.SubElement(test_case, "skipped", message=f"{verdict.status}: {message}")
        Xml.SubElement(test_case, "system-out").text = _clean_xml(f"{tested_text}{verdict.statement} {message}")
    completion = Xml.SubElement(suite, "testcase", classname=_clean_xml(campaign), name="all cases end")
    if overall.crashed:
        Xml.SubElement(completion, "failure", message=f"{count(overall.crashed, 'case')} crashed", type="CRASHED")
    Xml.indent(suite)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{Xml.tostring(suite, encoding="unicode")}\n'


def _format_lower_bound(lower: float) -> str:
    return "no lower bound" if math.isnan(lower) else f"at least {lower:.6g}"


def _clean_xml(text: str) -> str:
    """Replace characters that XML does not allow."""
    return _INVALID_XML.sub("�", text)
