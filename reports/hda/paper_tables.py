"""Sections that compare landings with the tables of the paper: touchdown errors (Table II) and run times (Table I).

The paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from marsyard.reports import rates, section_kinds
from marsyard.reports.hda.sections import (
    INTERVAL_NOTE,
    MIN_CURVE_VALUES,
    PAPER,
    draw_distribution,
    drop_empty_columns,
    landing_rows,
)
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, svg_figure
from marsyard.reports.statistics.samples import mean_interval
from marsyard.reports.wording import NOTHING, count, format_fraction, interval, number, numbers

#: Three measures of the distance from touchdown to site.
TOUCHDOWN_ERRORS = (
    section_kinds.Quantity("touchdown_error_gps_m", "averaged GPS, as in the paper"),
    section_kinds.Quantity("touchdown_error_m", "true touchdown"),
    section_kinds.Quantity("touchdown_error_estimated_m", "navigation filter"),
)
_DEVIATIONS = ("gps_deviation_north_m", "gps_deviation_east_m")
_TOUCHDOWN_NOTE = (
    "Averaged GPS: from the coordinates of the site to the GPS receiver's averaged positions after landing. True "
    "touchdown: from the true site to the true touchdown; the true site excludes the navigation error at the first "
    "image. Navigation filter: from the coordinates of the site to the touchdown that the filter estimates. GPS SD: "
    "standard deviation that the receiver reports. The site is the reported site. If the algorithm does not converge, "
    "it is the a-priori site, which is set before the images are processed. After the answer 'no safe site' the "
    "helicopter does not land."
)


def _landed_rows(subject: Subject) -> pd.DataFrame | None:
    frame = landing_rows(subject)
    return None if frame is None else frame[rates.flag_mask(frame, "landed")]


def _create_error_blocks(landings: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
    """Create the curves of touchdown errors; nothing for few landings."""
    errors = {measure.title: rates.finite_values(landings, measure.column) for measure in TOUCHDOWN_ERRORS}
    if max(values.size for values in errors.values()) < MIN_CURVE_VALUES:
        return [], {}
    runs = {"paper, runs 1, 3 and 4": [run["error_m"] for run in PAPER["landings"]]}
    labels = ("distance from touchdown to site (m)", "fraction of landings")
    figure = draw_distribution(errors, labels, limits=runs)
    return [Block(figures=[svg_figure(figure, key, "Fraction of landings up to each distance.")])], {}


def _create_table_2_blocks(landings: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
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
    return [
        Block(heading="Distances as in Table II", grid=drop_empty_columns(Grid(head, rows)), note=_TOUCHDOWN_NOTE)
    ], data


def _safe_at_apriori_site(landings: pd.DataFrame) -> rates.CaseFraction:
    rows = landings[~rates.flag_mask(landings, "site_reported")]
    return rates.fraction_of(rates.flag_mask(rows, "touchdown_safe"), rows)


TOUCHDOWN = section_kinds.SectionDeclaration(
    "touchdown",
    "Touchdown",
    "Distance from touchdown to site, compared with Table II of the paper",
    rows=_landed_rows,
    requires=("touchdown_error_gps_m", "touchdown_error_m"),
    parts=(
        section_kinds.CustomBlocks(_create_error_blocks),
        section_kinds.CustomBlocks(_create_table_2_blocks),
        section_kinds.RateTable(
            (
                section_kinds.Rate(
                    "touchdown",
                    "true touchdown on safe ground, all landings",
                    section_kinds.flag_rate("touchdown_safe"),
                ),
                section_kinds.Rate(
                    "touchdown_reported",
                    "true touchdown on safe ground, landings at a reported site",
                    section_kinds.flag_rate("touchdown_safe", "site_reported"),
                ),
                section_kinds.Rate(
                    "touchdown_apriori",
                    "true touchdown on safe ground, landings at the a-priori site",
                    _safe_at_apriori_site,
                ),
                section_kinds.Rate(
                    "site",
                    "site of the landing (reported or a-priori) is truly safe",
                    section_kinds.flag_rate("descent_target_safe"),
                ),
            ),
            cases="Landings",
            heading="Safety of the ground at touchdown",
            note=INTERVAL_NOTE,
            data="ground",
        ),
    ),
)


def run_times_section(subject: Subject) -> Section | None:
    """Compare the CPU time of the four stages with Table I; None if no case completed all stages."""
    frame, stages = landing_rows(subject), PAPER["stages"]
    if frame is None:
        return None
    durations = np.column_stack([numbers(frame, stage["column"]) for stage in stages])
    is_complete = np.isfinite(durations).all(axis=1)
    durations, rows_with_times, cases = durations[is_complete], frame[is_complete], int(is_complete.sum())
    if not cases or not durations.sum() > 0.0:
        return None
    medians_s, percentiles_95_s = np.median(durations, axis=0), [rates.quantile(column, 0.95) for column in durations.T]
    paper_total_s, total_s = sum(stage["seconds"] for stage in stages), float(medians_s.sum())
    # the factor scales the total run time to that of the paper
    factor, rows, data = paper_total_s / total_s, [], []
    for stage, median_s, p95_s in zip(stages, medians_s.tolist(), percentiles_95_s, strict=True):
        # medians of the columns with the simulated parameters of the stage, such as the number of features
        sizes = [rates.quantile(rates.finite_values(rows_with_times, name), 0.5) for name in stage["ours"]]
        text = NOTHING if np.isnan(sizes).any() else stage["wording"].format(*sizes)
        seconds = {"paper_s": stage["seconds"], "median_s": median_s, "p95_s": p95_s, "scaled_s": factor * median_s}
        data.append({"name": stage["name"], **seconds, "parameters": text})
        fractions = [f"{100.0 * stage['seconds'] / paper_total_s:.0f} %", f"{100.0 * median_s / total_s:.0f} %"]
        times = [f"{stage['seconds']:.2f}", fractions[0], _milliseconds(median_s), fractions[1], _milliseconds(p95_s)]
        rows.append([stage["name"], *times, stage["parameters"], text])
    totals = [f"{paper_total_s:.2f}", "100 %", _milliseconds(total_s), "100 %", NOTHING]
    rows.append(["Total", *totals, NOTHING, NOTHING])
    times_head = ["Paper (s)", "Fraction of total", "Median here (ms)", "Fraction of total", "95 % quantile here (ms)"]
    head = ["Stage", *times_head, "Parameters of the paper", "Parameters here (medians)"]
    note = (
        f"CPU time of {count(cases, 'flight')} with a map, on this host. The total is the sum of the medians. The "
        "paper's processor in Table I is a 400 MHz R12000. The parameters differ, so only the fractions of the total "
        "are comparable, not the times. Dense matching counts as terrain map generation, interpolation of the map as "
        "hazard detection, and estimation of the scale as structure from motion. The first case of a worker includes "
        "the loading of compiled code. `make bench` measures the times with the paper's parameters."
    )
    grid = drop_empty_columns(Grid(head, rows))
    block, section_data = Block(grid=grid, note=note), {"factor": factor, "cases": cases, "stages": data}
    title = "Run time by stage, compared with Table I of the paper"
    return Section("run-times", "Run time", title, [block], section_data)


def _milliseconds(seconds: float) -> str:
    return NOTHING if math.isnan(seconds) else f"{1e3 * seconds:,.1f}"
