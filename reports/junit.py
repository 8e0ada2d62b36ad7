"""Verdicts as JUnit XML."""

import math
import re
from collections.abc import Sequence
from xml.etree import ElementTree as Xml

from marsyard.reports.overall import OverallVerdict
from marsyard.reports.tested_algorithms import Algorithm, format_tested_algorithms
from marsyard.reports.traceability import algorithm_cells
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import count

#: Characters that XML 1.0 does not allow.
_INVALID_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


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
