"""Content of a campaign's page: the context of its template."""

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.algorithms.faults import Fault
from marsyard.campaigns.definition.toml_models import description_at
from marsyard.reports import explorer, figures, page_environment, provenance, tables
from marsyard.reports.column_values import numbers
from marsyard.reports.gallery import CASES_PER_GROUP, gallery_views
from marsyard.reports.overall import OverallVerdict, multiplicity_text
from marsyard.reports.populations import engine_failed, outcome_counts
from marsyard.reports.presentation import presentations, system_presentation
from marsyard.reports.provenance import read_algorithms
from marsyard.reports.rates import CONFIDENCE, terrain_groups
from marsyard.reports.requirement_cases import CaseFinder
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Grid, Section, Subject, SvgFigure, svg_figure
from marsyard.reports.statistics.drivers import estimate_driver
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.tables import statistics_grid
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import (
    NOTHING,
    coefficient,
    count,
    format_fraction,
    format_value,
    label,
    number,
    percent,
    requirement_text,
)
from marsyard.scenarios.columns import split_unit
from marsyard.scenarios.systems import scenario, scenario_names


def error_figures(frame: pd.DataFrame, all_cases: pd.DataFrame, metric: str, bound: float | None) -> list[SvgFigure]:
    """Draw a scatter plot of a metric for the cases in `frame`; histogram and distribution for those in `all_cases`."""
    scatter = "Error of each case." if bound is None else "Error of each case. The dashed circle is the requirement."
    histogram = "Histogram of the error magnitude."
    entries: list[tuple[str, Figure | None, str]] = [("scatter", figures.error_scatter(frame, metric, bound), scatter)]
    if figures.needs_enlarged_figure(frame, metric, bound):
        figure = figures.error_scatter(frame, metric, bound, enlarged=True)
        entries.append(("close", figure, "Enlarged view of the same errors."))
    entries.append(("histogram", figures.error_histogram(all_cases, metric, bound), histogram))
    caption = "Cumulative distribution of the error magnitude."
    entries.append(("distribution", figures.error_distribution(all_cases, metric, bound), caption))
    return _svg_figures(entries)


def driver_figures(frame: pd.DataFrame, metric: str, bound: float | None, columns: Sequence[str]) -> list[SvgFigure]:
    """Draw a metric against the conditions `columns`, with rank correlations."""
    entries, magnitude, groups = [], np.abs(numbers(frame, metric)), terrain_groups(frame)
    for index, column in enumerate(columns):
        driver = estimate_driver(numbers(frame, column), magnitude, groups, CONFIDENCE)
        sentences = []
        if driver is not None:
            correlation, lower, upper = map(coefficient, (driver.correlation, driver.lower, driver.upper))
            interval = f"{lower} to {upper} at {format_fraction(CONFIDENCE)} confidence"
            sentences.append(f"Rank correlation {correlation} ({interval}).")
        n_beyond = figures.count_beyond_axis(frame, metric, column, bound)
        if n_beyond:
            sentences.append(f"Hollow marks at the upper edge: {count(n_beyond, 'error')} beyond the axis.")
        entries.append(
            (f"driver{index}", figures.error_scatter_against(frame, metric, column, bound), " ".join(sentences))
        )
    return _svg_figures(entries)


def outcome_figures(frame: pd.DataFrame) -> list[SvgFigure]:
    """Draw the number of cases by outcome."""
    caption = "Solid bars: cases with an answer. Hatched bars: cases without an answer."
    if engine_failed(frame).any():
        caption += " Cross-hatched bars: cases in which the program failed (crashed cases)."
    return _svg_figures([("outcomes", figures.outcome_bars(frame), caption)])


def _svg_figures(entries: Sequence[tuple[str, Figure | None, str]]) -> list[SvgFigure]:
    return [svg_figure(figure, key, caption) for key, figure, caption in entries if figure is not None]


#: Keys of a dispersion that are not parameters of its distribution.
_NON_PARAMETER_KEYS = ("distribution", "source", "unit", "description")


