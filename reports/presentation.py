"""Presentation of a system (DIMES, for example): its report sections, and the views of its cases on the page.

Each system of `marsyard.scenarios.systems` defines the import path of its presentation in `System.report`.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from marsyard.reports.products import Products
from marsyard.reports.section import SectionMaker
from marsyard.reports.timeline.figure import draw_timeline
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.systems import find_system, systems
from marsyard.scenarios.timeline import Timeline


@dataclass(frozen=True)
class TableRow:
    """A row of a case's table, and whether its item (a track or a stage, for example) succeeded."""

    values: Sequence[str]
    succeeded: bool


@dataclass(frozen=True)
class CaseFigure:
    """A figure of a case: its name (that of its file without the ending), and its caption on the page.

    wide: whether the figure has the full width of the page
    """

    name: str
    figure: Figure
    caption: str = ""
    wide: bool = True


@dataclass(frozen=True)
class CaseView:
    """View of a case: its figures, and on the page further texts.

    - facts: names and values
    - head, rows: headings and rows of the case's table
    - legend: text that explains the figures; None for the legend of the `CaseKind`
    """

    figures: Sequence[CaseFigure]
    facts: Sequence[tuple[str, str]] = ()
    head: Sequence[str] = ()
    rows: Sequence[TableRow] = ()
    legend: str | None = None


@dataclass(frozen=True)
class CaseKind:
    """Functions that draw the cases of one kind (landings, for example) from their products.

    - is_case: return whether the products are those of this kind of case
    - view: create the view; the second argument is true for files, which contain all figures, and false for the page
    - legend: text that explains the figures of a view
    """

    is_case: Callable[[Products], bool]
    view: Callable[[Products, bool], CaseView]
    legend: str = ""


@dataclass(frozen=True)
class Cause:
    """Cause of a violation: a short name, by which violations are grouped, and a text with the case's numbers."""

    name: str
    detail: str


@dataclass(frozen=True)
class AnswerFlags:
    """Columns that classify the cases of a system whose algorithms report several answers in a case.

    - reported: flag of the cases with at least one reported answer
    - wrong: flag of the cases in which at least one reported answer is wrong
    """

    reported: str
    wrong: str


@dataclass(frozen=True)
class Presentation:
    """Report sections and case figures of a system.

    - cases: kinds of case; the first kind that matches the products is used
    - sections: functions that create sections after the sections common to all campaigns
    - first: functions that create sections before the common sections
    - outcomes: enumerations of outcomes; each value describes its outcome
    - answer_flags: columns that classify the cases; None: the final answer and the page's metric classify them
    - explain: return the cause of a row's violation of a requirement with this metric; None if it is unknown. The row
      also contains the values of the campaign's file by parameter path, such as `lander.max_slope_deg`
    """

    cases: Sequence[CaseKind] = ()
    sections: Sequence[SectionMaker] = ()
    first: Sequence[SectionMaker] = ()
    outcomes: Sequence[type[Enum]] = ()
    answer_flags: AnswerFlags | None = None
    explain: Callable[[Mapping[str, Any], str], Cause | None] | None = None


@cache
def presentations() -> Mapping[str, Presentation]:
    """Import the presentations of all systems, by system; omit an invalid one with a warning.

    Those of recorded data are first: their cases also contain products of other systems, which must not claim them.
    """
    valid = {}
    for system in sorted(systems(), key=lambda system: not system.ingest):
        if not system.report:
            continue
        try:
            presentation = import_object(system.report)
            problem = f"is a {type(presentation).__name__}; allowed: a marsyard.reports.presentation.Presentation"
        except ImportError as error:
            presentation, problem = None, f"cannot be imported: {error}"
        if isinstance(presentation, Presentation):
            valid[system.name] = presentation
        else:
            reason = f"the report '{system.report}' of system '{system.name}' {problem}"
            warnings.warn(f"{reason}; its sections and images are omitted", stacklevel=2)
    return valid


def system_presentation(scenario: str) -> Presentation | None:
    """Return the presentation of the system with this scenario; None without one."""
    system = find_system(scenario)
    return None if system is None else presentations().get(system.name)


def find_case_kind(products: Products) -> CaseKind | None:
    """Find the kind of case of these products; None if no system recognizes them."""
    kinds = (kind for presentation in presentations().values() for kind in presentation.cases)
    return next((kind for kind in kinds if kind.is_case(products)), None)


#: Resolution of figures in files.
_FILE_DPI = 130
#: Caption of the perspective view of a case with a timeline.
_SPACE_CAPTION = (
    "The case in space: visible ground, true and estimated path, and the cameras at the times of images. "
    "`marsyard replay` with `--rerun` exports a view with a time line."
)


def create_case_view(products: Products, *, complete: bool) -> CaseView:
    """Create the view of a case, without figures if no system recognizes its products.

    complete: whether the view is for files, which contain all figures
    """
    kind, timeline = find_case_kind(products), Timeline.from_products(products)
    view = CaseView([]) if kind is None else kind.view(products, complete)
    space = [] if timeline is None else [CaseFigure("space", draw_timeline(timeline), _SPACE_CAPTION, wide=False)]
    legend = kind.legend if kind is not None and view.legend is None else view.legend
    return replace(view, figures=[*view.figures, *space], legend=legend)


def write_case_figures(directory: Path, products: Products) -> list[Path]:
    """Write a case's figures as PNG on white into a folder; returns their paths.

    Raises OSError if they cannot be written.
    """
    view = create_case_view(products, complete=True)
    figures = {directory / f"{item.name}.png": item.figure for item in view.figures}
    for path, figure in figures.items():
        figure.savefig(path, dpi=_FILE_DPI, facecolor="#ffffff", metadata={"Software": None})
    return [*figures]
