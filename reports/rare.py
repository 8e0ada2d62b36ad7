"""Results of a study of rare violations (`marsyard.campaigns.studies.rare`): sentences, and a section of the report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from matplotlib.figure import Figure

from marsyard.campaigns.json_numbers import convert_to_json
from marsyard.campaigns.studies.counting import CountingBound
from marsyard.campaigns.studies.interval import ProbabilityInterval
from marsyard.campaigns.studies.rare_decision import Basis, ContinuityCheck, Decision
from marsyard.campaigns.studies.results import RARE, Replicate
from marsyard.reports import figure_style, section
from marsyard.reports.wording import count, format_fraction

#: Maximum number of replicates in the figure.
_MAX_REPLICATES = 8


def probability_text(value: object) -> str:
    """Format a probability with two significant digits; a dash if it is unknown."""
    return f"{value:.2g}" if isinstance(value, int | float) and math.isfinite(value) else "–"


def rare_sentences(record: Mapping[str, Any]) -> list[str]:
    """Describe verdict, counting bound, estimate and cost of a study in a record; empty without a result."""
    study = RARE.read(record)
    if study is None:
        return []
    parameters, result = study
    decision = result.decision
    basis = {
        Basis.COUNTING: ", by counting independent cases",
        Basis.SIMULATION: ", by the interval of the simulations; it assumes a continuous margin",
    }.get(decision.basis, "")
    return [
        f"{parameters.requirement}: {result.verdict}{basis}.",
        rare_bound_sentence(record),
        _estimate_sentence(parameters.method, decision.interval),
        *filter(None, [decision.reason, *_remedies(decision)]),
        f"The study ran {count(result.cases, 'case')}; {result.violations:,} of them violate the requirement.",
        result.margin_text,
    ]


def rare_bound_sentence(record: Mapping[str, Any]) -> str:
    """Describe the counting bound of a study of rare violations and its limit; empty for another run."""
    study = RARE.read(record)
    if study is None:
        return ""
    parameters, result = study
    limit = probability_text(parameters.max_probability)
    return f"{_counting_sentence(result.decision.counting)} The limit is {limit}."


def _counting_sentence(counting: CountingBound) -> str:
    """Describe the counting bound."""
    cases, units = counting.cases, counting.units
    shared = f" on {count(units, 'terrain')}, which are counted instead of cases" if units < cases else ""
    sentence = (
        f"Probability of a violation per case by counting: at most {probability_text(counting.upper)} "
        f"({format_fraction(counting.upper_confidence)} confidence), from "
        f"{count(counting.violations, 'violation')} in {count(cases, 'independent random case')}{shared}."
    )
    if counting.lower > 0.0:
        confidence = format_fraction(counting.lower_confidence)
        sentence += f" It is at least {probability_text(counting.lower)} ({confidence} confidence)."
    return sentence


def _estimate_sentence(method: str, interval: ProbabilityInterval) -> str:
    """Describe the estimate of the simulations."""
    title = "Subset simulation" if method == "subset" else "Importance sampling"
    if math.isnan(interval.estimate):
        return f"{title} has no estimate."
    bounds = f"{probability_text(interval.lower)} to {probability_text(interval.upper)}"
    return (
        f"{title} estimates {probability_text(interval.estimate)}, {format_fraction(interval.confidence)} "
        f"interval {bounds}. The interval assumes that the margin falls continuously to a violation. Fewer cases than "
        "counting needs cannot show this, so that no PASS rests on it."
    )


def _remedies(decision: Decision) -> list[str]:
    """Describe the additional cases or replicates that would decide the verdict."""
    random_cases, replicates = decision.additional_random_cases, decision.additional_replicates
    sentences = []
    if random_cases:
        is_case = decision.counting.units == decision.counting.cases
        unit = "random cases" if is_case else "random cases, each on a new terrain,"
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


def rare_section(subject: section.Subject) -> section.Section | None:
    """Create the section of a study of rare violations; None for another run."""
    study = RARE.read(subject.run.record)
    if study is None:
        return None
    parameters, result = study
    rows = [
        [str(number), probability_text(replicate.probability), str(len(replicate.thresholds)), replicate.end]
        for number, replicate in enumerate(result.replicates, start=1)
    ]
    grid = section.Grid(["Replicate", "Probability", "Levels", "End"], rows)
    note = (
        "Each replicate is an independent subset simulation. A tenth of the cases of each level reaches the next one; "
        "where many cases have the same margin, more or fewer do. "
        "The standard error within one replicate is too small, since its cases are correlated. "
        + (
            "The interval comes from the spread of the replicates."
            if parameters.method == "subset"
            else "The interval contains those of importance sampling around the violations, and of the replicates."
        )
        + " Without an end at violations, the probability is that of the last level."
        + _continuity_note(result.decision.continuity)
    )
    figure = section.svg_figure(
        _draw_levels(result.replicates, parameters.max_probability),
        "rare-levels",
        "Probability that the margin of a case is at most the value on the horizontal axis. Each line is one "
        "replicate; a violation is a margin below 0. Dashed: limit of the probability.",
    )
    blocks = (section.Block("Replicates", figures=[figure], grid=grid, note=note),)
    names = ("requirement", "max_probability", "method")
    data = convert_to_json(asdict(result)) | {name: getattr(parameters, name) for name in names}
    return section.Section("rare", "Rare violation", "Probability of a rare violation", blocks, data)


def _continuity_note(continuity: ContinuityCheck | None) -> str:
    """Describe the violations that were reached without intermediate margins; empty without the check."""
    if continuity is None:
        return ""
    return (
        f" Random cases, and levels far above the last one, reached {count(continuity.direct, 'violation')} "
        f"directly; the interval predicts {continuity.expected_lower:.2g} to {continuity.expected_upper:.2g}."
    )


@figure_style.in_page_style
def _draw_levels(replicates: Sequence[Replicate], max_probability: float) -> Figure:
    """Draw the probability of a margin at or below the threshold of each level, a line for each replicate.

    A replicate that reached a violation also has the point of margin 0: its estimated probability of a violation.
    """
    figure, axes = figure_style.new_axes(6.0, 3.4)
    for index, replicate in enumerate(replicates[:_MAX_REPLICATES]):
        levels = zip(replicate.thresholds, replicate.level_probabilities, strict=True)
        points = [(margin, probability) for margin, probability in levels if math.isfinite(margin)]
        if replicate.reached:
            points.append((0.0, replicate.probability))
        margins, probabilities = [margin for margin, _ in points], [probability for _, probability in points]
        style: dict[str, Any] = {
            "color": figure_style.SERIES[index % len(figure_style.SERIES)],
            "marker": figure_style.MARKERS[index % len(figure_style.MARKERS)],
        }
        axes.plot(margins, probabilities, markersize=4, linewidth=1.0, **style)
    axes.axhline(max_probability, color=figure_style.REQUIREMENT, linestyle="--", linewidth=1.0)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: probability_text(value))
    axes.set(xlabel="margin (unit of the requirement's bound)", ylabel="probability of a margin at or below")
    return figure
