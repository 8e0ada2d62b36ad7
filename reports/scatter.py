"""The errors' scatter in numbers: the ellipse that the next error lies in, and circular errors about the truth."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from marsyard.reports.columns import axis_columns, label, numbers, split_unit
from marsyard.reports.figures import ELLIPSE
from marsyard.reports.populations import terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.plane import circular_error, error_ellipse
from marsyard.reports.wording import interval, number, percent, stated

#: Shares of the errors within the radii, and the confidence of the radii's bounds.
SHARES, CONFIDENCE = (0.5, 0.95, 0.99), 0.9


def scatter_section(subject: Subject) -> Section | None:
    """Ellipse and circular errors of a metric of two parts; None where it has none, or too few cases do."""
    metric = subject.metric
    if metric is None:
        return None
    parts = axis_columns(metric, [str(name) for name in subject.whole.columns])[:2]
    if len(parts) < 2:
        return None
    errors = np.column_stack([numbers(subject.whole, part) for part in parts])
    ellipse = error_ellipse(errors, ELLIPSE)
    if ellipse is None:
        return None
    groups = terrain_groups(subject.whole)
    circles = [circular_error(errors, share, CONFIDENCE, groups) for share in SHARES]
    unit = split_unit(metric)[1]
    x, y = (number(value) for value in ellipse.centre)
    text = (
        f"{stated(ELLIPSE)} ellipse, for normal errors: centre {x}, {y} {unit}, half axes {number(ellipse.semi_major)} "
        f"and {number(ellipse.semi_minor)} {unit}, major axis at {number(ellipse.angle_deg)} deg from "
        f"{label(parts[0])} towards {label(parts[1])}. {percent(ellipse.inside)} of these errors lie inside."
    )
    rows = [[stated(one.probability), number(one.estimate), interval(one.lower, one.upper)] for one in circles]
    grid = Grid(["Share of errors", f"Radius ({unit})", f"Bounds, {stated(CONFIDENCE)} each"], rows)
    note = (
        "Radius about the truth that holds the share; that of 50 % is the circular error probable. Bounds by order "
        "statistics: of whole terrains, or of the effective number of cases, where cases share terrains. The ellipse "
        "holds the next error with its probability, however few cases there are."
    )
    data = {"ellipse": asdict(ellipse), "circles": [asdict(one) for one in circles]}
    return Section("scatter", "Scatter", "Scatter of the errors", [Block(text=text, grid=grid, note=note)], data)
