"""Sections on landings: roughness threshold, faults, map errors, touchdowns, sites, and run times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports import kinds, rates
from marsyard.reports.papers import read_paper
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.statistics.samples import mean_interval, quantile_bounds
from marsyard.reports.wording import NOTHING, count, format_fraction, note_text, number, numbers
from marsyard.scenarios.landing.parameters import LanderParameters

PAPER = read_paper(Path(__file__).with_name("paper.toml"))
#: Columns of every row of a landing case.
_OWN = ("site_safe", "site_reported", "no_site_reported", "true_safe_fraction")
#: Minimum number of cases with a map for the section on map errors.
MIN_MAPS = 8


def landing_rows(subject: Subject) -> pd.DataFrame | None:
    """The rows of landing cases; None for other rows."""
    frame = subject.frame
    return frame if all(name in frame for name in _OWN) and len(frame) > 0 else None


def _threshold_rows(subject: Subject) -> pd.DataFrame | None:
    frame = landing_rows(subject)
    if frame is None:
        return None
    unsafe = numbers(frame, "footprints") - numbers(frame, "footprints_truly_safe")
    return frame.assign(footprints_not_safe=unsafe)


def _lander_limit_m(subject: Subject) -> float:
    limit = subject.run.parameter("lander", "max_roughness_m")
    return float(limit) if isinstance(limit, int | float) else LanderParameters().max_roughness_m


#: False alarms and misses against the roughness threshold, for the paper's remark on false positives.
THRESHOLD = kinds.SectionDeclaration(
    "threshold",
    "Threshold",
    "False alarms and misses by threshold of roughness",
    rows=_threshold_rows,
    requires=("false_alarms",),
    parts=(
        kinds.RateByCondition(
            by=kinds.Quantity("max_roughness_m", "Threshold of roughness (m)"),
            rates=(
                kinds.Rate(
                    "false_alarms", "False alarms", kinds.pooled_fraction("false_alarms", "footprints_truly_safe")
                ),
                kinds.Rate("missed", "Missed", kinds.pooled_fraction("missed", "footprints_not_safe")),
                kinds.Rate(
                    "called_safe_unsafe",
                    "Called safe, not safe",
                    kinds.pooled_fraction("footprints_called_safe_unsafe", "footprints_called_safe"),
                ),
                kinds.Rate(
                    "found",
                    "Site found, of those with one",
                    kinds.flag_rate("site_reported", "wide_site_exists"),
                    False,
                ),
                kinds.Rate("safe", "Sites truly safe", kinds.flag_rate("site_safe", "site_reported"), False),
            ),
            cases="Flights",
            ylabel="share of footprints",
            text="The paper: both results of its Fig. 7 have false positive hazards, caused by a low threshold of "
            "roughness and by noise of the map; a higher one would remove them. It gives no numbers.",
            note="False alarms: of truly safe footprints. Missed: of footprints that are not truly safe, for slope or "
            "roughness.",
            caption="Shares of footprints against the threshold; dashed: what the lander can stand on.",
            limit=("the lander's limit", _lander_limit_m),
            data="thresholds",
        ),
    ),
)


def _fault_words(fault: str, size: float) -> tuple[str, str]:
    description = PAPER["fault_names"].get(fault, {"name": fault.replace("_", " "), "unit": "number"})
    name, unit = description["name"], description.get("unit")
    if unit is None or math.isnan(size):
        return name, ""
    if unit == "share":
        return name, f"{100.0 * size:g} %"
    return name, f"{size:g}" if unit == "number" else f"{size:g} {unit}"


def answers(frame: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
    """Outcomes of the search; each row has one of them."""
    reported, safe, refused = (rates.flag(frame, name) for name in ("site_reported", "site_safe", "no_site_reported"))
    finished = frame["site_reported"].notna().to_numpy(dtype=np.bool_)
    return {
        "safe": reported & safe,
        "wrong": reported & ~safe,
        "refused": refused,
        "unconverged": finished & ~reported & ~refused,
        "unfinished": ~finished,
    }


def _median(frame: pd.DataFrame, column: str) -> float:
    return rates.quantile(rates.known(frame, column), 0.5)


def _two_digits(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.2f}"


FAULT_OUTCOMES = kinds.OutcomesBySize(
    outcomes=lambda frame, _: answers(frame),
    styles={
        "safe": ("safe site", "full"),
        "refused": ("no safe site", "hatched"),
        "unconverged": ("not converged", "dotted"),
        "wrong": ("wrong", "crossed"),
    },
    cases="Flights",
    wording=_fault_words,
    further=(
        ("Touchdown off (m)", "off_m", lambda rows: _median(rows, "touchdown_error_m"), _two_digits),
        ("Sinking (m/s)", "sink_m_s", lambda rows: _median(rows, "touchdown_sink_m_s"), _two_digits),
    ),
    caption="Full: a truly safe site. Hatched: no safe site. Dotted: not converged. Crossed: a site that is not safe.",
    note=note_text("hda.faults", confidence=format_fraction(CONFIDENCE)),
)
FAULTS = kinds.SectionDeclaration("landing-faults", "Faults", "Faults by size", (FAULT_OUTCOMES,), rows=landing_rows)


def map_rows(subject: Subject) -> pd.DataFrame | None:
    """Cases with a map, with errors as fractions of height and range; None if few, or without varying conditions."""
    frame = landing_rows(subject)
    if frame is None or not (rates.varies(frame, "texture") and rates.varies(frame, "baseline_fraction")):
        return None
    shares = {
        "rms_share": numbers(frame, "elevation_rms_m") / numbers(frame, "height_m"),
        "noise_share": numbers(frame, "elevation_noise_m") / numbers(frame, "height_m"),
        "altimeter_share": np.abs(numbers(frame, "range_error_m")) / numbers(frame, "range_m"),
    }
    mapped = pd.DataFrame(frame.assign(**shares)[np.isfinite(shares["rms_share"])])
    return mapped if len(mapped) >= MIN_MAPS else None


#: Errors of the map; columns of `map_rows`.
_MAP_ERRORS = (
    kinds.Quantity("rms_share", "elevation error rms (% of height)", 100.0),
    kinds.Quantity("noise_share", "elevation error rms without its plane (% of height)", 100.0),
    kinds.Quantity("slope_error_rms_deg", "slope error rms (deg)"),
)
#: Conditions of the map errors, as applied.
MAP_EFFECTS = kinds.Scatter(
    x=(
        kinds.Quantity("baseline_fraction", "baseline over height"),
        kinds.Quantity("texture", "texture over the site's"),
        kinds.Quantity("grid_px", "grid spacing (px)"),
        kinds.Quantity("level_error_deg", "error of the vertical (deg)"),
        kinds.Quantity("altimeter_share", "altimeter's error (% of the range)", 100.0),
    ),
    y=_MAP_ERRORS,
    heading="Dependence on conditions",
    caption="Every case, and medians of bins with equally many cases; scales of the errors are logarithmic.",
    logarithmic=True,
)
MAP_ERRORS = kinds.SectionDeclaration(
    "map-errors",
    "Map",
    "Errors of the elevation map",
    rows=map_rows,
    parts=(
        kinds.Quantiles(
            _MAP_ERRORS,
            {"5 %": 0.05, "Median": 0.5, "95 %": 0.95},
            heading="Errors of the maps",
            note=note_text("hda.map"),
            data="maps",
        ),
        MAP_EFFECTS,
    ),
)

#: Errors of the touchdown.
TOUCHDOWN_ERRORS = (
    kinds.Quantity("touchdown_error_gps_m", "by averaged GPS, as in the paper"),
    kinds.Quantity("touchdown_error_m", "by truth"),
    kinds.Quantity("touchdown_error_estimated_m", "by the filter's estimate"),
)
_DEVIATIONS = ("gps_deviation_north_m", "gps_deviation_east_m")


def _landing_rows(subject: Subject) -> pd.DataFrame | None:
    frame = landing_rows(subject)
    return None if frame is None else frame[rates.flag(frame, "landed")]


def _table_2(landed: pd.DataFrame, subject: Subject, key: str) -> kinds.Drawn:
    """The paper's runs, their mean, and ours by each measure."""
    runs: Sequence[Mapping[str, float]] = PAPER["landings"]
    columns = ("error_m", "north_m", "east_m", "run_time_s")
    paper = {f"run {run['run']}": (1, [run[name] for name in columns]) for run in runs}
    paper["mean"] = len(runs), [float(np.mean([run[name] for run in runs])) for name in columns]
    rows = [
        [f"paper, {name}", str(n), f"{error:.2f}", NOTHING, f"{north:.2f}", f"{east:.2f}", f"{taken:.1f} s"]
        for name, (n, (error, north, east, taken)) in paper.items()
    ]
    deviations = {name: rates.known(landed, name) for name in _DEVIATIONS}
    taken_s = rates.known(landed, "estimation_time_s")
    groups, means, intervals = rates.terrain_groups(landed), {}, {}
    for one in TOUCHDOWN_ERRORS:
        values = one.values(landed)
        finite = np.isfinite(values)
        if finite.any():
            low, high = mean_interval(values[finite], CONFIDENCE, None if groups is None else groups[finite])
            means[one.column], intervals[one.column] = float(values[finite].mean()), (low, high)
            text = f"mean {number(means[one.column])} ({number(low)} to {number(high)})"
            spread = " to ".join(number(float(end)) for end in np.quantile(values[finite], (0.05, 0.95)))
            run_time = f"{1e3 * float(np.median(taken_s)):.0f} ms here" if taken_s.size else NOTHING
            off = [f"{each.mean():.2f}" if each.size else NOTHING for each in deviations.values()]
            rows.append([f"ours, {one.title}", f"{int(finite.sum()):,}", text, spread, *off, run_time])
    head = ["", "Landings", "Position error (m)", "90 % of errors (m)", "Northing dev. (m)", "Easting dev. (m)"]
    note = note_text("hda.touchdown", confidence=format_fraction(CONFIDENCE))
    data = {
        "landings": len(landed),
        "mean_m": means,
        "mean_interval_m": intervals,
        "deviations_m": {name: float(values.mean()) for name, values in deviations.items() if values.size},
        "touchdown_safe": rates.flag_fraction(landed, "touchdown_safe").share
        if "touchdown_safe" in landed
        else math.nan,
        "paper_m": {str(run["run"]): run["error_m"] for run in runs},
    }
    return [Block(heading="Table II", grid=Grid([*head, "Run time"], rows), note=note)], data


