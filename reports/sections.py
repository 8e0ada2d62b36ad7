"""Contents of the report's page: rows of its tables, figures with captions, and the points of its explorer."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int
from markupsafe import Markup
from matplotlib.figure import Figure

from marsyard.reports import figures
from marsyard.reports.rates import CONFIDENCE, engine_failed, members, terrain_groups
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Grid, SvgFigure, plate
from marsyard.reports.statistics.drivers import Driver, driver
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.tables import outcome_counts
from marsyard.reports.traceability import tested_algorithms
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import (
    NOTHING,
    axis_columns,
    coefficient,
    count,
    driver_columns,
    format_fraction,
    label,
    number,
    numbers,
    percent,
    requirement_text,
)

#: Maximum number of rows of the tables of single cases.
_MAX_CASES = 10


@dataclass(frozen=True)
class CaseRow:
    """A case with its values, its replay command, and its error if it crashed."""

    case: str
    pictured: bool
    values: Sequence[str]
    command: str
    message: str
    trace: str


@dataclass(frozen=True)
class CaseTable:
    """Cases with the headings of their values, and the number of cases left out."""

    head: Sequence[str]
    rows: Sequence[CaseRow]
    left_out: int = 0


def verdict_row(verdict: Verdict) -> dict[str, Any]:
    """A verdict as the page shows it; `strip` is its interval to scale, in per cent of the strip's width."""
    bounds, strip = f"{percent(verdict.lower)} to {percent(verdict.upper)}", None
    if math.isnan(verdict.lower):
        bounds = NOTHING if math.isnan(verdict.estimate) else f"{percent(verdict.estimate)} seen"
    else:
        lowest = min(verdict.lower, verdict.probability)
        left = max(0.0, lowest - 0.25 * (1.0 - lowest))
        rates = {"estimate": verdict.estimate, "asked": verdict.probability}
        rates |= {"lower": verdict.lower, "upper": verdict.upper}
        scale = 100.0 / max(1.0 - left, 1e-12)
        strip = {"left": f"{100.0 * left:.3g} %"} | {name: scale * (rate - left) for name, rate in rates.items()}
    return {
        "verdict": verdict,
        "asked": requirement_text(verdict, label(verdict.metric)),
        "evidence": [count(verdict.n, "case"), f"{verdict.failures:,} failed"],
        "bounds": bounds,
        "risk": "" if math.isnan(verdict.consumer_risk) else f"consumer's risk {percent(verdict.consumer_risk)}",
        "further": NOTHING if verdict.further_cases is None else f"{verdict.further_cases:,}",
        "strip": strip,
    }


def outcome_grid(frame: pd.DataFrame) -> Grid:
    """Number of cases by outcome."""
    rows = [[name, f"{cases:,}", percent(cases / len(frame))] for name, cases in outcome_counts(frame)]
    return Grid(["Outcome", "Cases", "Share"], rows)


def worst_cases(run: StoredRun, metric: str, pictured: Collection[str] = ()) -> CaseTable:
    """The cases with the largest errors; `pictured` are the cases with pictures on the page."""
    magnitude = np.abs(numbers(run.whole, metric))
    finite = np.flatnonzero(np.isfinite(magnitude))
    order = finite[np.argsort(-magnitude[finite], kind="stable")]
    columns = [metric, *axis_columns(metric, [str(name) for name in run.whole.columns])]
    return _case_table(run, order, [*columns, *_conditions(run, metric)], pictured)


def unanswered_cases(run: StoredRun, metric: str, pictured: Collection[str] = ()) -> CaseTable:
    """Completed cases without an error."""
    order = np.flatnonzero(~np.isfinite(numbers(run.whole, metric)) & members(run.whole, "completed"))
    return _case_table(run, order, _conditions(run, metric), pictured)


def crashed_rows(run: StoredRun) -> CaseTable:
    """Cases that the engine could not finish, with their error messages."""
    return _case_table(run, np.flatnonzero(~members(run.whole, "completed")), ())


def _conditions(run: StoredRun, metric: str) -> list[str]:
    return ["terrain", *driver_columns(run.frame, metric, max_columns=3)]


def _case_table(
    run: StoredRun, order: Int[np.ndarray, " n"], columns: Sequence[str], pictured: Collection[str] = ()
) -> CaseTable:
    frame = run.whole
    shown = [name for name in columns if name in frame]
    rows = []
    for index in order[:_MAX_CASES].tolist():
        case = str(frame["case"].iloc[index]) if "case" in frame else str(index)
        texts = [_text(frame, name, index) for name in ("outcome", *shown)]
        error = _text(frame, "error", index), _text(frame, "traceback", index)
        rows.append(CaseRow(case, case in pictured, texts, replay_command(run, case), *error))
    return CaseTable(["Case", "Outcome", *(label(name) for name in shown)], rows, max(0, order.size - _MAX_CASES))


#: Keys of a dispersion that are not parameters of its distribution.
_HIDDEN = ("distribution", "source", "unit", "description")


