"""View of a case on the page, and its figures in files."""

from dataclasses import replace
from pathlib import Path

from marsyard.reports.presentation import CaseFigure, CaseView, find_case_kind
from marsyard.reports.products import Products
from marsyard.reports.timeline.figure import draw_timeline
from marsyard.scenarios.timeline import Timeline

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
