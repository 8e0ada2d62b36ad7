"""Result of a study in sentences."""

from collections.abc import Mapping
from typing import Any

from marsyard.reports.budget import budget_sentences
from marsyard.reports.rare import rare_sentences
from marsyard.reports.report_file import StudySummary
from marsyard.reports.robustness_section import robust_sentences
from marsyard.reports.search import search_sentences
from marsyard.reports.stored import table


def study_sentences(record: Mapping[str, Any]) -> list[str]:
    """Describe the result of a study, the most important sentence first; empty for an ordinary campaign."""
    sentences = (rare_sentences, search_sentences, budget_sentences, robust_sentences)
    return [text for describe in sentences for text in describe(record)]


def describe_study(record: Mapping[str, Any]) -> StudySummary | None:
    """Return kind, requirement and main result of a study for `report.json`; None for an ordinary campaign."""
    study, sentences = table(record.get("study")), study_sentences(record)
    if not study:
        return None
    # the first sentence of a rare study is its verdict, the second the probability
    main_sentences = sentences[1:2] if study.get("kind") == "rare" else sentences[:1]
    sentence = "".join(main_sentences) or "The study is not finished."
    return StudySummary(str(study.get("kind")), str(study.get("requirement") or ""), sentence)
