"""Sections of every campaign: availability and wrong answers, error ellipse, and outcomes by fault."""

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.reports import populations, rates
from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.figures import ELLIPSE
from marsyard.reports.outcomes_by_size import NO_FAULT, ExtraColumn, OutcomesBySize
from marsyard.reports.presentation import AnswerFlags, system_presentation
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, create_section
from marsyard.reports.statistics.error_summary import circular_error, error_ellipse
from marsyard.reports.wording import NOTHING, format_fraction, interval, label, note_text, number, percent
from marsyard.scenarios.columns import split_unit
from marsyard.scenarios.declared_columns import enabling_columns, find_column


def answers_section(subject: Subject) -> Section | None:
    """Create the section on availability and wrong answers; None if the rows contain no answers."""
    fractions = answer_fractions(subject)
    if not fractions:
        return None
    rows = [
        [
            name,
            f"{fraction.hits:,} of {fraction.n:,}",
            percent(fraction.fraction),
            rates.range_text(fraction.lower, fraction.upper),
            NOTHING if fraction.shared_lower is None else rates.interval_text(fraction, shared=True),
        ]
        for name, fraction in fractions.items()
    ]
    head = ["", "Cases", "Fraction", f"{format_fraction(CONFIDENCE)} interval", "Interval with shared terrains"]
    grid = Grid(head, rows)
    note = note_text("common.answers")
    return Section("answers", "Answers", "Availability and wrong answers", [Block(grid=grid, note=note)], fractions)


def answer_fractions(subject: Subject) -> Mapping[str, rates.CaseFraction]:
    """Compute the fractions of answered cases and of wrong answers, by name; empty without the column `answered`.

    Fractions that need other columns are omitted if the rows do not have them.
    """
    frame = subject.all_cases
    if not populations.is_flag(frame, "answered") or frame.empty:
        return {}
    is_answered = populations.population_mask(frame, "valid")
    fractions = {"answered (of all cases)": rates.fraction_of(is_answered, frame)}
    for column in enabling_columns(map(str, frame.columns)):
        if not populations.is_flag(frame, column.name):
            continue
        is_enabled, is_completed = (populations.population_mask(frame, name) for name in (column.name, "completed"))
        fractions[f"answered, of cases {column.population}"] = rates.fraction_of(
            is_answered[is_enabled], frame[is_enabled]
        )
        fractions[f"no {column.population.removeprefix('with ')} (of completed cases)"] = rates.fraction_of(
            ~is_enabled[is_completed], frame[is_completed]
        )
    flags = _answer_flags(subject)
    if flags is not None:
        is_reported, is_wrong = (populations.flag_mask(frame, name) for name in (flags.reported, flags.wrong))
        name = f"wrong answers: {_describe_flag(flags.wrong)} (of cases with a reported answer)"
        fractions[name] = rates.fraction_of(is_wrong[is_reported], frame[is_reported])
    elif subject.metric is not None and subject.bound is not None:
        has_error = _has_error(frame, subject.metric)
        is_wrong = ~populations.success_mask(frame[has_error], subject.metric, subject.bound)
        name = f"wrong answers: error above {subject.bound:g} {split_unit(subject.metric)[1]} (of answers)"
        fractions[name] = rates.fraction_of(is_wrong, frame[has_error])
    return fractions


def _answer_flags(subject: Subject) -> AnswerFlags | None:
    """Return the columns that classify the cases of the subject's system; None without a declaration."""
    presentation = system_presentation(str(subject.run.recorded("scenario") or ""))
    return None if presentation is None else presentation.answer_flags


def _describe_flag(name: str) -> str:
    column = find_column(name)
    return name if column is None else column.meaning


def _has_error(frame: pd.DataFrame, metric: str) -> Bool[np.ndarray, " n"]:
    """Create the mask of the answers that have an error: for a metric at a stated time, those that came in time.

    Cases that the engine could not finish and that may have an answer are included, because they count as failures.
    """
    has_value = ~np.isnan(sum((numbers(frame, column) for column in metric.split(" + ")), np.zeros(len(frame))))
    return np.asarray(populations.population_mask(frame, "valid") & (has_value | populations.engine_failed(frame)))


#: Fractions of the errors inside the circles whose radii are reported.
PROBABILITIES = (0.5, 0.95, 0.99)