TOUCHDOWN = kinds.SectionDeclaration(
    "touchdown",
    "Touchdown",
    "Touchdown, next to Table II",
    rows=_landing_rows,
    requires=("touchdown_error_gps_m", "touchdown_error_m"),
    parts=(
        kinds.Distribution(
            TOUCHDOWN_ERRORS,
            ("distance of the touchdown from the site (m)", "share of landings"),
            "Fraction of landings up to each distance from the site; vertical: the paper's runs, by averaged GPS.",
            limits={"paper, runs 1, 3, 4": [run["error_m"] for run in PAPER["landings"]]},
        ),
        kinds.MadeBy(_table_2),
        kinds.RateTable(
            (
                kinds.Rate("touchdown", "touchdown on safe ground", kinds.flag_rate("touchdown_safe")),
                kinds.Rate("site", "safe site", kinds.flag_rate("site_safe")),
            ),
            cases="Landings",
            heading="Ground under the helicopter",
            data="ground",
            shared=False,
        ),
    ),
)

#: Truth of the ground in both pictures, best first, and outcomes of the search. A wide safe site is safe with its whole
#: surroundings up to a lander's radius.
GROUNDS = ("wide safe site", "narrow safe site", "no safe site")
ANSWERS = ("safe site, truly safe", "site, not safe", "no safe site", "not converged", "not finished")


