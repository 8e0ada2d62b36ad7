"""A figure as a page shows it."""

from __future__ import annotations

from dataclasses import dataclass

from markupsafe import Markup
from matplotlib.figure import Figure

from reports.svg import svg_markup


@dataclass(frozen=True)
class Plate:
    """A figure as SVG, and its caption."""

    svg: Markup
    caption: str


def plate(figure: Figure, key: str, caption: str) -> Plate:
    """A figure with its caption; `key` is as in `svg_markup`."""
    # Matplotlib has escaped the texts inside; the description is escaped where it is put in.
    return Plate(Markup(svg_markup(figure, key, caption)), caption)  # noqa: S704
