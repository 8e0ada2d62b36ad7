"""Tests of the sentences on a study of rare violations."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.json_numbers import convert_to_json
from marsyard.campaigns.studies.rare_decision import RareSample, decide_rare
from marsyard.campaigns.studies.results import RARE, RareParameters, RareResult, Replicate
from marsyard.campaigns.studies.subset import Level, SubsetEnd, SubsetResult
from marsyard.reports import rare
from marsyard.reports.rare import rare_sentences


def create_study(limit: float, violations: int, cases: int, terrains: int = 0, probability: float = 1e-4) -> Any:
    """Create the record of a study with four replicates around a probability."""
    replicates = [
        SubsetResult(factor * probability, SubsetEnd.VIOLATION, (2.0, 1.0), (Level(1.0, 50, 0),), np.zeros((1, 2)))
        for factor in (0.8, 1.0, 1.3, 0.9)
    ]
    names = [f"terrain {case % terrains}" if terrains else None for case in range(cases)]
    decision = decide_rare(RareSample(replicates, np.arange(cases) < violations, names), limit, 0.9)
    result = RareResult(decision.verdict, decision, 3000, 40, (), "The margin is 5 - |error|.")
    study = RARE.encode(RareParameters("VEL", limit)) | {"result": convert_to_json(asdict(result))}
    return {"study": json.loads(json.dumps(study))}


@pytest.mark.parametrize(
    ("limit", "terrains", "beginning", "messages"),
    [
        # 1 - 0.05^(1/1000) = 0.0030
        (1e-2, 0, "VEL: PASS, by counting independent cases.",
         ["Probability of a violation per case by counting: at most 0.003 (95 % confidence), from 0 violations in "
          "1,000 independent random cases. The limit is 0.01."]),
        # ln(0.025) / ln(0.999) = 3,687.04 cases at half of the risk, without the 1,000 finished ones
        (1e-3, 0, "VEL: INSUFFICIENT.",
         ["Subset simulation estimates 0.0001", "no PASS rests on it", "PASS needs 2,688 additional random cases "
          "without a violation: marsyard append DIR 2688 --random."]),
        (8e-5, 0, "VEL: ", ["would decide the verdict if the estimate remains: marsyard append DIR"]),
        (1e-5, 0, "VEL: FAIL, by the interval of the simulations; it assumes a continuous margin.", []),
        (1e-2, 50, "VEL: ", ["1,000 independent random cases on 50 terrains, which are counted instead of cases",
                             "each on a new terrain"]),
    ],
)  # fmt: skip
def test_sentences_state_verdict_bound_and_remedy(
    limit: float, terrains: int, beginning: str, messages: list[str]
) -> None:
    text = " ".join(rare_sentences(create_study(limit, 0, 1000, terrains)))
    assert text.startswith(beginning)
    for message in messages:
        assert message in text
    assert ("marsyard append" in text) == (len(messages) > 1 or limit == 8e-5)
    assert ("--random" in text) == (len(messages) > 1)


def test_figure_has_the_probabilities_of_the_levels() -> None:
    """Equal margins: a quarter of the cases reach the first level, not a tenth."""
    replicate = Replicate(3e-7, True, SubsetEnd.VIOLATION.value, (5.0, 4.0), (0.25, 0.09))
    (line,) = rare._draw_levels([replicate], 1e-4).axes[0].get_lines()[:1]
    assert line.get_xydata().tolist() == [[5.0, 0.25], [4.0, 0.09], [0.0, 3e-7]]


@pytest.mark.parametrize("study", [{}, {"kind": "search", "result": {"violations": 1}}])
def test_other_studies_have_no_sentences(study: dict[str, Any]) -> None:
    assert rare_sentences({"study": study}) == []


def test_damaged_result_is_reported() -> None:
    record = create_study(1e-2, 0, 1000)
    record["study"]["result"]["decision"]["counting"]["units"] = "many"
    with pytest.raises(StoreError, match=r"the study in campaign.json is damaged: .*integer"):
        rare_sentences(record)
