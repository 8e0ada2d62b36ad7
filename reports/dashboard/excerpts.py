"""Parts of a campaign's report that the dashboard shows again."""

from collections.abc import Mapping
from dataclasses import dataclass

from markupsafe import Markup

#: First and last characters of the lists of cases, and of a case, in `templates/report.html.j2` and its parts.
_LISTS = '<article class="lists">', "</article>"
_CASE = '<article id="case-', "</article>"


@dataclass(frozen=True)
class Excerpts:
    """Lists of cases by requirement (may be empty), and results and images of each case that the report shows."""

    lists: Markup
    cases: Mapping[int, Markup]


def case_file(case: int) -> str:
    """Return the name of the page of a case."""
    return f"case-{case}.html"


def read_excerpts(report: str) -> Excerpts:
    """Read the parts of a report page; links to its cases become links to their pages."""
    lists, parts = _read_parts(report, *_LISTS), _read_parts(report, *_CASE)
    bodies = {int(head.partition('"')[0]): body for head, _, body in (part.partition(">") for part in parts)}

    def link_pages(part: str) -> Markup:
        for case in bodies:
            part = part.replace(f'href="#case-{case}"', f'href="{case_file(case)}"')
        return Markup(part)  # noqa: S704

    return Excerpts(link_pages("".join(lists)), {case: link_pages(body) for case, body in bodies.items()})


def _read_parts(report: str, start: str, end: str) -> list[str]:
    return [part.partition(end)[0] for part in report.split(start)[1:]]
