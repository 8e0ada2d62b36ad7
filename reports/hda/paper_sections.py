"""Sections that compare landings with the paper: touchdown errors (Table II) and run times (Table I).

The paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from marsyard.reports import populations, rates
from marsyard.reports.blocks import Quantity, collect_values, flag_rate, rate_block
from marsyard.reports.column_values import numbers
from marsyard.reports.fits import fit_note
from marsyard.reports.hda.landing_cases import INTERVAL_NOTE, PAPER, landing_rows
from marsyard.reports.hda.sites_section import MIN_CURVE_VALUES
from marsyard.reports.plots import cumulative_figure
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import (
    Block,
    Grid,
    Section,
    Subject,
    create_section,
    drop_empty_columns,
    has_values,
    svg_figure,
)
from marsyard.reports.statistics.samples import mean_interval
from marsyard.reports.wording import NOTHING, count, format_fraction, interval, note_text, number

#: Three measures of the distance from touchdown to site.
TOUCHDOWN_ERRORS = (
    Quantity("touchdown_error_gps_m", "averaged GPS, as in the paper"),
    Quantity("touchdown_error_m", "true touchdown"),
    Quantity("touchdown_error_estimated_m", "navigation filter"),
)
_DEVIATIONS = ("gps_sd_north_m", "gps_sd_east_m")


def _create_error_block(landings: pd.DataFrame) -> Block | None:
    """Create the curves of touchdown errors; None for few landings."""
    errors = collect_values(landings, TOUCHDOWN_ERRORS)
    if max(values.size for values in errors.values()) < MIN_CURVE_VALUES:
        return None
    runs = {"paper, runs 1, 3 and 4": [run["error_m"] for run in PAPER["landings"]]}
    labels = ("distance from touchdown to site (m)", "fraction of landings")
    figure = cumulative_figure(errors, labels, limits=runs)
    return Block(figures=[svg_figure(figure, "touchdown", "Fraction of landings up to each distance.")])


def _create_table_2_block(landings: pd.DataFrame) -> Block:
    """Create the errors of Table II: the paper's runs and their mean, and the landings by `TOUCHDOWN_ERRORS`."""
    runs: Sequence[Mapping[str, float]] = PAPER["landings"]
    columns = ("error_m", "north_m", "east_m")
    paper = {f"run {run['run']}": (1, [run[name] for name in columns]) for run in runs}
    paper["mean"] = len(runs), [float(np.mean([run[name] for run in runs])) for name in columns]
    rows = [
        [f"paper, {name}", str(n), f"{error:.2f}", NOTHING, NOTHING, f"{north:.2f}", f"{east:.2f}"]
        for name, (n, (error, north, east)) in paper.items()
    ]
    deviations = {name: rates.finite_values(landings, name) for name in _DEVIATIONS}
    groups, means, intervals = rates.terrain_groups(landings), {}, {}
    for measure in TOUCHDOWN_ERRORS:
        values = measure.values(landings)
        finite = np.isfinite(values)
        if finite.any():
            lower, upper = mean_interval(values[finite], CONFIDENCE, None if groups is None else groups[finite])
            means[measure.column], intervals[measure.column] = float(values[finite].mean()), (lower, upper)
            quantiles = [rates.quantile(values[finite], probability) for probability in (0.05, 0.95)]
            texts = [number(means[measure.column]), interval(lower, upper), interval(*quantiles)]
            # the receiver's standard deviations belong to its averaged positions
            is_gps = measure is TOUCHDOWN_ERRORS[0]
            texts += [f"{sd.mean():.2f}" if is_gps and sd.size else NOTHING for sd in deviations.values()]
            rows.append([f"this campaign, {measure.title}", f"{int(finite.sum()):,}", *texts])
    mean_heads = ["Mean distance (m)", f"Mean, {format_fraction(CONFIDENCE)} interval (m)"]
    head = ["", "Landings", *mean_heads, "5 % to 95 % quantile (m)", "GPS SD north (m)", "GPS SD east (m)"]
    column = "touchdown_safe"
    safe_fraction = rates.flag_fraction(landings, column).fraction if column in landings else math.nan
    data = {
        "landings": len(landings),
        "mean_m": means,
        "mean_interval_m": intervals,
        "deviations_m": {name: float(values.mean()) for name, values in deviations.items() if values.size},
        "touchdown_safe": safe_fraction,
        "paper_m": {str(run["run"]): run["error_m"] for run in runs},
    }
    grid = drop_empty_columns(Grid(head, rows))
    return Block(
        heading="Distances as in Table II",
        grid=grid,
        note=f"{note_text('hda.touchdown')} {fit_note('hda-table-2')}",
        data=data,
    )