def scatter_section(subject: Subject) -> Section | None:
    """Create the section on error ellipse and circular errors; None without x and y errors or for too few cases."""
    metric = subject.metric
    if metric is None:
        return None
    components = axis_columns(metric, [str(name) for name in subject.all_cases.columns])[:2]
    if len(components) < 2:
        return None
    errors = np.column_stack([numbers(subject.all_cases, component) for component in components])
    ellipse = error_ellipse(errors, ELLIPSE)
    if ellipse is None:
        return None
    groups = rates.terrain_groups(subject.all_cases)
    circles = [circular_error(errors, probability, CONFIDENCE, groups) for probability in PROBABILITIES]
    unit = split_unit(metric)[1]
    first, second = (label(component).removesuffix(f" ({unit})") for component in components)
    x, y = (number(value) for value in ellipse.centre)
    text = (
        f"{format_fraction(ELLIPSE)} ellipse, assuming normally distributed errors: centre {x}, {y} {unit}, semi-axes "
        f"{number(ellipse.semi_major)} and {number(ellipse.semi_minor)} {unit}, major axis at "
        f"{number(ellipse.angle_deg)} deg from the {first} towards the {second}. "
        f"{percent(ellipse.inside)} of these errors lie inside."
    )
    rows = [
        [
            format_fraction(circle.probability),
            "too few cases" if math.isnan(circle.estimate) else number(circle.estimate),
            interval(circle.lower, circle.upper),
        ]
        for circle in circles
    ]
    grid = Grid(
        ["Fraction of errors", f"Radius ({unit})", f"Lower and upper bound ({format_fraction(CONFIDENCE)} each)"], rows
    )
    note = note_text("common.scatter")
    block = Block(text=text, grid=grid, note=note)
    return Section(
        "scatter", "Scatter", "Error ellipse and circular errors", [block], {"ellipse": ellipse, "circles": circles}
    )


def _classify_answers(
    rows: pd.DataFrame, metric: str, bound: float, flags: AnswerFlags | None
) -> dict[str, Bool[np.ndarray, " n"]]:
    """Create the masks of correct answers (`valid`), cases without an answer (`invalid`) and wrong answers.

    Without flags, answers within the bound are correct. An answer without an error, for example one that came after
    the time of the metric, then counts as no answer.
    """
    if flags is not None:
        is_answered, is_correct = populations.flag_mask(rows, flags.reported), ~populations.flag_mask(rows, flags.wrong)
    else:
        is_answered, is_correct = _has_error(rows, metric), populations.success_mask(rows, metric, bound)
    return {"valid": is_answered & is_correct, "invalid": ~is_answered, "wrong": is_answered & ~is_correct}


def find_frequent_refusal(rows: pd.DataFrame) -> str:
    """Return the most frequent outcome of cases without an answer; empty if all cases have an answer."""
    if "outcome" not in rows:
        return ""
    refusals = rows.loc[~populations.population_mask(rows, "valid"), "outcome"].value_counts()
    return str(refusals.index[0]) if len(refusals) else ""


def fault_outcomes(metric: str, bound: float, flags: AnswerFlags | None = None) -> OutcomesBySize:
    """Define the outcomes of `_classify_answers` by fault and its size."""

    def classify(rows: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
        return _classify_answers(rows, metric, bound, flags)

    return OutcomesBySize(
        outcomes=classify,
        styles={"valid": ("valid", "full"), "invalid": ("invalid", "hatched"), "wrong": ("wrong", "crossed")},
        cases="Cases",
        wording=lambda fault, size: (label(fault), "" if math.isnan(size) or fault == NO_FAULT else f"{size:g}"),
        extra_columns=(
            ExtraColumn(
                "Most frequent refusal",
                "most_frequent_refusal",
                lambda rows: find_frequent_refusal(rows[classify(rows)["invalid"]]),
                lambda text: text or NOTHING,
            ),
        ),
    )


def faults_section(subject: Subject) -> Section | None:
    """Create the section on outcomes by fault and size; None without faults or bound."""
    if subject.metric is None or subject.bound is None or not populations.is_flag(subject.frame, "answered"):
        return None
    flags = _answer_flags(subject)
    if flags is not None:
        valid, wrong = f"{_describe_flag(flags.reported)}, and none is wrong", _describe_flag(flags.wrong)
    else:
        valid = f"the case is answered within {subject.bound:g} {split_unit(subject.metric)[1]}"
        wrong = "the case is answered with an error above the bound"
    note = note_text("common.faults", valid=valid, wrong=wrong, confidence=format_fraction(CONFIDENCE))
    caption = "Solid bars: correct answers. Hatched bars: no answer. Cross-hatched bars: wrong answers."
    blocks = fault_outcomes(subject.metric, subject.bound, flags).blocks(subject.frame, "faults", caption, note)
    return create_section("faults", "Faults", "Faults by size", *blocks)
