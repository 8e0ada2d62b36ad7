"""Excerpts of a report's page for the pages of the dashboard: lists of cases, and results and images of each case.

An excerpt is the content of an element `article` of `templates/report.html.j2`, which contains no other `article`. The
template and this module share the names of these elements (`marsyard.reports.page_environment`). The report escapes all
values, so that no value contains a tag that begins or ends an excerpt.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from markupsafe import Markup

from marsyard.reports.page_environment import CASE_ANCHOR, LISTS_CLASS

#: Element with lists of cases by requirement; its group is the content.
_LISTS = re.compile(rf'<article class="{LISTS_CLASS}">(.*?)</article>', re.DOTALL)
#: Element with results and images of a case; its groups are the number of the case and the content.
_CASE = re.compile(rf'<article id="{CASE_ANCHOR}(\d+)"[^>]*>(.*?)</article>', re.DOTALL)


@dataclass(frozen=True)
class Excerpts:
    """Lists of cases by requirement (may be empty), and results and images of each case that the report shows."""

    lists: Markup
    cases: Mapping[int, Markup]


def case_file(case: int) -> str:
    """Return the name of the page of a case."""
    return f"case-{case}.html"


def read_excerpts(report: str) -> Excerpts:
    """Read the excerpts of a report's page; links to its cases become links to their pages."""
    contents = {int(case): content for case, content in _CASE.findall(report)}
    lists = "".join(_LISTS.findall(report))
    return Excerpts(
        _link_pages(lists, contents), {case: _link_pages(content, contents) for case, content in contents.items()}
    )


def _link_pages(content: str, cases: Mapping[int, str]) -> Markup:
    """Replace the links to cases within the report by links to their pages. The content is HTML of the report."""
    for case in cases:
        content = content.replace(f'href="#{CASE_ANCHOR}{case}"', f'href="{case_file(case)}"')
    return Markup(content)  # noqa: S704