def dispersion_grid(run: StoredRun) -> Grid:
    """Dispersions, and the values applied in the rows."""
    rows = []
    for path, value in table(run.recorded("dispersions")).items():
        dispersion, parts = table(value), str(path).split(".")
        # a column is named like the parameter's path, or like the end of its path
        names = [str(path), *("_".join(parts[start:]) for start in range(len(parts)))]
        column = next((name for name in names if name in run.frame), None)
        shown = ", ".join(f"{key}={one}" for key, one in dispersion.items() if key not in _HIDDEN and one is not None)
        distribution = f"{dispersion.get('distribution', '?')}({shown})"
        drawn = [NOTHING] * 3
        if column is not None:
            values = pd.to_numeric(run.frame[column], errors="coerce").dropna()
            drawn[1] = f"{run.frame[column].nunique()} kinds"
            if len(values) and not pd.api.types.is_bool_dtype(run.frame[column].dtype):
                drawn = [_plain(float(value)) for value in (values.min(), values.mean(), values.max())]
        rows.append([str(path), distribution, *drawn, str(dispersion.get("source") or NOTHING)])
    return Grid(["Parameter", "Distribution", "Minimum", "Mean", "Maximum", "Source"], rows)


def provenance(run: StoredRun) -> list[tuple[str, str]]:
    """Campaign, algorithms, program and machine."""
    environment, times = table(run.recorded("environment")), numbers(run.frame, "cpu_time_s")
    times = times[np.isfinite(times)]
    algorithms: list[tuple[str, Any]] = []
    for one in tested_algorithms(run.record):
        head = "Algorithm under test" if one.tested else "Algorithm compared"
        algorithms += [(head, one.name), (f"{head}: class or file", one.path), (f"{head}: version", one.version)]
        algorithms += [(f"{head}: sources", one.source_hash), (f"{head}: options", one.options_text)]
    facts = [
        ("Campaign", run.name),
        ("Scenario", run.recorded("scenario")),
        *algorithms,
        ("State", run.recorded("state")),
        ("Root seed", run.recorded("seed")),
        ("Sampling", read_sampling_design(run.configuration).text),
        ("Cases asked", run.recorded("cases")),
        ("Cases stored", len(run.whole)),
        ("Started", run.recorded("started_utc")),
        ("Finished", run.recorded("finished_utc")),
        ("Worker processes", run.recorded("jobs")),
        ("Processor time of a case", f"{number(float(times.mean()))} s on average" if times.size else None),
        ("Commit", run.recorded("git_commit")),
        ("Marsyard", table(run.recorded("versions")).get("marsyard")),
        *((f"Machine: {name}", value) for name, value in environment.items() if value not in ({}, None)),
        ("GL backend", _only_values(run.frame, "gl_backend")),
        ("GL version", _only_values(run.frame, "gl_version")),
    ]
    return [(name, _plain(value)) for name, value in facts if value not in (None, "")]


def versions(run: StoredRun) -> list[tuple[str, str]]:
    """Packages and their versions."""
    return [(str(name), _plain(version)) for name, version in table(run.recorded("versions")).items()]


def replay_command(run: StoredRun, case: str) -> str:
    """The command that runs a stored case again."""
    return shlex.join(["marsyard", "replay", str(run.directory), case])


def rerun_commands(run: StoredRun) -> list[str]:
    """Shell commands that run the campaign again into a new folder, with a command for each appended block.

    Records of earlier versions lack the original command: name, cases and seed replace it.
    """
    if run.command is None:
        words = ["marsyard", "run", run.name]
        for option, key in (("-n", "cases"), ("--seed", "seed")):
            if run.recorded(key) is not None:
                words += [option, str(run.recorded(key))]
        return [shlex.join(words)]
    folder, words = run.command[0], list(run.command[1])
    blocks = run.configuration.get("appended")
    # a campaign that stops itself appends its blocks itself
    added = [] if run.recorded("max_cases") or not isinstance(blocks, list | tuple) else blocks
    target = f"runs/{run.name}-again"
    if added:
        words += ["--out", target]
    appends = [shlex.join(["marsyard", "append", target, str(cases)]) for cases in added]
    return [*([shlex.join(["cd", folder])] if folder else []), shlex.join(words), *appends]


def _text(frame: pd.DataFrame, column: str, index: int) -> str:
    if column not in frame:
        return NOTHING
    value = frame[column].iloc[index]
    return NOTHING if pd.isna(value) or value == "" else _plain(value)