def site_shares(frame: pd.DataFrame) -> dict[str, rates.Share]:
    """Fractions of right answers by the truth of the ground, as far as they have cases."""
    reported, none, roomy, landed = (
        rates.flag(frame, name) for name in ("site_reported", "no_safe_site_exists", "wide_site_exists", "landed")
    )
    refused, safe = rates.flag(frame, "no_site_reported"), rates.flag(frame, "site_safe")
    narrow, right = rates.flag(frame, "safe_site_exists") & ~roomy, refused | (reported & safe)
    shares = {
        "chosen sites that are truly safe": rates.fraction_of(safe[reported], frame[reported]),
        "'no safe site', where none exists": rates.fraction_of(refused[none], frame[none]),
        "a site reported, where none exists": rates.fraction_of(reported[none], frame[none]),
        "a site reported, where a wide safe site exists": rates.fraction_of(reported[roomy], frame[roomy]),
        "a truly safe site or 'no safe site', where all safe sites are narrow": rates.fraction_of(
            right[narrow], frame[narrow]
        ),
        "ground mapped, of all flights": rates.fraction_of(rates.flag(frame, "converged"), frame),
        "landings on safe ground": rates.fraction_of(rates.flag(frame, "touchdown_safe")[landed], frame[landed]),
    }
    return {name: one for name, one in shares.items() if one.n}


