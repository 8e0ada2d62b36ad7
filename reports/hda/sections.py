"""Sections on landings: roughness threshold, faults, map errors, touchdowns, sites, and run times.

Tables, figures and "the paper" refer to Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports import rates, section_kinds
from marsyard.reports.papers import read_paper
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.statistics.samples import mean_interval, quantile_bounds
from marsyard.reports.wording import NOTHING, count, format_fraction, note_text, number, numbers
from marsyard.scenarios.landing.parameters import LanderParameters

PAPER = read_paper(Path(__file__).with_name("paper.toml"))
#: Columns by which rows of landing cases are recognized.
_REQUIRED_COLUMNS = ("site_safe", "site_reported", "no_site_reported", "true_safe_fraction")
#: Minimum number of cases with a map for the section on map errors.
MIN_MAPS = 8


def landing_rows(subject: Subject) -> pd.DataFrame | None:
    """Return the rows if they are those of landing cases; None for other rows."""
    frame = subject.frame
    return frame if all(name in frame for name in _REQUIRED_COLUMNS) and len(frame) > 0 else None


def _threshold_rows(subject: Subject) -> pd.DataFrame | None:
    """Return the rows of landing cases with the additional column `footprints_not_safe`; None for other rows.

    The column is the number of footprints that are not truly safe.
    """
    frame = landing_rows(subject)
    if frame is None:
        return None
    n_unsafe = numbers(frame, "footprints") - numbers(frame, "footprints_truly_safe")
    return frame.assign(footprints_not_safe=n_unsafe)


def _lander_limit_m(subject: Subject) -> float:
    """Return the roughness limit of the campaign's lander, or the default limit."""
    limit = subject.run.parameter("lander", "max_roughness_m")
    return float(limit) if isinstance(limit, int | float) else LanderParameters().max_roughness_m


#: False alarms and misses against the roughness threshold, to check the paper's remark on false positives.
THRESHOLD = section_kinds.SectionDeclaration(
    "threshold",
    "Threshold",
    "False alarms and misses by roughness threshold",
    rows=_threshold_rows,
    requires=("false_alarms",),
    parts=(
        section_kinds.RateByCondition(
            by=section_kinds.Quantity("max_roughness_m", "Roughness threshold (m)"),
            rates=(
                section_kinds.Rate(
                    "false_alarms",
                    "False alarms",
                    section_kinds.pooled_fraction("false_alarms", "footprints_truly_safe"),
                ),
                section_kinds.Rate("missed", "Missed", section_kinds.pooled_fraction("missed", "footprints_not_safe")),
                section_kinds.Rate(
                    "called_safe_unsafe",
                    "Classified as safe, not truly safe",
                    section_kinds.pooled_fraction("footprints_called_safe_unsafe", "footprints_called_safe"),
                ),
                section_kinds.Rate(
                    "site_reported",
                    "Site reported, if a wide safe site exists",
                    section_kinds.flag_rate("site_reported", "wide_site_exists"),
                    in_figure=False,
                ),
                section_kinds.Rate(
                    "safe", "Sites truly safe", section_kinds.flag_rate("site_safe", "site_reported"), in_figure=False
                ),
            ),
            cases="Flights",
            ylabel="fraction of footprints",
            text="According to the paper, both results of its Fig. 7 contain false positive hazards. The causes are a "
            "low roughness threshold and noise of the map. A higher threshold would remove them. The paper gives no "
            "numbers.",
            note="False alarms are a fraction of the truly safe footprints. Missed hazards are a fraction of the "
            "footprints that are not truly safe, because of slope or roughness.",
            caption="Fractions of footprints against the threshold. Dashed line: roughness limit of the lander.",
            limit=("the lander's limit", _lander_limit_m),
            data="thresholds",
        ),
    ),
)


def _describe_fault(fault: str, size: float) -> tuple[str, str]:
    """Return the name of a fault, and its size with the unit; the size is empty if it is NaN, or without a unit."""
    description = PAPER["fault_names"].get(fault, {"name": fault.replace("_", " "), "unit": "number"})
    name, unit = description["name"], description.get("unit")
    if unit is None or math.isnan(size):
        return name, ""
    if unit == "fraction":
        return name, f"{100.0 * size:g} %"
    return name, f"{size:g}" if unit == "number" else f"{size:g} {unit}"


