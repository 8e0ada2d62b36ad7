"""Results of a study of rare violations (`marsyard.campaigns.studies.rare`): sentences, and a section of the report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from marsyard.campaigns.studies.subset import LEVEL_FRACTION
from marsyard.reports.section import (
    MARKERS,
    REQUIREMENT,
    SERIES,
    Block,
    Grid,
    Section,
    Subject,
    in_page_style,
    new_axes,
    svg_figure,
)
from marsyard.reports.stored import read_study, table
from marsyard.reports.wording import count, format_fraction

#: Maximum number of replicates in the figure.
_MAX_REPLICATES = 8


def probability_text(value: object) -> str:
    """Format a probability with two significant digits; a dash if it is unknown."""
    return f"{value:.2g}" if isinstance(value, int | float) and math.isfinite(value) else "–"


def rare_sentences(study: Mapping[str, Any]) -> list[str]:
    """Describe verdict, counting bound, estimate and cost of a study; empty without a result.

    The first sentence contains the verdict, the second the counting bound.
    """
    if not study:
        return []
    result = study["result"]
    decision = result["decision"]
    limit = probability_text(study["max_probability"])
    basis = {
        "counting": ", by counting independent cases",
        "simulation": ", by the interval of the simulations; it assumes a continuous margin",
    }.get(str(decision["basis"]), "")
    return [
        f"{study['requirement']}: {result['verdict']}{basis}.",
        f"{_counting_sentence(decision['counting'])} The limit is {limit}.",
        _estimate_sentence(study, decision),
        *filter(None, [str(decision["reason"]), *_remedies(study, decision)]),
        f"The study ran {count(int(result['cases']), 'case')}; {int(result['violations']):,} of them violate the "
        "requirement.",
        str(result["margin_text"]),
    ]


def _counting_sentence(counting: Mapping[str, Any]) -> str:
    """Describe the counting bound."""
    cases, units = int(counting["cases"]), int(counting["units"])
    shared = f" on {count(units, 'terrain')}, which are counted instead of cases" if units < cases else ""
    sentence = (
        f"Probability of a violation per case by counting: at most {probability_text(counting['upper'])} "
        f"({format_fraction(counting['upper_confidence'])} confidence), from "
        f"{count(int(counting['violations']), 'violation')} in {count(cases, 'independent random case')}{shared}."
    )
    if counting["lower"] > 0.0:
        confidence = format_fraction(counting["lower_confidence"])
        sentence += f" It is at least {probability_text(counting['lower'])} ({confidence} confidence)."
    return sentence


def _estimate_sentence(study: Mapping[str, Any], decision: Mapping[str, Any]) -> str:
    """Describe the estimate of the simulations."""
    interval = decision["interval"]
    method = "Subset simulation" if study["method"] == "subset" else "Importance sampling"
    if interval["estimate"] is None:
        return f"{method} has no estimate."
    bounds = f"{probability_text(interval['lower'])} to {probability_text(interval['upper'])}"
    return (
        f"{method} estimates {probability_text(interval['estimate'])}, {format_fraction(interval['confidence'])} "
        f"interval {bounds}. The interval assumes that the margin falls continuously to a violation. Fewer cases than "
        "counting needs cannot show this, so that no PASS rests on it."
    )


def _remedies(study: Mapping[str, Any], decision: Mapping[str, Any]) -> list[str]:
    """Describe the additional cases or replicates that would decide the verdict."""
    random_cases, replicates = decision["additional_random_cases"], decision["additional_replicates"]
    sentences = []
    if random_cases:
        counting = decision["counting"]
        unit = "random cases" if counting["units"] == counting["cases"] else "random cases, each on a new terrain,"
        sentences.append(
            f"PASS needs {random_cases:,} additional {unit} without a violation: "
            f"marsyard append DIR {random_cases} --random."
        )
    if replicates:
        sentences.append(
            f"{count(replicates, 'additional replicate')} would decide the verdict if the estimate remains: "
            f"marsyard append DIR {replicates}."
        )
    return sentences


def rare_section(subject: Subject) -> Section | None:
    """Create the section of a study of rare violations; None for another run."""
    study = read_study(subject.run.record, "rare")
    if not study:
        return None
    result = study["result"]
    replicates = result["replicates"]
    rows = [
        [
            str(index + 1),
            probability_text(replicate["probability"]),
            str(len(replicate["thresholds"])),
            str(replicate["end"]),
        ]
        for index, replicate in enumerate(replicates)
    ]
    grid = Grid(["Replicate", "Probability", "Levels", "End"], rows)
    note = (
        "Each replicate is an independent subset simulation. A tenth of the cases of each level reaches the next one. "
        "The standard error within one replicate is too small, since its cases are correlated. "
        + (
            "The interval comes from the spread of the replicates."
            if study["method"] == "subset"
            else "The interval contains those of importance sampling around the violations, and of the replicates."
        )
        + " Without an end at violations, the probability is that of the last level."
        + _continuity_note(table(result["decision"]["continuity"]))
    )
    figure = svg_figure(
        _draw_levels(replicates, float(study["max_probability"])),
        "rare-levels",
        "Probability that the margin of a case is at most the value on the horizontal axis. Each line is one "
        "replicate; a violation is a margin below 0. Dashed: limit of the probability.",
    )
    blocks = (Block("Replicates", figures=[figure], grid=grid, note=note),)
    data = {
        **result,
        "requirement": study["requirement"],
        "max_probability": study["max_probability"],
        "method": study["method"],
    }
    return Section("rare", "Rare violation", "Probability of a rare violation", blocks, data)


def _continuity_note(continuity: Mapping[str, Any]) -> str:
    """Describe the violations that were reached without intermediate margins; empty without the check."""
    if not continuity:
        return ""
    return (
        f" Random cases, and levels far above the last one, reached {count(int(continuity['direct']), 'violation')} "
        f"directly; the interval predicts {continuity['expected_lower']:.2g} to {continuity['expected_upper']:.2g}."
    )


@in_page_style
def _draw_levels(replicates: list[Mapping[str, Any]], max_probability: float) -> Figure:
    """Draw the probability of a margin at or below the threshold of each level, a line for each replicate.

    A replicate that reached a violation also has the point of margin 0: its estimated probability of a violation.
    """
    figure, axes = new_axes(6.0, 3.4)
    for index, replicate in enumerate(replicates[:_MAX_REPLICATES]):
        thresholds = [value for value in replicate["thresholds"] if value is not None]
        # each level contains this fraction of the cases of the previous level
        probabilities = [LEVEL_FRACTION ** (level + 1) for level in range(len(thresholds))]
        margins = [*thresholds, 0.0] if replicate["reached"] else thresholds
        probabilities = [*probabilities, replicate["probability"]] if replicate["reached"] else probabilities
        style: dict[str, Any] = {"color": SERIES[index % len(SERIES)], "marker": MARKERS[index % len(MARKERS)]}
        axes.plot(margins, probabilities, markersize=4, linewidth=1.0, **style)
    axes.axhline(max_probability, color=REQUIREMENT, linestyle="--", linewidth=1.0)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: probability_text(value))
    axes.set(xlabel="margin (unit of the requirement's bound)", ylabel="probability of a margin at or below")
    return figure