def outcome_counts(frame: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Flights by truth (`GROUNDS`) and outcome (`ANSWERS`)."""
    roomy, exists, none = (
        rates.flag(frame, name) for name in ("wide_site_exists", "safe_site_exists", "no_safe_site_exists")
    )
    given = dict(zip(ANSWERS, answers(frame).values(), strict=True))
    truths = dict(zip(GROUNDS, (roomy, exists & ~roomy, none), strict=True))
    return {
        ground: {answer: int((of_ground & mask).sum()) for answer, mask in given.items()}
        for ground, of_ground in truths.items()
    }


def draw_outcomes(frame: pd.DataFrame, subject: Subject, key: str) -> kinds.Drawn:
    """Outcomes of the search by the truth of the ground."""
    counts = outcome_counts(frame)
    rows = [[ground, *(f"{of_answer[name]:,}" for name in ANSWERS)] for ground, of_answer in counts.items()]
    note = note_text("hda.outcomes")
    block = Block(heading="By true ground", grid=Grid(["The pictures show", *ANSWERS], rows), note=note)
    return [block], {"outcomes": counts}


def distances(frame: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
    """Distances of reported sites and of touchdowns to the nearest true hazard, metres."""
    reported = frame[rates.flag(frame, "site_reported")]
    return {
        "site, where one was reported": rates.known(reported, "site_hazard_distance_m"),
        "touchdown": rates.known(frame, "touchdown_hazard_distance_m"),
    }


def distance_grid(curves: Mapping[str, Float[np.ndarray, " n"]]) -> Grid:
    """Minimum distance, low quantiles, and the bound of the 5 % quantile."""
    rows = []
    for name, values in curves.items():
        if values.size:
            bound = quantile_bounds(values, 0.05, CONFIDENCE)[0]
            texts = [number(float(one)) for one in (values.min(), *np.quantile(values, (0.05, 0.5)))]
            rows.append([name, f"{values.size:,}", *texts, NOTHING if math.isinf(bound) else number(bound)])
    return Grid(["Distance (m)", "Cases", "Minimum", "5 % quantile", "Median", "Bound of the 5 % quantile"], rows)


def run_times_section(subject: Subject) -> Section | None:
    """Processor time of the four stages next to Table I; None if no case reached all of them."""
    frame, stages = landing_rows(subject), PAPER["stages"]
    if frame is None:
        return None
    durations = np.column_stack([numbers(frame, stage["column"]) for stage in stages])
    complete = np.isfinite(durations).all(axis=1)
    durations, chosen, cases = durations[complete], frame[complete], int(complete.sum())
    if not cases or not durations.sum() > 0.0:
        return None
    median, late = np.median(durations, axis=0), np.quantile(durations, 0.95, axis=0)
    paper, ours = sum(stage["seconds"] for stage in stages), float(median.sum())
    factor, rows, data = paper / ours, [], []
    for stage, middle, slow in zip(stages, median.tolist(), late.tolist(), strict=True):
        sizes = [rates.quantile(rates.known(chosen, name), 0.5) for name in stage["ours"]]
        text = NOTHING if np.isnan(sizes).any() else stage["wording"].format(*sizes)
        seconds = {"paper_s": stage["seconds"], "median_s": middle, "late_s": slow, "scaled_s": factor * middle}
        data.append({"name": stage["name"], **seconds, "parameters": text})
        times = [f"{stage['seconds']:.2f}", f"{1e3 * middle:.1f}", f"{1e3 * slow:.1f}", f"{factor * middle:.2f}"]
        rows.append([stage["name"], *times, stage["parameters"], text])
    rows.append(["Together", f"{paper:.2f}", f"{1e3 * ours:.1f}", NOTHING, f"{ours * factor:.2f}", NOTHING, NOTHING])
    head = ["Stage", "Paper (s)", "Here, median (ms)", "95 %", "Scaled (s)", "Paper's parameters", "Parameters here"]
    note = note_text("hda.run_times", cases=count(cases, "case"), factor=number(factor))
    block, data_of_section = Block(grid=Grid(head, rows), note=note), {"factor": factor, "cases": cases, "stages": data}
    return Section("run-times", "Run time", "Run time by stage, next to Table I", [block], data_of_section)