def dispersion_grid(run: StoredRun) -> Grid:
    """Create a table of the dispersions, with the minimum, mean and maximum of the stored values."""
    rows, scenario_name = [], str(run.recorded("scenario"))
    # a custom scenario is not imported: a report runs no code that a folder names
    model = scenario(scenario_name).parameters_type if scenario_name in scenario_names() else None
    for path, entry in table(run.recorded("dispersions")).items():
        dispersion, path_parts = table(entry), str(path).split(".")
        minimum, mean, maximum = [NOTHING] * 3
        if path in run.frame:
            values = pd.to_numeric(run.frame[path], errors="coerce").dropna()
            mean = f"{run.frame[path].nunique()} values"
            if len(values) and not pd.api.types.is_bool_dtype(run.frame[path].dtype):
                minimum, mean, maximum = (
                    format_value(float(value)) for value in (values.min(), values.mean(), values.max())
                )
                if path_parts[-1] == "terrain":
                    mean = NOTHING  # the mean of numbers of terrains has no meaning
        # defaults, which follow a semicolon, do not apply to dispersed parameters
        meaning = str(dispersion.get("description") or (model and description_at(model, str(path))) or NOTHING)
        meaning, unit = meaning.split(";")[0], split_unit(path_parts[-1])[1]
        meaning += f" ({unit})" if unit and not meaning.endswith(f", {unit}") else ""
        source = str(dispersion.get("source") or NOTHING)
        rows.append([meaning, str(path), _distribution_text(dispersion), minimum, mean, maximum, source])
    return Grid(["Quantity", "Parameter", "Distribution", "Minimum", "Mean", "Maximum", "Source"], rows)


def _distribution_text(dispersion: Mapping[str, Any]) -> str:
    """Describe a recorded distribution: ``uniform, 0.6 to 1.2``."""
    name = str(dispersion.get("distribution", "?"))
    items = {key: value for key, value in dispersion.items() if key not in _NON_PARAMETER_KEYS and value is not None}
    if name == "choice" and set(items) == {"values"}:
        return f"one of {', '.join(str(value) for value in items['values'])}"
    texts = [f"{items.pop('low')} to {items.pop('high')}"] if {"low", "high"} <= set(items) else []
    limits = items.pop("truncate", None)
    texts += [f"{'SD' if key == 'sd' else key.replace('_', ' ')} {value}" for key, value in items.items()]
    if limits is not None:
        texts.append(f"from {limits[0]} to {limits[1]}")
    return ", ".join((name, *texts))


def verdict_row(verdict: Verdict) -> dict[str, Any]:
    """Format a verdict for the page.

    `strip` contains the data of the small diagram of rate, bounds and required rate: positions on its horizontal axis,
    in per cent of the length of the axis, and the label of its left end (`left`). None without bounds.
    """
    bounds_text, diagram = f"{percent(verdict.lower)} to {percent(verdict.upper)}", None
    if math.isnan(verdict.lower):
        bounds_text = NOTHING if math.isnan(verdict.estimate) else f"{percent(verdict.estimate)} observed"
    else:
        lowest = min(verdict.lower, verdict.probability)
        # the scale ends at 100 %; up to a fifth of it lies below the lower bound and the required rate
        scale_start = max(0.0, lowest - 0.25 * (1.0 - lowest))
        rates = {"estimate": verdict.estimate, "required": verdict.probability}
        rates |= {"lower": verdict.lower, "upper": verdict.upper}
        scale = 100.0 / max(1.0 - scale_start, 1e-12)
        diagram = {"left": f"{100.0 * scale_start:.3g} %"} | {
            name: scale * (rate - scale_start) for name, rate in rates.items()
        }
    return {
        "verdict": verdict,
        "requirement": requirement_text(verdict),
        "evidence": [count(verdict.n, "case"), f"{verdict.failures:,} failed"],
        "bounds": bounds_text,
        "risk": "" if math.isnan(verdict.consumer_risk) else f"consumer's risk {percent(verdict.consumer_risk)}",
        "additional": NOTHING if verdict.additional_cases is None else f"{verdict.additional_cases:,}",
        "strip": diagram,
    }


def outcome_grid(frame: pd.DataFrame, scenario: str) -> Grid:
    """Count the cases by outcome, with the meaning of each outcome in the system of the scenario.

    Several systems have outcomes of the same name: the meaning in the scenario's own system takes precedence.
    """
    own_presentation = system_presentation(scenario)
    others = [presentation for presentation in presentations().values() if presentation is not own_presentation]
    # later meanings replace earlier ones
    ordered = others if own_presentation is None else [*others, own_presentation]
    kinds: list[type[Enum]] = [Fault, *(kind for presentation in ordered for kind in presentation.outcomes)]
    meanings = {member.name: str(member.value) for kind in kinds for member in kind}
    n_cases, counts = len(frame), outcome_counts(frame)
    rows = [[name, f"{cases:,}", percent(cases / n_cases), meanings.get(name, NOTHING)] for name, cases in counts]
    return Grid(["Outcome", "Cases", "Fraction", "Meaning"], rows)


