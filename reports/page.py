"""Contents of the report's page: rows of tables, figures with captions, provenance and commands.

A driver is a condition that may affect the metric.
"""

import base64
import hashlib
import json
import math
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int
from markupsafe import Markup
from matplotlib.figure import Figure
from pydantic import BaseModel

from marsyard.algorithms.faults import Fault
from marsyard.campaigns.definition.toml_models import description_at
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.reports import figures
from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.presentation import presentations, system_presentation
from marsyard.reports.rates import CONFIDENCE, engine_failed, population_mask, terrain_groups
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Grid, SvgFigure, svg_figure
from marsyard.reports.statistics.drivers import Driver, estimate_driver
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.tables import outcome_counts
from marsyard.reports.traceability import read_algorithms
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import (
    NOTHING,
    coefficient,
    count,
    format_fraction,
    label,
    number,
    percent,
    requirement_text,
)
from marsyard.scenarios.columns import split_unit
from marsyard.scenarios.systems import scenario, scenario_names

#: Maximum number of rows of the tables of single cases.
_MAX_CASES = 10


@dataclass(frozen=True)
class CaseRow:
    """A case with its values, its replay command, and its error if it crashed."""

    case: str
    has_images: bool
    values: Sequence[str]
    command: str
    message: str
    trace: str


@dataclass(frozen=True)
class CaseTable:
    """Cases with the headings of their values, and the number of omitted cases."""

    head: Sequence[str]
    rows: Sequence[CaseRow]
    n_omitted: int = 0


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
        # the scale starts below the lower bound and the required rate, and ends at 100 %
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


def worst_cases(run: StoredRun, metric: str, with_images: Collection[str] = ()) -> CaseTable:
    """List the cases with the largest errors; `with_images` are the cases with images on the page."""
    magnitude = np.abs(numbers(run.all_cases, metric))
    finite_rows = np.flatnonzero(np.isfinite(magnitude))
    order = finite_rows[np.argsort(-magnitude[finite_rows], kind="stable")]
    columns = [metric, *axis_columns(metric, [str(name) for name in run.all_cases.columns])]
    return _case_table(run, order, [*columns, *_condition_columns(run, metric)], with_images)


def unanswered_cases(run: StoredRun, metric: str, with_images: Collection[str] = ()) -> CaseTable:
    """List the completed cases without a value of the metric."""
    order = np.flatnonzero(~np.isfinite(numbers(run.all_cases, metric)) & population_mask(run.all_cases, "completed"))
    return _case_table(run, order, _condition_columns(run, metric), with_images)


def crashed_rows(run: StoredRun) -> CaseTable:
    """List the cases that the engine could not finish, with their error messages."""
    return _case_table(run, np.flatnonzero(~population_mask(run.all_cases, "completed")), ())


def _condition_columns(run: StoredRun, metric: str) -> list[str]:
    return ["terrain", *run.driver_columns(metric, max_columns=3)]


def _case_table(
    run: StoredRun, order: Int[np.ndarray, " n"], columns: Sequence[str], with_images: Collection[str] = ()
) -> CaseTable:
    frame = run.all_cases
    names = [name for name in columns if name in frame]
    rows = []
    for index in order[:_MAX_CASES].tolist():
        case = str(frame["case"].iloc[index]) if "case" in frame else str(index)
        texts = [_cell_text(frame, name, index) for name in ("outcome", *names)]
        error = _cell_text(frame, "error", index), _cell_text(frame, "traceback", index)
        rows.append(CaseRow(case, case in with_images, texts, replay_command(run, case), *error))
    return CaseTable(["Case", "Outcome", *(label(name) for name in names)], rows, max(0, order.size - _MAX_CASES))


#: Keys of a dispersion that are not parameters of its distribution.
_NON_PARAMETER_KEYS = ("distribution", "source", "unit", "description")


def dispersion_grid(run: StoredRun) -> Grid:
    """Create a table of the dispersions, with the minimum, mean and maximum of the stored values."""
    rows, model = [], _parameters_type(run)
    for path, entry in table(run.recorded("dispersions")).items():
        dispersion, path_parts = table(entry), str(path).split(".")
        statistics = [NOTHING] * 3
        if path in run.frame:
            values = pd.to_numeric(run.frame[path], errors="coerce").dropna()
            statistics[1] = f"{run.frame[path].nunique()} values"
            if len(values) and not pd.api.types.is_bool_dtype(run.frame[path].dtype):
                statistics = [_format_value(float(value)) for value in (values.min(), values.mean(), values.max())]
                if path_parts[-1] == "terrain":
                    statistics[1] = NOTHING  # the mean of numbers of terrains has no meaning
        # defaults, which follow a semicolon, do not apply to dispersed parameters
        meaning = str(dispersion.get("description") or (model and description_at(model, str(path))) or NOTHING)
        meaning, unit = meaning.split(";")[0], split_unit(path_parts[-1])[1]
        meaning += f" ({unit})" if unit and not meaning.endswith(f", {unit}") else ""
        source = str(dispersion.get("source") or NOTHING)
        rows.append([meaning, str(path), _distribution_text(dispersion), *statistics, source])
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


def _parameters_type(run: StoredRun) -> type[BaseModel] | None:
    """Return the parameters of the run's scenario; None for a scenario that is not installed.

    A custom scenario is not imported: a report runs no code that a folder names.
    """
    name = str(run.recorded("scenario"))
    return scenario(name).parameters_type if name in scenario_names() else None


#: Machine properties whose names in the record are not words.
_FACT_NAMES = {
    "processor_features": "processor features (hash)",
    "implementation": "Python implementation",
    "machine": "architecture",
}


