"""The algorithms that were judged, and requirements for other programs: the traceability matrix and JUnit's XML."""

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

from marsyard.reports.evaluation import Overall
from marsyard.reports.stored import table
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import count


@dataclass(frozen=True)
class Algorithm:
    """An algorithm under test.

    Attributes
    ----------
    name
        As the campaign names it: a name that ships, `module:Class`, or a program.
    judged
        Whether requirements judge it, or it is only compared.
    path
        Its class as `module:name`, or its file; empty where the record does not say, as are the others.
    version
        Of its installed distribution, or its own `version` attribute.
    options
        Its options by name.
    source_hash
        A hash of its sources.
    """

    name: str
    judged: bool = True
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


def algorithms_of(record: Mapping[str, Any]) -> list[Algorithm]:
    """Read the algorithms from a campaign's record, the judged one first.

    Records of earlier versions have no table of algorithms: their parameters give the names alone.
    """
    stored = record.get("algorithms")
    entries = [table(one) for one in stored] if isinstance(stored, list) else []
    found = [_algorithm(entry) for entry in entries if entry.get("spec")]
    if not found:
        found = _named(table(table(record.get("configuration")).get("parameters")))
    return sorted(found, key=lambda one: not one.judged)


def judged_text(algorithms: Sequence[Algorithm]) -> str:
    """Names and versions of those that are judged."""
    return ", ".join(one.title for one in algorithms if one.judged)


def _algorithm(entry: Mapping[str, Any]) -> Algorithm:
    return Algorithm(
        name=str(entry["spec"]),
        judged=entry.get("role") != "compared",
        path=str(entry.get("path") or ""),
        version=str(entry.get("version") or ""),
        options=table(entry.get("options")),
        source_hash=str(entry.get("source_hash") or ""),
    )


def _named(parameters: Mapping[str, Any]) -> list[Algorithm]:
    """The algorithms that parameters choose: in the first table, at any depth, that has the key `algorithm`."""
    chosen = parameters.get("algorithm")
    if isinstance(chosen, str) and chosen:
        compared = parameters.get("compared")
        names = compared if isinstance(compared, list) else []
        return [Algorithm(chosen), *(Algorithm(str(name), judged=False) for name in names)]
    inner = (_named(value) for value in parameters.values() if isinstance(value, Mapping))
    return next((found for found in inner if found), [])


#: Columns of the matrix; one row for each requirement and campaign.
COLUMNS = (
    "requirement",
    "statement",
    "kind",
    "source",
    "campaign",
    "algorithm",
    "algorithm_version",
    "algorithm_options",
    "algorithm_source",
    "verdict",
    "metric",
    "bound",
    "population",
    "probability",
    "confidence",
    "decided_by",
    "cases",
    "failures",
    "terrains",
    "rate",
    "lower_bound",
    "upper_bound",
    "design_effect",
    "consumer_risk",
    "further_cases",
    "note",
)
#: Verdicts that show a requirement neither met nor missed at its confidence.
_SKIPPED = (Status.INSUFFICIENT, Status.MET_BY_RATE)
#: What XML 1.0 cannot hold.
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def algorithm_cells(algorithms: Iterable[Algorithm]) -> dict[str, str]:
    """The matrix' columns that name the algorithms that are judged; several are joined by "; "."""
    judged = [one for one in algorithms if one.judged]
    cells = {
        "algorithm": [one.name for one in judged],
        "algorithm_version": [one.version for one in judged],
        "algorithm_options": [one.options_text for one in judged],
        "algorithm_source": [one.source_hash for one in judged],
    }
    return {column: "; ".join(value for value in values if value) for column, values in cells.items()}


def evidence_of(
    campaign: str, verdicts: Iterable[Verdict], algorithms: Sequence[Algorithm] = ()
) -> list[dict[str, Any]]:
    """Rows of the matrix: what a campaign shows of each requirement, and of which algorithm."""
    return [
        {
            "requirement": one.requirement_id,
            "statement": one.statement,
            "kind": one.kind,
            "source": one.source,
            "campaign": campaign,
            **algorithm_cells(algorithms),
            "verdict": str(one.status),
            "metric": one.metric if one.scale == 1.0 else f"{one.scale:g} * ({one.metric})",
            "bound": one.bound,
            "population": one.population,
            "probability": one.probability,
            "confidence": one.confidence,
            "decided_by": one.decide_by,
            "cases": one.n,
            "failures": one.failures,
            "terrains": one.terrains,
            "rate": one.estimate,
            "lower_bound": one.lower,
            "upper_bound": one.upper,
            "design_effect": math.nan if one.clustered is None else one.clustered.design_effect,
            "consumer_risk": one.consumer_risk,
            "further_cases": one.further_cases,
            "note": one.note,
        }
        for one in verdicts
    ]


def verification_csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """The traceability matrix; what is missing or NaN is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_cell(row.get(column)) for column in COLUMNS] for row in rows)
    return text.getvalue()


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    text = f"{value:.9g}" if isinstance(value, float) else str(value)
    # a text that a spreadsheet would take for a formula is shown as the text that it is
    return f"'{text}" if isinstance(value, str) and text[:1] in "=+-@\t\r" and text else text


def junit_xml(campaign: str, verdicts: Sequence[Verdict], whole: Overall, algorithms: Sequence[Algorithm] = ()) -> str:
    """A test case for each requirement, and one that says whether all cases came to an end.

    Properties of the suite name the algorithms that are judged.
    FAIL is a failure; INSUFFICIENT and MET BY RATE are skipped: a server of tests then shows them neither as passed nor
    as failed.
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
    judged = judged_text(algorithms)
    subject = f"Judged: {judged}. " if judged else ""
    for one in verdicts:
        case = Xml.SubElement(suite, "testcase", classname=_text(campaign), name=_text(one.requirement_id))
        said = _text(
            f"{one.failures} of {one.n} failed; at least {one.lower:.6g}, asked {one.probability:g}. {one.note}"
        )
        if one.status is Status.FAIL:
            Xml.SubElement(case, "failure", message=said, type=str(one.status))
        elif one.status in _SKIPPED:
            Xml.SubElement(case, "skipped", message=f"{one.status}: {said}")
        Xml.SubElement(case, "system-out").text = _text(f"{subject}{one.statement} {said}")
    ended = Xml.SubElement(suite, "testcase", classname=_text(campaign), name="all cases end")
    if whole.crashed:
        Xml.SubElement(ended, "failure", message=f"{count(whole.crashed, 'case')} crashed", type="CRASHED")
    Xml.indent(suite)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{Xml.tostring(suite, encoding="unicode")}\n'


def _text(text: str) -> str:
    return _UNPRINTABLE.sub("�", text)
