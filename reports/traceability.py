"""Requirements for other programs: a traceability matrix as CSV, and JUnit's XML, which servers of tests show."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree as Xml

from marsyard.reports.algorithms import Algorithm, judged_text
from marsyard.reports.overall import Overall
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import count

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