def list_provenance(run: StoredRun) -> list[tuple[str, str]]:
    """List name and value of properties of campaign, algorithms, program and machine."""
    environment, times = table(run.recorded("environment")), numbers(run.frame, "cpu_time_s")
    times = times[np.isfinite(times)]
    algorithms: list[tuple[str, Any]] = []
    for item in read_algorithms(run.record):
        title = "Algorithm under test" if item.tested else "Algorithm compared"
        algorithms += [(title, item.name), (f"{title}: class or file", item.path), (f"{title}: version", item.version)]
        algorithms += [(f"{title}: source hash", item.source_hash), (f"{title}: options", item.options_text)]
    facts = [
        ("Campaign", run.name),
        ("Scenario", run.recorded("scenario")),
        *algorithms,
        ("State", run.recorded("state")),
        ("Root seed", run.recorded("seed")),
        ("Sampling", read_sampling_design(run.definition).text),
        ("Cases requested", run.recorded("cases")),
        ("Cases stored", len(run.all_cases)),
        ("Started", run.recorded("started_utc")),
        ("Finished", run.recorded("finished_utc")),
        ("Worker processes", run.recorded("jobs")),
        ("CPU time per case", f"{number(float(times.mean()))} s on average" if times.size else None),
        ("Commit", run.recorded("git_commit")),
        ("Marsyard", table(run.recorded("versions")).get("marsyard")),
        *(
            (f"Machine: {_FACT_NAMES.get(name, name)}", value)
            for name, value in environment.items()
            if name in _FACT_NAMES or isinstance(value, str)
        ),
        ("GL backend", _distinct_values(run.frame, "gl_backend")),
        ("GL version", _distinct_values(run.frame, "gl_version")),
    ]
    return [(name, _format_value(value)) for name, value in facts if value not in (None, "")]


def list_versions(run: StoredRun) -> list[tuple[str, str]]:
    """List packages and their versions."""
    return [(str(name), _format_value(version)) for name, version in table(run.recorded("versions")).items()]


def replay_command(run: StoredRun, case: str) -> str:
    """Return the command that runs a stored case again."""
    return shlex.join(["marsyard", "replay", str(run.directory), case])


def rerun_commands(run: StoredRun) -> list[str]:
    """Return shell commands that run the campaign again in a new folder, with a command for each appended block.

    A campaign that Python code ran has no command; it is built from name, cases and seed.
    """
    if run.command is None:
        words = ["marsyard", "run", run.name]
        for option, key in (("-n", "cases"), ("--seed", "seed")):
            if run.recorded(key) is not None:
                words += [option, str(run.recorded(key))]
        return [shlex.join(words)]
    folder, words = hide_folders(run.command[0]), list(run.command[1])
    stored_blocks = run.definition.get("appended")
    # a sequential campaign appends blocks of cases without a command
    block_sizes = [] if run.recorded("max_cases") or not isinstance(stored_blocks, list | tuple) else stored_blocks
    target = f"runs/{run.name}-again"
    if block_sizes:
        words += ["--out", target]
    append_commands = [shlex.join(["marsyard", "append", target, str(cases)]) for cases in block_sizes]
    first, separator, rest = folder.partition("/")
    # the shell expands ~ only without quotes
    path = first + separator + (shlex.quote(rest) if rest else "") if first == "~" else shlex.quote(folder)
    return [*([f"cd {path}"] if folder else []), shlex.join(words), *append_commands]


def _cell_text(frame: pd.DataFrame, column: str, index: int) -> str:
    if column not in frame:
        return NOTHING
    value = frame[column].iloc[index]
    return NOTHING if pd.isna(value) or value == "" else _format_value(value)


def _format_value(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={inner}" for name, inner in value.items())
    if isinstance(value, float | np.floating):
        return f"{value:.0f}" if float(value).is_integer() else number(float(value))
    return str(value)


def _distinct_values(frame: pd.DataFrame, column: str) -> str | None:
    return None if column not in frame else "; ".join(str(value) for value in frame[column].dropna().unique()[:3])


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
        sentences = [] if driver is None else [f"Rank correlation {rank_text(driver)}."]
        n_beyond = figures.count_beyond_axis(frame, metric, column, bound)
        if n_beyond:
            sentences.append(f"Hollow marks at the upper edge: {count(n_beyond, 'error')} beyond the axis.")
        entries.append(
            (f"driver{index}", figures.error_scatter_against(frame, metric, column, bound), " ".join(sentences))
        )
    return _svg_figures(entries)


def rank_text(driver: Driver) -> str:
    """Format a rank correlation with its interval: ``0.310 (0.120 to 0.480 at 90 % confidence)``."""
    lower, upper = coefficient(driver.lower), coefficient(driver.upper)
    return f"{coefficient(driver.correlation)} ({lower} to {upper} at {format_fraction(CONFIDENCE)} confidence)"


def outcome_figures(frame: pd.DataFrame) -> list[SvgFigure]:
    """Draw the number of cases by outcome."""
    caption = "Solid bars: cases with an answer. Hatched bars: cases without an answer."
    if engine_failed(frame).any():
        caption += " Cross-hatched bars: cases in which the program failed (crashed cases)."
    return _svg_figures([("outcomes", figures.outcome_bars(frame), caption)])


def _svg_figures(entries: Sequence[tuple[str, Figure | None, str]]) -> list[SvgFigure]:
    return [svg_figure(figure, key, caption) for key, figure, caption in entries if figure is not None]


def script_hash(text: str) -> str:
    """Compute the hash of a script for the page's content security policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def embed_json(data: Any) -> Markup:
    """Convert data to JSON, escaped for a script element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)  # noqa: S704
