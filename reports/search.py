"""Results of a search for violations (`marsyard.campaigns.studies.search`): sentences, and a section of the report.

A reduced violation is a violating case in which as few parameters as possible differ from those of the campaign file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.stored import read_study
from marsyard.reports.wording import NOTHING, count, number


def search_sentences(study: Mapping[str, Any]) -> list[str]:
    """Describe the result of a search: violations, reduced violations, and cost; empty without a result."""
    if not study:
        return []
    result = study["result"]
    cases_text = count(int(result["search_cases"]), "case")
    total_text = f"{count(int(result['cases']), 'case')} in all"
    if not result["violations"]:
        margin = number(float(result["min_margin"])) if result.get("min_margin") is not None else NOTHING
        sentences = [f"{study['requirement']}: no violation in {cases_text}; the smallest margin is {margin}."]
    else:
        violations, n_reduced = count(int(result["violations"]), "violation"), len(result["failures"])
        sentences = [
            f"{study['requirement']}: {violations} in {cases_text}, the first after {result['first_violation']}; "
            f"{count(n_reduced, 'reduced violation')} after {total_text}."
        ]
    sentences += [failure_sentence(index, failure) for index, failure in enumerate(result["failures"], start=1)]
    return [*sentences, *([str(result["reason"])] if result.get("reason") else []), str(result["margin_text"])]


def failure_sentence(index: int, failure: Mapping[str, Any]) -> str:
    """Describe a reduced violation: its values, its margin, and how often it repeats."""
    values = ", ".join(f"{path} = {value_text(value)}" for path, value in failure["values"].items())
    margin = failure["margin"]
    margin_text = f"margin {number(float(margin))}" if margin is not None else str(failure["outcome"])
    return (
        f"{index}. {values or 'The parameters of the campaign file'}, other parameters not dispersed: {margin_text} "
        f"(case {failure['case']}); {failure['repeated']} of {failure['repetitions']} repetitions with new random "
        "streams violate the requirement."
    )


def value_text(value: object) -> str:
    """Format a parameter value."""
    return number(float(value)) if isinstance(value, float) else str(value)


def search_section(subject: Subject) -> Section | None:
    """Create the section of a search; None for a run that is no search."""
    study = read_study(subject.run.record, "search")
    if not study:
        return None
    result = study["result"]
    rows = [
        [
            str(index),
            ", ".join(f"{path} = {value_text(value)}" for path, value in failure["values"].items()) or NOTHING,
            NOTHING if failure["margin"] is None else number(float(failure["margin"])),
            number(float(failure["distance"])),
            str(failure["similar"]),
            f"{failure['repeated']} of {failure['repetitions']}",
            str(failure["case"]),
        ]
        for index, failure in enumerate(result["failures"], start=1)
    ]
    head = ["", "Parameters", "Margin", "Distance (standard deviations)", "Similar violations", "Repeated", "Case"]
    note = (
        "All other parameters are those of the campaign. The distance of the parameters from their medians measures "
        "how unlikely they are; the most likely violation is the first. Each violation has a campaign file in the "
        "folder failures, and nightly.toml lists them for nightly runs."
    )
    block = Block("Reduced violations", grid=Grid(head, rows), note=note) if rows else Block(text="No violation.")
    return Section(
        "search", "Search", "Search for violations", (block,), {**result, "requirement": study["requirement"]}
    )
