"""What the report's page says, section by section: plain values and finished figures, in the order they are read."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.columns import axis_columns, driver_columns, label, numbers
from marsyard.reports.evaluation import Overall
from marsyard.reports.populations import members
from marsyard.reports.sampled import sampled
from marsyard.reports.section import Grid
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.tables import outcome_counts
from marsyard.reports.traceability import algorithms_of
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import NOTHING, asked_text, count, number, percent

#: Rows of the tables of single cases; the rows that are left out are counted.
_MOST_CASES = 10


@dataclass(frozen=True)
class Strip:
    """A success rate's interval drawn to scale: places in per cent of the strip's width."""

    left: str
    lower: float
    upper: float
    estimate: float
    asked: float


@dataclass(frozen=True)
class VerdictRow:
    """A verdict in words, with its strip; None where there is no evidence to draw."""

    verdict: Verdict
    asked: str
    evidence: Sequence[str]
    bounds: str
    risk: str
    further: str
    strip: Strip | None


@dataclass(frozen=True)
class CaseRow:
    """A single case: its number, its values as texts, how to run it again, and what it said when it crashed."""

    case: str
    pictured: bool
    values: Sequence[str]
    command: str
    message: str = ""
    trace: str = ""


@dataclass(frozen=True)
class CaseTable:
    """Single cases with the headings of their values, and how many were left out."""

    head: Sequence[str]
    rows: Sequence[CaseRow]
    left_out: int = 0


def verdict_row(verdict: Verdict) -> VerdictRow:
    """A verdict as the page shows it."""
    asked = asked_text(verdict, label(verdict.metric))
    bounds = f"{percent(verdict.lower)} to {percent(verdict.upper)}"
    if math.isnan(verdict.lower):
        bounds = NOTHING if math.isnan(verdict.estimate) else f"{percent(verdict.estimate)} seen"
    further = NOTHING if verdict.further_cases is None else f"{verdict.further_cases:,}"
    evidence = [count(verdict.n, "case"), f"{verdict.failures:,} failed"]
    risk = "" if math.isnan(verdict.consumer_risk) else f"consumer's risk {percent(verdict.consumer_risk)}"
    return VerdictRow(verdict, asked, evidence, bounds, risk, further, _strip(verdict))


def _strip(verdict: Verdict) -> Strip | None:
    if math.isnan(verdict.lower):
        return None
    lowest = min(verdict.lower, verdict.probability)
    left = max(0.0, lowest - 0.25 * (1.0 - lowest))
    scale = 100.0 / max(1.0 - left, 1e-12)
    places = [scale * (value - left) for value in (verdict.lower, verdict.upper, verdict.estimate, verdict.probability)]
    return Strip(f"{100.0 * left:.3g} %", *places)


def cautions(whole: Overall) -> list[str]:
    """What the headline alone would hide: crashed cases."""
    if not whole.crashed:
        return []
    return [f"{count(whole.crashed, 'case')} crashed: the campaign is not in order, whatever its verdict."]


def outcome_grid(frame: pd.DataFrame) -> Grid:
    """How many cases ended in which way."""
    rows = [[name, f"{cases:,}", percent(cases / len(frame))] for name, cases in outcome_counts(frame)]
    return Grid(["Outcome", "Cases", "Share"], rows)


def worst_cases(run: StoredRun, metric: str, pictured: Collection[str] = ()) -> CaseTable:
    """The cases with the largest errors, largest first; `pictured` are those that the page has pictures of."""
    magnitude = np.abs(numbers(run.whole, metric))
    known = np.flatnonzero(np.isfinite(magnitude))
    order = known[np.argsort(-magnitude[known], kind="stable")][:_MOST_CASES]
    columns = [metric, *axis_columns(metric, [str(name) for name in run.whole.columns])]
    return _case_table(run, order.tolist(), columns, metric, known.size - order.size, pictured)


def silent_cases(run: StoredRun, metric: str, pictured: Collection[str] = ()) -> CaseTable:
    """Cases that ran to their end without an error to score."""
    silent = ~np.isfinite(numbers(run.whole, metric)) & members(run.whole, "completed")
    order = np.flatnonzero(silent)
    return _case_table(run, order[:_MOST_CASES].tolist(), [], metric, max(0, order.size - _MOST_CASES), pictured)


def crashed_rows(run: StoredRun) -> CaseTable:
    """Cases that the engine could not finish, with what they said."""
    order = np.flatnonzero(~members(run.whole, "completed"))
    head = ["Case", "Outcome"]
    rows = [
        CaseRow(
            case=_case(run.whole, index),
            pictured=False,
            values=[_text(run.whole, "outcome", index)],
            command=replay_command(run, _case(run.whole, index)),
            message=_text(run.whole, "error", index),
            trace=_text(run.whole, "traceback", index),
        )
        for index in order[:_MOST_CASES].tolist()
    ]
    return CaseTable(head, rows, max(0, order.size - _MOST_CASES))


def dispersion_grid(run: StoredRun) -> Grid:
    """Dispersions as stated, and the values as the rows show them applied."""
    rows = []
    for path, dispersion in table(run.said("dispersions")).items():
        column = _drawn_column(run.frame, str(path))
        drawn = [NOTHING] * 3 if column is None else _extent(run.frame[column])
        stated_as = _distribution(table(dispersion))
        rows.append([str(path), stated_as, *drawn, str(table(dispersion).get("source") or NOTHING)])
    return Grid(["Parameter", "Distribution", "Least", "Mean", "Greatest", "Source"], rows)


def provenance(run: StoredRun) -> list[tuple[str, str]]:
    """What was run, by which program, on which machine."""
    environment = table(run.said("environment"))
    facts = [
        ("Campaign", run.name),
        ("Scenario", run.said("scenario")),
        *_algorithm_facts(run),
        ("State", run.said("state")),
        ("Root seed", run.said("seed")),
        ("Sampling", sampled(run.configuration).text),
        ("Cases asked", run.said("cases")),
        ("Cases stored", len(run.whole)),
        ("Started", run.said("started_utc")),
        ("Finished", run.said("finished_utc")),
        ("Worker processes", run.said("jobs")),
        ("Processor time of a case", _mean_time(run.frame, "cpu_time_s")),
        ("Commit", run.said("git_commit")),
        ("Marsyard", table(run.said("versions")).get("marsyard")),
        *((f"Machine: {name}", value) for name, value in environment.items() if value not in ({}, None)),
        ("GL backend", _only_values(run.frame, "gl_backend")),
        ("GL version", _only_values(run.frame, "gl_version")),
    ]
    return [(name, _plain(value)) for name, value in facts if value not in (None, "")]


def _algorithm_facts(run: StoredRun) -> list[tuple[str, Any]]:
    """What was judged, and what was compared with it."""
    facts: list[tuple[str, Any]] = []
    for one in algorithms_of(run.record):
        head = "Algorithm judged" if one.judged else "Algorithm compared"
        facts.append((head, one.name))
        facts += [
            (f"{head}: {name}", value)
            for name, value in (
                ("class or file", one.path),
                ("version", one.version),
                ("sources", one.source_hash),
                ("options", one.options_text),
            )
        ]
    return facts


def versions(run: StoredRun) -> list[tuple[str, str]]:
    """Packages and their versions."""
    return [(str(name), _plain(version)) for name, version in table(run.said("versions")).items()]


def configuration_text(run: StoredRun) -> str:
    """The configuration as run, as indented JSON."""
    return json.dumps(run.configuration or run.record, indent=2, ensure_ascii=False, default=str)


def replay_command(run: StoredRun, case: str) -> str:
    """The command that runs a stored case again."""
    return shlex.join(["marsyard", "replay", str(run.directory), case])


def rerun_commands(run: StoredRun) -> list[str]:
    """The commands that run the campaign again, into a folder of its own, quoted for a shell.

    Where the record holds the command that was given it is that one, from the same folder, and one that adds each block
    of cases that was appended. Records of earlier versions have the campaign's name, cases and seed alone.
    """
    if run.command is None:
        words = ["marsyard", "run", run.name]
        for option, key in (("-n", "cases"), ("--seed", "seed")):
            if run.said(key) is not None:
                words += [option, str(run.said(key))]
        return [shlex.join(words)]
    folder, words = run.command[0], list(run.command[1])
    blocks = run.configuration.get("appended")
    # a campaign that stops itself appends its blocks itself
    added = [] if run.said("most_cases") or not isinstance(blocks, list | tuple) else blocks
    target = f"runs/{run.name}-again"
    if added:
        words += ["--out", target]
    appends = [shlex.join(["marsyard", "append", target, str(cases)]) for cases in added]
    return [*([shlex.join(["cd", folder])] if folder else []), shlex.join(words), *appends]


def _case_table(
    run: StoredRun,
    order: Sequence[int],
    columns: Sequence[str],
    metric: str,
    left_out: int,
    pictured: Collection[str],
) -> CaseTable:
    shown = [name for name in [*columns, "terrain", *driver_columns(run.frame, metric, most=3)] if name in run.whole]
    rows = [
        CaseRow(
            case=_case(run.whole, index),
            pictured=_case(run.whole, index) in pictured,
            values=[_text(run.whole, "outcome", index), *(_text(run.whole, name, index) for name in shown)],
            command=replay_command(run, _case(run.whole, index)),
        )
        for index in order
    ]
    return CaseTable(["Case", "Outcome", *(label(name) for name in shown)], rows, left_out)


def _case(frame: pd.DataFrame, index: int) -> str:
    return str(frame["case"].iloc[index]) if "case" in frame else str(index)


def _text(frame: pd.DataFrame, column: str, index: int) -> str:
    """A stored value as text; a dash where there is none."""
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


def _drawn_column(frame: pd.DataFrame, path: str) -> str | None:
    """The column that holds what a dispersed parameter became: by its whole path, or by its end."""
    parts = path.split(".")
    names = ["_".join(parts[start:]) for start in range(len(parts))]
    return next((name for name in [path, *names] if name in frame), None)


def _extent(drawn: pd.Series) -> list[str]:
    """Least, mean and greatest of what was drawn; how many kinds where it is no number."""
    values = pd.to_numeric(drawn, errors="coerce").dropna()
    if values.empty or pd.api.types.is_bool_dtype(drawn.dtype):
        return [NOTHING, f"{drawn.nunique()} kinds", NOTHING]
    return [_plain(float(value)) for value in (values.min(), values.mean(), values.max())]


def _distribution(dispersion: Mapping[str, Any]) -> str:
    """A distribution and its parameters in one line."""
    told = {
        name: value
        for name, value in dispersion.items()
        if name not in ("distribution", "source", "unit", "description") and value is not None
    }
    return f"{dispersion.get('distribution', '?')}({', '.join(f'{name}={value}' for name, value in told.items())})"


def _mean_time(frame: pd.DataFrame, column: str) -> str | None:
    values = numbers(frame, column)
    known = values[np.isfinite(values)]
    return f"{number(float(known.mean()))} s on average" if known.size else None


def _only_values(frame: pd.DataFrame, column: str) -> str | None:
    if column not in frame:
        return None
    return "; ".join(str(value) for value in frame[column].dropna().unique()[:3])