def classify_answers(frame: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
    """Create a mask for each outcome of the search, in the order of `ANSWERS`; each row has exactly one outcome.

    `unconverged`: finished, but the algorithm reported neither a site nor that no site is safe.
    """
    is_reported, is_safe, is_refused = (
        rates.flag_mask(frame, name) for name in ("site_reported", "site_safe", "no_site_reported")
    )
    is_finished = frame["site_reported"].notna().to_numpy(dtype=np.bool_)
    return {
        "safe": is_reported & is_safe,
        "wrong": is_reported & ~is_safe,
        "refused": is_refused,
        "unconverged": is_finished & ~is_reported & ~is_refused,
        "unfinished": ~is_finished,
    }


def _median(frame: pd.DataFrame, column: str) -> float:
    return rates.quantile(rates.finite_values(frame, column), 0.5)


def _two_decimals(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.2f}"


FAULT_OUTCOMES = section_kinds.OutcomesBySize(
    outcomes=lambda frame, _: classify_answers(frame),
    styles={
        "safe": ("safe site", "full"),
        "refused": ("no safe site", "hatched"),
        "unconverged": ("not converged", "dotted"),
        "wrong": ("wrong", "crossed"),
    },
    cases="Flights",
    wording=_describe_fault,
    extra_columns=(
        ("Touchdown error (m)", "off_m", lambda rows: _median(rows, "touchdown_error_m"), _two_decimals),
        ("Sink rate (m/s)", "sink_m_s", lambda rows: _median(rows, "touchdown_sink_m_s"), _two_decimals),
    ),
    caption="Solid bars: truly safe site. Hatched: 'no safe site'. Dotted: not converged. Cross-hatched: unsafe site.",
    note=note_text("hda.faults", confidence=format_fraction(CONFIDENCE)),
)
FAULTS = section_kinds.SectionDeclaration(
    "landing-faults", "Faults", "Faults by size", (FAULT_OUTCOMES,), rows=landing_rows
)


def map_rows(subject: Subject) -> pd.DataFrame | None:
    """Select cases with a map, and add errors relative to height and range.

    Returns None for fewer than `MIN_MAPS` maps, or if texture or baseline do not vary.
    """
    frame = landing_rows(subject)
    if frame is None or not (rates.varies(frame, "texture") and rates.varies(frame, "baseline_fraction")):
        return None
    fractions = {
        "rms_fraction": numbers(frame, "elevation_rms_m") / numbers(frame, "height_m"),
        "noise_fraction": numbers(frame, "elevation_noise_m") / numbers(frame, "height_m"),
        "altimeter_fraction": np.abs(numbers(frame, "range_error_m")) / numbers(frame, "range_m"),
    }
    rows_with_map = pd.DataFrame(frame.assign(**fractions)[np.isfinite(fractions["rms_fraction"])])
    return rows_with_map if len(rows_with_map) >= MIN_MAPS else None


#: Errors of the map; columns of `map_rows`.
_MAP_ERRORS = (
    section_kinds.Quantity("rms_fraction", "elevation error rms (% of height)", 100.0),
    section_kinds.Quantity(
        "noise_fraction", "elevation error rms after removal of its mean plane (% of height)", 100.0
    ),
    section_kinds.Quantity("slope_error_rms_deg", "slope error rms (deg)"),
)
#: Dependence of the map errors on conditions.
MAP_EFFECTS = section_kinds.Scatter(
    x=(
        section_kinds.Quantity("baseline_fraction", "baseline / height"),
        section_kinds.Quantity("texture", "texture contrast divided by its nominal value"),
        section_kinds.Quantity("grid_px", "grid spacing (px)"),
        section_kinds.Quantity("level_error_deg", "error of the estimated vertical (deg)"),
        section_kinds.Quantity("altimeter_fraction", "altimeter error (% of range)", 100.0),
    ),
    y=_MAP_ERRORS,
    heading="Dependence on conditions",
    caption="Points are cases, lines are medians of bins with equal numbers of cases. The error axes are logarithmic.",
    logarithmic=True,
)
MAP_ERRORS = section_kinds.SectionDeclaration(
    "map-errors",
    "Map",
    "Errors of the elevation map",
    rows=map_rows,
    parts=(
        section_kinds.Quantiles(
            _MAP_ERRORS,
            {"5 %": 0.05, "Median": 0.5, "95 %": 0.95},
            heading="Errors of the maps",
            note=note_text("hda.map"),
            data="maps",
        ),
        MAP_EFFECTS,
    ),
)

#: Three measures of the distance from touchdown to site.
TOUCHDOWN_ERRORS = (
    section_kinds.Quantity("touchdown_error_gps_m", "averaged GPS as in the paper"),
    section_kinds.Quantity("touchdown_error_m", "true touchdown"),
    section_kinds.Quantity("touchdown_error_estimated_m", "navigation filter estimate"),
)
_DEVIATIONS = ("gps_deviation_north_m", "gps_deviation_east_m")


def _landed_rows(subject: Subject) -> pd.DataFrame | None:
    frame = landing_rows(subject)
    return None if frame is None else frame[rates.flag_mask(frame, "landed")]


def _create_table_2_blocks(landings: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
    """Create Table II: the paper's runs and their mean, and the campaign's landings by each of `TOUCHDOWN_ERRORS`."""
    runs: Sequence[Mapping[str, float]] = PAPER["landings"]
    columns = ("error_m", "north_m", "east_m", "run_time_s")
    paper = {f"run {run['run']}": (1, [run[name] for name in columns]) for run in runs}
    paper["mean"] = len(runs), [float(np.mean([run[name] for run in runs])) for name in columns]
    rows = [
        [f"paper, {name}", str(n), f"{error:.2f}", NOTHING, f"{north:.2f}", f"{east:.2f}", f"{run_time_s:.1f} s"]
        for name, (n, (error, north, east, run_time_s)) in paper.items()
    ]
    deviations = {name: rates.finite_values(landings, name) for name in _DEVIATIONS}
    run_times_s = rates.finite_values(landings, "estimation_time_s")
    groups, means, intervals = rates.terrain_groups(landings), {}, {}
    for measure in TOUCHDOWN_ERRORS:
        values = measure.values(landings)
        finite = np.isfinite(values)
        if finite.any():
            lower, upper = mean_interval(values[finite], CONFIDENCE, None if groups is None else groups[finite])
            means[measure.column], intervals[measure.column] = float(values[finite].mean()), (lower, upper)
            interval = f" ({number(lower)} to {number(upper)})" if math.isfinite(lower) else ""
            text = f"mean {number(means[measure.column])}{interval}"
            quantiles = [rates.quantile(values[finite], probability) for probability in (0.05, 0.95)]
            range_text = NOTHING if math.isnan(quantiles[0]) else " to ".join(map(number, quantiles))
            run_time = (
                f"median {1e3 * float(np.median(run_times_s)):.0f} ms (this host)" if run_times_s.size else NOTHING
            )
            means_m = [f"{values.mean():.2f}" if values.size else NOTHING for values in deviations.values()]
            rows.append(
                [f"this campaign, {measure.title}", f"{int(finite.sum()):,}", text, range_text, *means_m, run_time]
            )
    head = ["", "Landings", "Position error (m)", "5 % to 95 % quantiles (m)", "GPS SD north (m)", "GPS SD east (m)"]
    note, column = note_text("hda.touchdown", confidence=format_fraction(CONFIDENCE)), "touchdown_safe"
    safe_fraction = rates.flag_fraction(landings, column).fraction if column in landings else math.nan
    data = {
        "landings": len(landings),
        "mean_m": means,
        "mean_interval_m": intervals,
        "deviations_m": {name: float(values.mean()) for name, values in deviations.items() if values.size},
        "touchdown_safe": safe_fraction,
        "paper_m": {str(run["run"]): run["error_m"] for run in runs},
    }
    return [Block(heading="Table II", grid=Grid([*head, "Run time"], rows), note=note)], data


TOUCHDOWN = section_kinds.SectionDeclaration(
    "touchdown",
    "Touchdown",
    "Touchdown error compared with Table II of the paper",
    rows=_landed_rows,
    requires=("touchdown_error_gps_m", "touchdown_error_m"),
    parts=(
        section_kinds.Distribution(
            TOUCHDOWN_ERRORS,
            ("distance of the touchdown from the site (m)", "fraction of landings"),
            "Cumulative distribution of the distance from touchdown to site. Vertical lines: runs of the paper.",
            limits={"paper, runs 1, 3 and 4": [run["error_m"] for run in PAPER["landings"]]},
        ),
        section_kinds.CustomBlocks(_create_table_2_blocks),
        section_kinds.RateTable(
            (
                section_kinds.Rate("touchdown", "touchdown on safe ground", section_kinds.flag_rate("touchdown_safe")),
                section_kinds.Rate(
                    "site",
                    "target of the descent (reported or a-priori site) is truly safe",
                    section_kinds.flag_rate("descent_target_safe"),
                ),
            ),
            cases="Landings",
            heading="Safety of the touchdown point",
            data="ground",
            shared=False,
        ),
    ),
)

#: Classes of the true ground that both images show, best first. All positions within one lander radius of a wide safe
#: site are also safe.
GROUNDS = ("wide safe site", "narrow safe site", "no safe site")
#: Names of the outcomes of `classify_answers`, in the same order; "crashed" means every case that did not finish.
ANSWERS = ("truly safe site", "unsafe site", "'no safe site'", "not converged", "crashed")


def site_fractions(frame: pd.DataFrame) -> dict[str, rates.CaseFraction]:
    """Compute fractions of correct answers by class of the true ground; classes without cases are omitted."""
    is_reported, has_no_safe_site, has_wide_site, has_landed = (
        rates.flag_mask(frame, name) for name in ("site_reported", "no_safe_site_exists", "wide_site_exists", "landed")
    )
    is_refused, is_safe = rates.flag_mask(frame, "no_site_reported"), rates.flag_mask(frame, "site_safe")
    has_narrow_site = rates.flag_mask(frame, "safe_site_exists") & ~has_wide_site
    is_correct = is_refused | (is_reported & is_safe)
    fractions = {
        "selected sites that are truly safe": rates.fraction_of(is_safe[is_reported], frame[is_reported]),
        "answer 'no safe site' if none exists": rates.fraction_of(
            is_refused[has_no_safe_site], frame[has_no_safe_site]
        ),
        "site reported although none is safe": rates.fraction_of(
            is_reported[has_no_safe_site], frame[has_no_safe_site]
        ),
        "site reported if a wide safe site exists": rates.fraction_of(is_reported[has_wide_site], frame[has_wide_site]),
        "truly safe site or 'no safe site' if all safe sites are narrow": rates.fraction_of(
            is_correct[has_narrow_site], frame[has_narrow_site]
        ),
        "converged (of all flights)": rates.fraction_of(rates.flag_mask(frame, "converged"), frame),
        "landings on safe ground": rates.fraction_of(
            rates.flag_mask(frame, "touchdown_safe")[has_landed], frame[has_landed]
        ),
    }
    return {name: fraction for name, fraction in fractions.items() if fraction.n}


def outcome_counts(frame: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Count flights by true ground (`GROUNDS`) and outcome (`ANSWERS`)."""
    has_wide_site, has_safe_site, has_no_safe_site = (
        rates.flag_mask(frame, name) for name in ("wide_site_exists", "safe_site_exists", "no_safe_site_exists")
    )
    answer_masks = dict(zip(ANSWERS, classify_answers(frame).values(), strict=True))
    ground_masks = dict(zip(GROUNDS, (has_wide_site, has_safe_site & ~has_wide_site, has_no_safe_site), strict=True))
    return {
        ground: {answer: int((ground_mask & mask).sum()) for answer, mask in answer_masks.items()}
        for ground, ground_mask in ground_masks.items()
    }


def create_outcome_blocks(frame: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
    """Create the table of the outcomes of the search by class of the true ground."""
    counts = outcome_counts(frame)
    rows = [[ground, *(f"{answer_counts[name]:,}" for name in ANSWERS)] for ground, answer_counts in counts.items()]
    note = note_text("hda.outcomes")
    block = Block(heading="Answers by ground truth", grid=Grid(["Ground truth", *ANSWERS], rows), note=note)
    return [block], {"outcomes": counts}


def hazard_distances(frame: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
    """Collect the distances of reported sites and of touchdowns to the nearest true hazard, metres."""
    rows_with_site = frame[rates.flag_mask(frame, "site_reported")]
    return {
        "reported site": rates.finite_values(rows_with_site, "site_hazard_distance_m"),
        "touchdown": rates.finite_values(frame, "touchdown_hazard_distance_m"),
    }


def distance_grid(curves: Mapping[str, Float[np.ndarray, " n"]]) -> Grid:
    """Create a table of minimum distance, 5 % quantile, median, and lower bound of the 5 % quantile."""
    rows = []
    for name, values in curves.items():
        if values.size:
            bound = quantile_bounds(values, 0.05, CONFIDENCE)[0]
            texts = [number(float(value)) for value in (values.min(), *np.quantile(values, (0.05, 0.5)))]
            rows.append([name, f"{values.size:,}", *texts, NOTHING if math.isinf(bound) else number(bound)])
    return Grid(
        [
            "Distance (m)",
            "Cases",
            "Minimum",
            "5 % quantile",
            "Median",
            f"5 % quantile, lower bound at {format_fraction(CONFIDENCE)} confidence",
        ],
        rows,
    )


def _milliseconds(seconds: float) -> str:
    return NOTHING if math.isnan(seconds) else f"{1e3 * seconds:.1f}"


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
        times = [f"{stage['seconds']:.2f}", f"{1e3 * median_s:.1f}", _milliseconds(p95_s), f"{factor * median_s:.2f}"]
        rows.append([stage["name"], *times, stage["parameters"], text])
    times = [f"{paper_total_s:.2f}", f"{1e3 * total_s:.1f}", NOTHING, f"{total_s * factor:.2f}"]
    rows.append(["Total", *times, NOTHING, NOTHING])
    head = ["Stage", "Paper (s)", "Median (ms)", "95 % quantile (ms)", "Scaled (s)", "Paper's parameters", "Parameters"]
    note = note_text("hda.run_times", cases=count(cases, "case"), factor=number(factor))
    block, section_data = Block(grid=Grid(head, rows), note=note), {"factor": factor, "cases": cases, "stages": data}
    title = "Run time by stage, compared with Table I of the paper"
    return Section("run-times", "Run time", title, [block], section_data)