def _plain(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={inner}" for name, inner in value.items())
    if isinstance(value, float | np.floating):
        return f"{value:.0f}" if float(value).is_integer() else number(float(value))
    return str(value)


def _only_values(frame: pd.DataFrame, column: str) -> str | None:
    if column not in frame:
        return None
    return "; ".join(str(value) for value in frame[column].dropna().unique()[:3])


def error_plates(frame: pd.DataFrame, whole: pd.DataFrame, metric: str, bound: float | None) -> list[SvgFigure]:
    """Scatter of a metric over some rows, its histogram and distribution over all."""
    scatter = "Errors of single cases; the dashed circle is the requirement. Hollow: beyond the axes, at their edge."
    histogram = "How often each magnitude of error occurred; hatched: beyond the axis."
    drawn: list[tuple[str, Figure | None, str]] = [("scatter", figures.error_scatter(frame, metric, bound), scatter)]
    if figures.needs_enlarged_figure(frame, metric, bound):
        drawn.append(("close", figures.error_scatter(frame, metric, bound, close=True), "The same errors, enlarged."))
    drawn.append(("histogram", figures.error_histogram(whole, metric, bound), histogram))
    caption = "Fraction of cases up to each magnitude."
    drawn.append(("distribution", figures.error_distribution(whole, metric, bound), caption))
    return _plates(drawn)


def driver_plates(frame: pd.DataFrame, metric: str, bound: float | None) -> list[SvgFigure]:
    """A metric against the conditions that may drive it, with rank correlations."""
    drawn, magnitude, groups = [], np.abs(numbers(frame, metric)), terrain_groups(frame)
    for k, column in enumerate(driver_columns(frame, metric)):
        result = driver(numbers(frame, column), magnitude, groups, CONFIDENCE)
        text = f"{label(column)}." if result is None else f"{label(column)}: rank correlation {rank_text(result)}."
        beyond = figures.count_beyond_axis(frame, metric, column, bound)
        if beyond:
            text = f"{text} {count(beyond, 'error')} beyond the axis: hollow, at its upper edge."
        drawn.append((f"driver{k}", figures.error_scatter_against(frame, metric, column, bound), text))
    return _plates(drawn)


def rank_text(found: Driver) -> str:
    """A rank correlation with its interval: ``0.310 (0.120 to 0.480 at 90 % confidence)``."""
    lower, upper = coefficient(found.lower), coefficient(found.upper)
    return f"{coefficient(found.correlation)} ({lower} to {upper} at {format_fraction(CONFIDENCE)} confidence)"


def outcome_plates(frame: pd.DataFrame) -> list[SvgFigure]:
    """Number of cases by outcome."""
    caption = "Plain: an answer was given. Hatched: the algorithm gave no answer. Crossed: the case crashed."
    return _plates([("outcomes", figures.outcome_bars(frame), caption)])


def _plates(wanted: Sequence[tuple[str, Figure | None, str]]) -> list[SvgFigure]:
    return [plate(figure, key, caption) for key, figure, caption in wanted if figure is not None]


#: Maximum number of points, and of largest errors, cases without an answer and crashed cases that are always included.
MAX_POINTS, MAX_NOTABLE = 2000, 150
_SCRIPT = Path(__file__).parent / "templates" / "explorer.js"


def explorer_data(run: StoredRun, metric: str, bound: float | None, pictured: Collection[str]) -> dict[str, Any]:
    """Data of the explorer: columns of the points with labels, initial axes, and the bound."""
    frame = run.frame
    parts = axis_columns(metric, [str(name) for name in frame.columns])[:2]
    drivers = driver_columns(frame, metric)
    names = list(dict.fromkeys([*parts, *drivers, metric]))
    chosen = frame.iloc[choose_points(frame, metric)]
    outcomes = chosen["outcome"].astype(str) if "outcome" in chosen else pd.Series("", index=chosen.index)
    kinds = list(dict.fromkeys(outcomes))
    cases = chosen["case"].tolist() if "case" in chosen else chosen.index.tolist()
    return {
        "labels": [label(name) for name in names],
        "columns": [[float(f"{x:.4g}") if math.isfinite(x) else None for x in numbers(chosen, name)] for name in names],
        "metric": names.index(metric),
        "parts": [names.index(part) for part in parts] if len(parts) == 2 else [],
        "axes": [names.index(name) for name in (parts if len(parts) == 2 else [(drivers or [metric])[0], metric])],
        "bound": bound,
        "cases": [int(case) for case in cases],
        "outcomes": [str(kind) for kind in kinds],
        "outcome": [kinds.index(kind) for kind in outcomes],
        "pictured": sorted(int(case) for case in pictured),
        "replay": replay_command(run, "CASE"),
        "shown": len(chosen),
        "all": len(run.whole),
    }


def choose_points(frame: pd.DataFrame, metric: str) -> Int[np.ndarray, " n"]:
    """Rows of the explorer: all, or of many the notable ones and the first others."""
    if len(frame) <= MAX_POINTS:
        return np.arange(len(frame))
    magnitude = np.abs(numbers(frame, metric))
    finite = np.isfinite(magnitude)
    crashed = engine_failed(frame)
    worst = np.argsort(-np.where(finite, magnitude, -1.0), kind="stable")
    notable = [part[:MAX_NOTABLE] for part in (worst, np.flatnonzero(~finite & ~crashed), np.flatnonzero(crashed))]
    return np.sort(pd.unique(np.concatenate([*notable, np.arange(len(frame))]))[:MAX_POINTS])


def script() -> Markup:
    """The explorer's script, unescaped."""
    return Markup(_SCRIPT.read_text(encoding="utf-8"))  # noqa: S704


def script_hash(text: str) -> str:
    """Hash of a script for the page's content security policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def embed_json(data: Any) -> Markup:
    """Data as JSON, escaped for a script element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)  # noqa: S704
