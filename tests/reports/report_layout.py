"""Pydantic models of `report.json`; tests compare them with `reports/report.schema.json` and with written reports."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

VerdictName = Literal["PASS", "FAIL", "INSUFFICIENT", "MET BY RATE", "PASS (unregistered)", "PASS (other claims)"]


class _Model(BaseModel):
    """Base class of the models; undeclared keys are rejected, and null represents NaN and infinities."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ClusterEvidence(_Model):
    """Evidence from cases that share terrains; a terrain is a cluster."""

    terrains: int
    failed_terrains: int
    successful_terrains: int
    failure_pairs: int = Field(description="number of pairs of failures on one terrain")


class AllCases(_Model):
    """The same requirement on all cases."""

    status: VerdictName
    n: int
    failures: int
    estimate: float | None
    lower: float | None
    upper: float | None
    configured: list[str] = Field(
        description="columns of the population that remain conditions, because a case's configuration determines them"
    )


class Evidence(_Model):
    """Kind of evidence of the run, by its seed and its frozen algorithm."""

    kind: Literal[
        "confirmation",
        "repetition of a confirmation",
        "calibration",
        "exploration",
        "reused confirmation seed",
        "not the frozen evaluation",
    ]
    number: int = Field(description="number of the confirmation of its claim; 0 for other kinds")
    claim: str = Field(description="hash of the confirmed content; empty for other kinds")
    record: str = Field(description="file of the record of confirmations")
    registration: str = Field(description="why the record was not registered when the run started; empty if it was")
    overlap: float | None = Field(description="fraction of the cases on terrains of calibration runs; null if unknown")
    imported_terrain: bool = Field(description="true if the cases are on an imported DTM")
    changes: list[str]
    title: str
    text: str


class RequirementVerdict(_Model):
    """Verdict on one requirement."""

    requirement_id: str
    statement: str
    source: str
    kind: str
    metric: str
    scale: float | None
    bound: float | None
    probability: float | None
    confidence: float | None
    population: str
    decide_by: str = Field(description="`confidence`: by the bounds; `estimate`: by the observed rate")
    status: VerdictName
    confident_status: VerdictName = Field(description="verdict by the bounds, also where the observed rate decides")
    plain_status: VerdictName | None = Field(description="verdict for independent cases; null if no terrain is shared")
    n: int
    failures: int
    estimate: float | None
    lower: float | None = Field(description="one-sided, at `bounds_confidence`")
    upper: float | None = Field(description="one-sided, at `upper_confidence`")
    bounds_confidence: float | None = Field(description="confidence of the lower bound")
    upper_confidence: float | None
    plain_lower: float | None
    plain_upper: float | None
    consumer_risk: float | None = Field(
        description="probability of evidence at least as good if the success rate equals the required rate"
    )
    margin: float | None = Field(description="deciding bound or estimate, minus the required rate")
    further_cases: int | None = Field(description="additional cases that lead to PASS if none of them fails")
    terrains: int | None
    clustered: ClusterEvidence | None
    reason: str
    advice: str = Field(description="reason why more cases do not help, and the necessary change")
    accept_rate: bool = Field(description="true if MET BY RATE has exit status 0")
    withheld_status: VerdictName | None = Field(
        description="status by the numbers alone; null unless the kind of evidence changed it to INSUFFICIENT"
    )
    all_cases: AllCases | None = Field(description="the requirement on all cases; null if its population is all cases")
    definitions: str = Field(
        description="definitions of the population's columns that the flight system cannot know; may be empty"
    )
    joint_text: str = Field(
        description="sentence: contribution of this run to the joint evidence of its claim; may be empty"
    )
    note: str


class QuantileBounds(_Model):
    """A quantile with one-sided bounds."""

    probability: float
    estimate: float | None
    lower: float | None
    upper: float | None


class ErrorStatistics(_Model):
    """Statistics of errors."""

    n: int
    missing: int
    mean: float | None
    mean_lower: float | None
    mean_upper: float | None
    sd: float | None
    sd_lower: float | None
    sd_upper: float | None
    rms: float | None
    median: float | None
    robust_sd: float | None
    largest: float | None
    quantiles: list[QuantileBounds]
    confidence: float


class TerrainBank(_Model):
    """The terrains that cases can use."""

    terrains: int
    key: str = Field(description="parameter that sets the number of terrains")
    in_turn: bool = Field(description="true: the cases use the terrains in turn; false: terrains are drawn at random")


class SamplingDescription(_Model):
    """Sampling design of the cases."""

    design: str = Field(description="`random`, `latin-hypercube` or `sobol`")
    grids: list[str] = Field(description="paths of the parameters that were swept as a grid")
    nominal: bool = Field(description="whether case 0 has the nominal parameters instead of sampled ones")
    max_cases: int | None = Field(
        description="cases at the last planned evaluation; null unless the campaign stops when its verdicts are decided"
    )
    first_look: int | None = Field(description="cases at the first verdict; null unless cases were appended after it")
    terrains: TerrainBank | None
    independent: bool = Field(description="whether the cases, except the nominal one, are independent random samples")
    text: str


class AlgorithmDescription(_Model):
    """An algorithm under test; unknown texts are empty."""

    name: str = Field(description="name in the campaign")
    tested: bool = Field(description="false for an algorithm that is only compared")
    path: str = Field(description="class as module:name, or file")
    version: str
    options: dict[str, Any]
    source_hash: str


class StudyDescription(_Model):
    """A study: its kind, its requirement, and its main result."""

    kind: str
    requirement: str
    sentence: str


class CampaignReport(_Model):
    """Content of `report.json`: the results of a campaign's report."""

    report_schema: Literal[7] = Field(alias="schema")
    campaign: str
    state: Any = Field(description="copied from `campaign.json`, as are seed, git_commit, started_utc and finished_utc")
    seed: Any
    git_commit: Any
    started_utc: Any
    finished_utc: Any
    cases: int
    crashed: int
    sites: list[str] = Field(description="sites in the rows, at most 24")
    algorithms: list[str] = Field(description="algorithms in the rows, at most 24")
    algorithm_details: list[AlgorithmDescription] = Field(
        default=[], description="from campaign.json, the algorithm under test first"
    )
    sampling: SamplingDescription
    evidence: Evidence
    verdict: VerdictName | Literal["PASS (exploration)", "NO REQUIREMENT", "NO VERDICT"]
    sentence: str
    study: StudyDescription | None = None
    exit_code: Literal[0, 1, 3]
    verdicts: list[RequirementVerdict]
    outcomes: dict[str, int]
    metric: str | None
    statistics: dict[str, ErrorStatistics]
    worst_cases: list[str]
    sections: dict[str, Any] = Field(description="data of each further section of the page, by the section's anchor")
    showcases: list[int] = Field(description="cases with stored products")
