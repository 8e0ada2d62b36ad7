"""Results of a search for violations (`marsyard.campaigns.studies.search`): sentences, and a section of the report.

A reduced violation is a violating case in which as few parameters as possible differ from those of the campaign file.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from marsyard.campaigns.json_numbers import convert_to_json
from marsyard.campaigns.studies.results import SEARCH, FoundFailure
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.wording import NOTHING, count, note_text, number


def search_sentences(record: Mapping[str, Any]) -> list[str]:
    """Describe the result of a search in a record: violations, reduced violations, and cost; empty without a result."""
    study = SEARCH.read(record)
    if study is None:
        return []
    parameters, result = study
    cases_text, total_text = count(result.search_cases, "case"), f"{count(result.cases, 'case')} in all"
    if not result.violations:
        text = f"no violation in {cases_text}; the smallest margin is {_margin_text(result.min_margin)}."
    else:
        violations, n_reduced = count(result.violations, "violation"), len(result.failures)
        text = (
            f"{violations} in {cases_text}, the first after {result.first_violation}; "
            f"{count(n_reduced, 'reduced violation')} after {total_text}."
        )
    failures = [failure_sentence(index, failure) for index, failure in enumerate(result.failures, start=1)]
    return [f"{parameters.requirement}: {text}", *failures, *filter(None, [result.reason]), result.margin_text]


def failure_sentence(index: int, failure: FoundFailure) -> str:
    """Describe a reduced violation: its values, its margin, and how often it repeats."""
    margin_text = failure.outcome if math.isnan(failure.margin) else f"margin {number(failure.margin)}"
    return (
        f"{index}. {_list_values(failure) or 'The parameters of the campaign file'}, other parameters not dispersed: "
        f"{margin_text} (case {failure.case}); {failure.repeated} of {failure.repetitions} repetitions with new random "
        "streams violate the requirement."
    )


def _list_values(failure: FoundFailure) -> str:
    values = {path: number(value) if isinstance(value, float) else value for path, value in failure.values.items()}
    return ", ".join(f"{path} = {value}" for path, value in values.items())


def _margin_text(margin: float) -> str:
    return NOTHING if math.isnan(margin) else number(margin)


def search_section(subject: Subject) -> Section | None:
    """Create the section of a search; None for a run that is no search."""
    study = SEARCH.read(subject.run.record)
    if study is None:
        return None
    parameters, result = study
    rows = [
        [
            str(index),
            _list_values(failure) or NOTHING,
            _margin_text(failure.margin),
            number(failure.distance),
            str(failure.similar),
            f"{failure.repeated} of {failure.repetitions}",
            str(failure.case),
        ]
        for index, failure in enumerate(result.failures, start=1)
    ]
    head = ["", "Parameters", "Margin", "Distance (standard deviations)", "Similar violations", "Repeated", "Case"]
    note = note_text("common.search")
    block = Block("Reduced violations", grid=Grid(head, rows), note=note) if rows else Block(text="No violation.")
    data = convert_to_json(asdict(result)) | {"requirement": parameters.requirement}
    return Section("search", "Search", "Search for violations", (block,), data)
