"""Blocks on the answers of the search for a site, and on their distances to true hazards.

Figures and "the paper" refer to Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports import populations, rates
from marsyard.reports.column_values import numbers
from marsyard.reports.empty_cells import drop_empty_columns
from marsyard.reports.hda.faults_section import classify_answers
from marsyard.reports.plots import cumulative_figure
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, svg_figure
from marsyard.reports.statistics.samples import is_interpolated, quantile_bounds
from marsyard.reports.wording import NOTHING, format_fraction, number

#: Minimum number of values for a cumulative curve.
MIN_CURVE_VALUES = 5


#: Classes of the true ground that both images show, best first. All positions within one lander radius of a wide safe
#: site are also safe.
GROUNDS = ("wide safe site", "narrow safe site", "no safe site")
#: Names of the outcomes of `classify_answers`, in the same order; "crashed" means every case that did not finish.
ANSWERS = ("truly safe site", "unsafe site", "'no safe site'", "not converged", "crashed")
_GROUND_TEXTS = dict(
    zip(GROUNDS, ("a wide safe site exists", "only narrow safe sites exist", "no safe site exists"), strict=True)
)


def site_fractions(frame: pd.DataFrame) -> dict[str, rates.CaseFraction]:
    """Compute fractions of correct answers by class of the true ground; classes without cases are omitted."""
    is_reported, has_no_safe_site, has_wide_site = (
        populations.flag_mask(frame, name) for name in ("site_reported", "no_safe_site_exists", "wide_site_exists")
    )
    is_refused, is_safe = populations.flag_mask(frame, "no_site_reported"), populations.flag_mask(frame, "site_safe")
    has_narrow_site = populations.flag_mask(frame, "safe_site_exists") & ~has_wide_site
    is_correct = is_refused | (is_reported & is_safe)
    fractions = {
        "reported sites that are truly safe": rates.fraction_of(is_safe[is_reported], frame[is_reported]),
        "site reported if a wide safe site exists": rates.fraction_of(is_reported[has_wide_site], frame[has_wide_site]),
        "truly safe site or 'no safe site' if only narrow safe sites exist": rates.fraction_of(
            is_correct[has_narrow_site], frame[has_narrow_site]
        ),
        "answer 'no safe site' if no safe site exists": rates.fraction_of(
            is_refused[has_no_safe_site], frame[has_no_safe_site]
        ),
    }
    return {name: fraction for name, fraction in fractions.items() if fraction.n}


def outcome_counts(frame: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Count flights by true ground (`GROUNDS`) and outcome (`ANSWERS`)."""
    has_wide_site, has_safe_site, has_no_safe_site = (
        populations.flag_mask(frame, name) for name in ("wide_site_exists", "safe_site_exists", "no_safe_site_exists")
    )
    answer_masks = dict(zip(ANSWERS, classify_answers(frame).values(), strict=True))
    ground_masks = dict(zip(GROUNDS, (has_wide_site, has_safe_site & ~has_wide_site, has_no_safe_site), strict=True))
    return {
        ground: {answer: int((ground_mask & mask).sum()) for answer, mask in answer_masks.items()}
        for ground, ground_mask in ground_masks.items()
    }


def create_outcome_block(frame: pd.DataFrame) -> Block:
    """Create the table of the outcomes of the search by class of the true ground."""
    counts = outcome_counts(frame)
    rows = [
        [_GROUND_TEXTS[ground], *(f"{answer_counts[name]:,}" for name in ANSWERS)]
        for ground, answer_counts in counts.items()
    ]
    head = ["Ground truth", "safe site reported", "unsafe site reported", *ANSWERS[2:]]
    note = (
        "Numbers of flights. Rows: what truly exists in the area that both images show. Columns: the answer of the "
        "algorithm; 'no safe site' is an answer. Wide: all positions within one lander radius of the site are also "
        "safe. Narrow: all other safe sites. If the algorithm does not converge, the helicopter descends to the "
        "a-priori site, which is set before the images are processed."
    )
    grid, data = Grid(head, rows), {"outcomes": counts}
    return Block(heading="Answers by ground truth", grid=grid, note=note, data=data)


