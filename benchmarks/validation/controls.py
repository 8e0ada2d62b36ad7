"""Negative controls on every campaign of the catalogue: each must fail at least one requirement.

The controls are algorithms that use no image, refuse, answer without regard to the case, crash, hang or return NaN
(`marsyard.algorithms.controls`). A campaign whose requirements a control meets gives a PASS without meaning.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from benchmarks.validation.records import Check, Measure
from marsyard.algorithms.faults import Fault
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.verdicts import Status
from marsyard.scenarios.systems import catalogue, systems

MODULE = "marsyard.algorithms.controls"
#: Title of each control, by the name of its class. Controls of one line run on the same images, except in scenarios of
#: `CLOSED_LOOP`. Those that answer are separate from those that fail, because the columns of a failure depend on the
#: algorithm under test.
ANSWERING = {"NoImage": "no image", "Refusal": "refusal", "Constant": "constant"}
FAILING = {"NotANumber": "NaN", "Crash": "crash"}
HANG = {"Hang": "hang"}
TITLES: Mapping[str, str] = {**ANSWERING, **FAILING, **HANG}

#: Scenarios in which the answers of an algorithm determine its images: each control runs as algorithm under test.
CLOSED_LOOP = ("rover",)

Row = dict[str, Any]


@dataclass(frozen=True)
class ControlRun:
    """Cases of a campaign on which the controls run, and changes of its file (``KEY=VALUE``)."""

    cases: Sequence[int] = (0, 1, 2, 3)
    overrides: tuple[str, ...] = ()


#: Campaigns whose first four cases are expensive or do not contain the populations of their requirements. Fault
#: campaigns run without a fault, because a refusal is right with one.
RUNS: Mapping[str, ControlRun] = {
    # two runs of the helicopter; two noisy runs and the run with an intact cable
    "dimes-fieldtest": ControlRun((12, 36, 42, 5, 13, 20)),
    "dimes-fieldtest-noise": ControlRun((0, 5, 1, 7, 4, 13)),
    "dimes-offnominal": ControlRun(overrides=("faults={}",)),
    "hda-faults": ControlRun(tuple(range(12)), ("faults={}",)),
    "hda-mars": ControlRun(tuple(range(12))),
    "hda-threshold": ControlRun((0, 1, 2, 3, 22)),
    # each descent has a terrain of 178 MB
    "loc-faults": ControlRun((0, 1), ("faults={}",)),
    **dict.fromkeys(("loc-coarse", "loc-jezero", "loc-light", "loc-map-error", "loc-sensitivity"), ControlRun((0, 1))),
    # drives of many updates, of which one that fails is sufficient
    "vtt-checkout-1": ControlRun((0, 1)),
    "vtt-checkout-2": ControlRun((0, 1)),
    "vtt-checkout-3": ControlRun((0,)),
    "vtt-regression": ControlRun((0, 1)),
    "vtt-terrains": ControlRun((0, 1, 2)),
    # targets of one drive that stay in view
    "vtt-sideways": ControlRun((70, 71, 72)),
    "vtt-straight": ControlRun((0, 2, 8)),
    "vtt-turn": ControlRun((45, 46, 54, 55)),
}


def run_controls(campaign_name: str, run: ControlRun) -> tuple[Campaign, dict[str, pd.DataFrame]]:
    """Run all controls on cases of a campaign; return the campaign and the rows of each control, by its class.

    A hanging algorithm has the rows of one that crashes, with the outcome TIMED_OUT.
    """
    rows: dict[str, list[Row]] = {name: [] for name in TITLES}
    groups: list[tuple[str, ...]] = [tuple(ANSWERING), tuple(FAILING)]
    if load_campaign(campaign_name, run.overrides).definition.scenario in CLOSED_LOOP:
        groups = [(name,) for names in groups for name in names]
    for names in groups:
        specs = [f"{MODULE}:{name}" for name in names]
        campaign = load_campaign(campaign_name, run.overrides, algorithms=specs)
        for case in run.cases:
            rows_by_name = _run_case(campaign, names, case)
            for name, row in rows_by_name.items():
                rows[name].append(row)
            if "Crash" in names:
                rows["Hang"].append({**rows_by_name["Crash"], "outcome": Fault.TIMED_OUT.name})
    return campaign, {name: pd.DataFrame(items) for name, items in rows.items()}


def _run_case(campaign: Campaign, names: Sequence[str], case: int) -> dict[str, Row]:
    """Run one case; return the row of each algorithm as if it were under test."""
    result = campaign.scenario.run(campaign.parameters(case), campaign.streams(case))
    prefixes = {name: f"{name}." for name in names[1:]}
    is_compared = tuple(prefixes.values())
    first = {column: value for column, value in result.row.items() if not column.startswith(is_compared)}
    rows = {names[0]: {**first, "outcome": result.outcome, "answered": result.answered}}
    for name, prefix in prefixes.items():
        own = {column.removeprefix(prefix): result.row[column] for column in result.row if column.startswith(prefix)}
        rows[name] = {**{column: value for column, value in first.items() if column not in own}, **own}
    return rows


def find_failed_requirements(campaign: Campaign, frame: pd.DataFrame) -> list[str]:
    """Evaluate a campaign's requirements on rows; return the ids of those that fail."""
    requirements = [item.model_dump() for item in campaign.definition.requirements]
    sampling = read_sampling_design(campaign.definition.model_dump(mode="json"))
    verdicts = evaluate_requirements(frame, requirements, sampling)
    return [verdict.requirement_id for verdict in verdicts if verdict.status is Status.FAIL]


def measure_campaign(campaign_name: str, run: ControlRun) -> Measure:
    """Count the controls that fail no requirement of a campaign."""
    return create_measure(*run_controls(campaign_name, run))


def create_measure(campaign: Campaign, frames: Mapping[str, pd.DataFrame]) -> Measure:
    """Create the row of a campaign from the rows of each control."""
    failed = [find_failed_requirements(campaign, frame) for frame in frames.values()]
    claim = f"`{campaign.definition.name}`, cases: {len(frames['Crash'])}"
    cells = " | ".join(", ".join(names) or "**none**" for names in failed)
    return Measure(claim, float(failed.count([])), "1", 0.0, cells)


def _check_controls(quick: bool) -> Iterator[Measure]:
    """Run the controls on all campaigns of the catalogue, or on a small one of each system."""
    if quick:
        for system in systems():
            for name, overrides in system.compilation_campaigns.items():
                yield measure_campaign(name, ControlRun((0, 1), overrides))
        return
    for name in catalogue():
        yield measure_campaign(name, RUNS.get(name, ControlRun()))


CHECKS = (Check("controls", "Negative controls", _check_controls, tuple(TITLES.values())),)
