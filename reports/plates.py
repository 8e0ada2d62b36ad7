"""A figure as a page shows it."""

from __future__ import annotations

from dataclasses import dataclass

from markupsafe import Markup
from matplotlib.figure import Figure

from marsyard.reports.svg import svg_markup


@dataclass(frozen=True)
class Plate:
    """A figure as SVG, its caption, and whether it takes the page's whole width."""

    svg: Markup
    caption: str
    wide: bool = False


def plate(figure: Figure, key: str, caption: str, *, wide: bool = False) -> Plate:
    """A figure with its caption; `key` is as in `svg_markup`."""
    # Matplotlib has escaped the texts inside; the description is escaped where it is put in.
    return Plate(Markup(svg_markup(figure, key, caption)), caption, wide)  # noqa: S704
