"""Results of a study of rare violations (`marsyard.campaigns.studies.rare`): sentences, and a section of the report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
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
from marsyard.reports.stored import read_run, table
from marsyard.reports.wording import count, format_fraction

#: Maximum number of replicates in the figure.
_MAX_REPLICATES = 8


def read_result(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the settings of a study of rare violations with its `result`; empty for another or an unfinished study."""
    study = table(record.get("study"))
    return study if study.get("kind") == "rare" and table(study.get("result")) else {}


def describe_result(directory: Path) -> list[str]:
    """Describe the result of the study in a folder, one sentence each; empty without a result."""
    study = read_result(read_run(directory).record)
    return result_sentences(study)


def probability_text(value: object) -> str:
    """Format a probability with two significant digits; a dash if it is unknown."""
    return f"{value:.2g}" if isinstance(value, int | float) and math.isfinite(value) else "–"


def result_sentences(study: Mapping[str, Any]) -> list[str]:
    """Describe estimate, interval, verdict and cost of a study; empty without a result."""
    if not study:
        return []
    result = table(study.get("result"))
    interval, cases = table(result.get("interval")), int(result["cases"])
    limit = probability_text(study["max_probability"])
    method = "subset simulation" if study["method"] == "subset" else "importance sampling"
    bounds = f"{probability_text(interval.get('lower'))} to {probability_text(interval.get('upper'))}"
    sentences = [
        f"{study['requirement']}: {result['verdict']}.",
        f"Probability of a violation per case: {probability_text(interval.get('estimate'))}, "
        f"{format_fraction(interval['confidence'])} interval {bounds} by {method}; the limit is {limit}.",
    ]
    if result.get("reason"):
        sentences.append(str(result["reason"]))
    counting = result.get("counting_cases")
    cost = f"The study ran {count(cases, 'case')}; {int(result['violations']):,} of them violate the requirement."
    if isinstance(counting, int | float) and counting > cases:
        cost += f" Counting would need about {counting:,.0f} independent cases for an interval of the same width."
    sentences.append(cost)
    if not all(replicate["reached"] for replicate in result["replicates"]):
        sentences.append(
            "Some replicates stopped without a violation, at levels less likely than a hundredth of the limit. The "
            "probability of their last level is used as an upper limit of their estimate; the lower bound of the "
            "interval is 0."
        )
    additional = result.get("additional_cases")
    if additional:
        per_replicate = cases / len(result["replicates"])
        replicates = math.ceil(additional / per_replicate)
        sentences.append(
            f"About {additional:,} additional cases ({count(replicates, 'replicate')}) would decide the verdict if the "
            f"estimate remains: marsyard append DIR {replicates}."
        )
    sentences.append(str(result["margin_text"]))
    return sentences


def rare_section(subject: Subject) -> Section | None:
    """Create the section of a study of rare violations; None for another run."""
    study = read_result(subject.run.record)
    if not study:
        return None
    result = table(study.get("result"))
    replicates = result["replicates"]
    rows = [
        [
            str(index + 1),
            probability_text(replicate["probability"]),
            str(len(replicate["thresholds"])),
            "yes" if replicate["reached"] else "no",
        ]
        for index, replicate in enumerate(replicates)
    ]
    grid = Grid(["Replicate", "Probability", "Levels", "Violation reached"], rows)
    note = (
        "Each replicate is an independent subset simulation. A tenth of the cases of each level "
        "reaches the next one. The standard error within one replicate is too small, since its "
        "cases are correlated. "
        + (
            "The interval comes from the spread of the replicates."
            if study["method"] == "subset"
            else "The interval contains those of importance sampling around the violations, and of the replicates."
        )
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