def hazard_distances(frame: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
    """Collect the distances of reported sites and of true touchdowns to the nearest unsafe grid position, metres.

    The distance of an unsafe position is 0. It is infinite if the grid has no unsafe position.
    """
    rows_with_site = frame[populations.flag_mask(frame, "site_reported")]
    distances = {}
    for name, rows, prefix in (("reported site", rows_with_site, "site"), ("true touchdown", frame, "touchdown")):
        values = numbers(rows, f"{prefix}_hazard_distance_m")
        if f"{prefix}_safe" in rows:
            is_unsafe = rows[f"{prefix}_safe"].eq(False).fillna(False).to_numpy(dtype=np.bool_)
            values = np.where(is_unsafe & ~np.isnan(values), 0.0, values)
        distances[name] = values[~np.isnan(values)]
    return distances


def distance_grid(curves: Mapping[str, Float[np.ndarray, " n"]]) -> Grid:
    """Create a table of minimum distance, median, 5 % quantile, and lower bound of the 5 % quantile."""
    rows = []
    for name, values in curves.items():
        if values.size:
            bound = quantile_bounds(values, 0.05, CONFIDENCE)[0]
            # the method does not interpolate, since values can be infinite
            low, median = (float(np.quantile(values, probability, method="lower")) for probability in (0.05, 0.5))
            texts = [_distance_text(float(values.min()))]
            texts.append(_distance_text(median) if values.size >= MIN_CURVE_VALUES else NOTHING)
            texts.append(_distance_text(low) if is_interpolated(values.size, 0.05) else NOTHING)
            counts = [f"{n:,}" for n in (values.size, int((values == 0.0).sum()), int(np.isinf(values).sum()))]
            rows.append([name, *counts, *texts, NOTHING if math.isinf(bound) else _distance_text(bound)])
    bound_head = f"5 % quantile, lower bound at {format_fraction(CONFIDENCE)} confidence (m)"
    count_heads = ["Flights", "On unsafe ground", "No unsafe position in the area"]
    return Grid(["", *count_heads, "Minimum distance (m)", "Median (m)", "5 % quantile (m)", bound_head], rows)


def _distance_text(distance_m: float) -> str:
    return "0" if distance_m == 0.0 else number(distance_m)


def create_distance_block(frame: pd.DataFrame) -> Block | None:
    """Create table and curves of the distances to true hazards; no curves for few distances."""
    distances = hazard_distances(frame)
    grid = drop_empty_columns(distance_grid(distances))
    if not grid.rows:
        return None
    all_values = np.concatenate([*distances.values()])
    edge_m = float(np.max(all_values[np.isfinite(all_values)], initial=0.0))
    figures = []
    if edge_m > 0.0 and max(values.size for values in distances.values()) >= MIN_CURVE_VALUES:
        # infinite distances lie beyond the axis
        curves = {name: np.where(np.isinf(values), 2.0 * edge_m, values) for name, values in distances.items()}
        labels = ("distance to the nearest unsafe position (m)", "fraction above this distance")
        figure = cumulative_figure(curves, labels, complementary=True)
        figure.axes[0].set_xlim(0.0, 1.02 * edge_m)
        figures.append(svg_figure(figure, "distances", "The drop at 0 is the fraction on unsafe ground."))
    note = (
        "A position is unsafe if slope or roughness of the lander footprint around it exceeds the limit; the hazard "
        "itself can be at the edge of the footprint. The distance is 0 on unsafe ground. On safe ground, it is the "
        "distance to the nearest unsafe position of a grid over the ground in the first image (the area), or ∞ without "
        "such a position. Reported site: its true position. True touchdown: at the reported or at the a-priori site."
    )
    return Block(heading="Distance to true hazards", figures=figures, grid=grid, note=note)