def page_context(
    run: StoredRun, subject: Subject, verdicts: Sequence[Verdict], overall: OverallVerdict, extra: Sequence[Section]
) -> dict[str, Any]:
    """Create the context of the page's template.

    run: all cases; the subject contains only the random ones, to which statistics, dispersions and figures refer
    extra: sections in addition to those that the template contains
    """
    metric, bound = subject.metric, subject.bound
    crash_text = f"{count(overall.crashed, 'case')} crashed. Fix the cause before you use the verdict."
    cautions = [crash_text] if overall.crashed else []
    finder = CaseFinder(subject.run, verdicts)
    gallery = gallery_views(run, finder.worst_violations(CASES_PER_GROUP))
    context: dict[str, Any] = {
        "run": run,
        "description": str(run.recorded("description") or ""),
        "overall_verdict": overall,
        "cautions": [*cautions, *sampling_cautions(run, metric)],
        "interrupted": run.recorded("state") not in (None, "finished"),
        "verdicts": [verdict_row(verdict) for verdict in verdicts],
        "multiplicity": multiplicity_text(verdicts),
        "metric": metric,
        "metric_label": "" if metric is None else label(metric),
        "metric_title": "" if metric is None else label(metric)[:1].upper() + label(metric)[1:],
        "bound": bound,
        "extra_sections": extra,
        "outcomes": outcome_grid(run.all_cases, str(run.definition.get("scenario") or "")),
        "outcome_figures": outcome_figures(run.all_cases),
        "crashed": tables.crashed_rows(run),
        "dispersions": dispersion_grid(subject.run),
        "requirement_cases": finder.requirement_cases(),
        "gallery": gallery,
        "links": {case.case: f"#{page_environment.CASE_ANCHOR}{case.case}" for case in gallery},
        "summaries": {case.case: finder.summary(case.case) for case in gallery},
        "provenance": provenance.list_provenance(run),
        "versions": [(name, format_value(version)) for name, version in table(run.recorded("versions")).items()],
        "definition": json.dumps(run.definition, indent=2, ensure_ascii=False, default=str),
        "algorithms": read_algorithms(run.record),
        "rerun": provenance.rerun_commands(run),
        "rerun_is_stored": run.command is not None,
        "replay": provenance.replay_command(run, "CASE"),
        "gallery_command": shlex.join(["marsyard", "report", str(run.directory), "--gallery"]),
    }
    return context | _error_context(subject, finder, [str(case.case) for case in gallery])


def _error_context(subject: Subject, finder: CaseFinder, cases_with_images: Sequence[str]) -> dict[str, Any]:
    """Create the part of the context about the errors of the page's metric; without contents if there is no metric."""
    run, metric, bound = subject.run, subject.metric, subject.bound
    if metric is None:
        no_cases = tables.CaseTable((), ())
        context: dict[str, Any] = {
            "explorer": None,
            "error_figures": [],
            "driver_figures": [],
            "statistics": Grid((), ()),
        }
        return context | {"worst": no_cases, "unanswered": no_cases}
    explorer_context = None
    if np.isfinite(numbers(run.frame, metric)).any():
        data = explorer.explorer_data(run, metric, finder.explored_requirements(), cases_with_images)
        script = explorer.read_script()
        explorer_context = {
            "data": data, "json": page_environment.embed_json(data),
            "script": script, "hash": page_environment.script_hash(script),
        }  # fmt: skip
    return {
        "explorer": explorer_context,
        "error_figures": error_figures(run.frame, run.all_cases, metric, bound),
        "driver_figures": driver_figures(run.frame, metric, bound, run.driver_columns(metric)),
        "statistics": statistics_grid(run.all_cases, metric),
        "worst": tables.worst_cases(run, metric, cases_with_images),
        "unanswered": tables.unanswered_cases(run, metric, cases_with_images),
    }


def sampling_cautions(run: StoredRun, metric: str | None) -> list[str]:
    """List warnings about the sampling: a design that is not random, plots of a part of the cases, a nominal case."""
    sampling = read_sampling_design(run.definition)
    cautions = []
    if not sampling.independent and not run.recorded("study"):
        cautions.append(
            f"The cases are not independent random samples: {sampling.text}. Statistics describe these cases; "
            "intervals, bounds and probabilities on this page assume independent samples and do not apply to them."
        )
    if run.is_truncated:
        cautions.append(
            f"Verdicts, outcomes, answers, statistics and convergence use all {len(run.all_cases):,} cases. Scatter "
            f"plots, conditions and drivers use the first {len(run.frame):,} cases"
            f"{', which are also a random sample' if sampling.independent else ''}."
        )
    nominal_rows = run.frame[run.frame["case"] == 0] if sampling.nominal and "case" in run.frame else run.frame[:0]
    if len(nominal_rows):
        nominal_text = str(nominal_rows["outcome"].iloc[0]) if "outcome" in nominal_rows else "stored"
        if metric is not None:
            nominal_text += f", {label(metric)} {number(float(numbers(nominal_rows, metric)[0]))}"
        cautions.append(f"Case 0 is the nominal case ({nominal_text}). It is excluded from verdicts and statistics.")
    return cautions
