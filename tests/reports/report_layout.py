"""Models of `report.json`; they generate and check `reports/report.schema.json`."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Word = Literal["PASS", "FAIL", "INSUFFICIENT", "MET BY RATE"]


class _Part(BaseModel):
    """Plain data; null stands for NaN and infinities."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TwinClusters(_Part):
    """Evidence of cases that share terrains."""

    terrains: int
    failed_terrains: int
    method: str
    design_effect: float | None = Field(description="null for too few failures or terrains")
    effective_n: float = Field(description="equivalent number of independent cases")
    effective_successes: float
    lower: float
    upper: float


class TwinVerdict(_Part):
    """One requirement evaluated."""

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
    decide_by: str = Field(description="`confidence`, or `estimate`: by the rate seen")
    status: Word
    confident_status: Word = Field(description="by the bounds, also where the estimate decides")
    plain_status: Word | None = Field(description="as for independent cases; null where no terrain is shared")
    n: int
    failures: int
    estimate: float | None
    lower: float | None = Field(description="one-sided, at `bounds_confidence`")
    upper: float | None = Field(description="one-sided, at `upper_confidence`")
    bounds_confidence: float | None = Field(description="of the lower bound")
    upper_confidence: float | None
    plain_lower: float | None
    plain_upper: float | None
    consumer_risk: float | None = Field(description="probability of evidence as good at just the rate asked")
    margin: float | None = Field(description="deciding bound, or estimate, less the rate asked")
    further_cases: int | None = Field(description="that would pass it if none fails")
    terrains: int | None
    clustered: TwinClusters | None
    reason: str
    advice: str = Field(description="why more cases cannot help, and the change that does")
    accept_rate: bool = Field(description="whether MET BY RATE gives the exit status 0")
    note: str


class TwinQuantile(_Part):
    """A quantile with one-sided bounds."""

    probability: float
    estimate: float | None
    lower: float | None
    upper: float | None


class TwinStatistics(_Part):
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
    quantiles: list[TwinQuantile]
    confidence: float


class TwinTerrains(_Part):
    """The terrains that cases can use."""

    terrains: int
    key: str = Field(description="parameter that sets their number")
    in_turn: bool


class TwinSampling(_Part):
    """How cases were drawn."""

    design: str
    grids: list[str]
    nominal: bool
    max_cases: int | None
    first_look: int | None = Field(description="cases at the first verdict, where cases were appended")
    terrains: TwinTerrains | None
    independent: bool
    text: str


class TwinAlgorithm(_Part):
    """An algorithm under test; unknown texts are empty."""

    name: str = Field(description="as the campaign names it")
    tested: bool = Field(description="false where it is only compared")
    path: str = Field(description="class as module:name, or file")
    version: str
    options: dict[str, Any]
    source_hash: str


class Twin(_Part):
    """A campaign's report in numbers."""

    report_schema: Literal[5] = Field(alias="schema")
    campaign: str
    state: Any = Field(description="as the campaign's record has it, as are seed, git_commit and the times")
    seed: Any
    git_commit: Any
    started_utc: Any
    finished_utc: Any
    cases: int
    crashed: int
    sites: list[str] = Field(description="as the rows name them, at most 24, as are the algorithms")
    algorithms: list[str]
    algorithm_details: list[TwinAlgorithm] = Field(
        default=[], description="as the campaign's record names them, the algorithm under test first"
    )
    sampling: TwinSampling
    verdict: Word | Literal["NO REQUIREMENT"]
    sentence: str
    exit_code: Literal[0, 1, 3]
    verdicts: list[TwinVerdict]
    outcomes: dict[str, int]
    metric: str | None
    statistics: dict[str, TwinStatistics]
    worst_cases: list[str]
    sections: dict[str, Any] = Field(description="of each further section of the page, by its anchor")
    showcases: list[int] = Field(description="cases whose products are kept")