def touchdown_section(subject: Subject) -> Section | None:
    """Compare the distance from touchdown to site with Table II; None without touchdown errors."""
    frame = landing_rows(subject)
    landings = None if frame is None else frame[populations.flag_mask(frame, "landed")]
    if landings is None or not has_values(landings, "touchdown_error_gps_m", "touchdown_error_m"):
        return None
    at_apriori_site = landings[~populations.flag_mask(landings, "site_reported")]
    ground = {
        "true touchdown on safe ground, all landings": flag_rate("touchdown_safe")(landings),
        "true touchdown on safe ground, landings at a reported site": flag_rate("touchdown_safe", "site_reported")(
            landings
        ),
        "true touchdown on safe ground, landings at the a-priori site": flag_rate("touchdown_safe")(at_apriori_site),
        "site of the landing (reported or a-priori) is truly safe": flag_rate("descent_target_safe")(landings),
    }
    return create_section(
        "touchdown",
        "Touchdown",
        "Distance from touchdown to site, compared with Table II of the paper",
        _create_error_block(landings),
        _create_table_2_block(landings),
        rate_block(ground, "Landings", "Safety of the ground at touchdown", INTERVAL_NOTE, "ground"),
    )


def run_times_section(subject: Subject) -> Section | None:
    """Compare the CPU time of the four stages with Table I; None if no case completed all stages."""
    frame, stages = landing_rows(subject), PAPER["stages"]
    if frame is None:
        return None
    durations = np.column_stack([numbers(frame, stage["column"]) for stage in stages])
    is_complete = np.isfinite(durations).all(axis=1)
    durations, rows_with_times, cases = durations[is_complete], frame[is_complete], int(is_complete.sum())
    if not cases:
        return None
    medians_s, percentiles_95_s = np.median(durations, axis=0), [rates.quantile(column, 0.95) for column in durations.T]
    paper_total_s, total_s = sum(stage["seconds"] for stage in stages), float(medians_s.sum())
    if total_s <= 0.0:
        return None
    # the factor scales the total run time to that of the paper
    factor, rows, data = paper_total_s / total_s, [], []
    for stage, median_s, p95_s in zip(stages, medians_s.tolist(), percentiles_95_s, strict=True):
        # medians of the columns with the simulated parameters of the stage, such as the number of features
        sizes = [rates.quantile(rates.finite_values(rows_with_times, name), 0.5) for name in stage["ours"]]
        text = NOTHING if np.isnan(sizes).any() else stage["wording"].format(*sizes)
        seconds = {"paper_s": stage["seconds"], "median_s": median_s, "p95_s": p95_s, "scaled_s": factor * median_s}
        data.append({"name": stage["name"], **seconds, "parameters": text})
        paper_times = [f"{stage['seconds']:.2f}", f"{100.0 * stage['seconds'] / paper_total_s:.0f} %"]
        times = [_milliseconds(median_s), f"{100.0 * median_s / total_s:.0f} %", _milliseconds(p95_s)]
        rows.append([stage["name"], *paper_times, *times, stage["parameters"], text])
    totals = [f"{paper_total_s:.2f}", "100 %", _milliseconds(total_s), "100 %", NOTHING]
    rows.append(["Total", *totals, NOTHING, NOTHING])
    times_head = ["Paper (s)", "Fraction of total", "Median here (ms)", "Fraction of total", "95 % quantile here (ms)"]
    head = ["Stage", *times_head, "Parameters of the paper", "Parameters here (medians)"]
    note = note_text("hda.run_times", flights=count(cases, "flight"))
    grid = drop_empty_columns(Grid(head, rows))
    block, section_data = Block(grid=grid, note=note), {"factor": factor, "cases": cases, "stages": data}
    title = "Run time by stage, compared with Table I of the paper"
    return Section("run-times", "Run time", title, [block], section_data)


def _milliseconds(seconds: float) -> str:
    return NOTHING if math.isnan(seconds) else f"{1e3 * seconds:,.1f}"
