"""Parameters and results of the four kinds of studies, which the record of a study contains (`study_record`)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.json_numbers import Number
from marsyard.campaigns.studies.contributions import MIN_COMMON, Budget
from marsyard.campaigns.studies.rare_decision import Decision, RareVerdict
from marsyard.campaigns.studies.study_record import StudyKind

#: Subset simulation alone, or with importance sampling around the violations that it found.
METHODS = ("subset", "importance")


@dataclass(frozen=True)
class RareParameters:
    """Parameters of the study `rare`.

    - requirement: id of the requirement; max_probability: limit of the probability that a case violates it
    - method: see `METHODS`
    - samples: cases per level of one subset simulation
    - replicates, random_cases: numbers of replicates, and of random cases, of the first run and of each continuation.
      Random cases are drawn independently for the counting bound, as is the first level of each replicate
    - importance_cases: cases of importance sampling
    - confidence: two-sided confidence; each bound alone holds at (1 + confidence) / 2
    """

    requirement: str
    max_probability: float
    method: str = "subset"
    samples: int = 200
    replicates: tuple[int, ...] = (6,)
    random_cases: tuple[int, ...] = (600,)
    importance_cases: int = 600
    confidence: float = 0.9

    def __post_init__(self) -> None:
        _check(
            {
                f"--max-probability {self.max_probability}: allowed: above 0 and below 1": 0.0
                < self.max_probability
                < 1.0,
                f"--method {self.method}: allowed: {', '.join(METHODS)}": self.method in METHODS,
                f"--samples {self.samples}: at least 50": self.samples >= 50,
                f"--replicates {self.replicates[0]}: at least 2": self.replicates[0] >= 2,
                f"--random-cases {self.random_cases[0]}: at least 0": self.random_cases[0] >= 0,
                f"--importance-cases {self.importance_cases}: at least 50": self.importance_cases >= 50,
                f"--confidence {self.confidence}: allowed: 0.5 to 0.999": 0.5 <= self.confidence <= 0.999,
            }
        )


@dataclass(frozen=True)
class Replicate:
    """One subset simulation.

    - probability, reached: estimated probability of a violation, and whether it is an estimate
    - end: reason why it ended
    - thresholds, level_probabilities: margin and estimated probability of each intermediate level
    """

    probability: float
    reached: bool
    end: str
    thresholds: tuple[Number, ...]
    level_probabilities: tuple[float, ...]


@dataclass(frozen=True)
class RareResult:
    """Result of the study `rare`.

    - verdict, decision: verdict, and its evidence
    - cases, violations: numbers of evaluated cases, and of those that violate the requirement
    - replicates: subset simulations
    - margin_text: definition of the margin
    """

    verdict: RareVerdict
    decision: Decision
    cases: int
    violations: int
    replicates: tuple[Replicate, ...]
    margin_text: str

    @property
    def exit_code(self) -> int:
        """Exit status of the verdict."""
        return {RareVerdict.PASS: 0, RareVerdict.FAIL: 1, RareVerdict.INSUFFICIENT: 3}[self.verdict]


RARE = StudyKind("rare", "a study of rare violations (marsyard rare)", RareParameters, RareResult)


@dataclass(frozen=True)
class SearchParameters:
    """Parameters of the study `search`.

    - requirement: id of the requirement
    - cases: number of cases of exploration and evolution strategies
    - restarts: number of evolution strategies
    - max_failures: maximum number of reduced violations
    - repetitions: number of new random streams with which each reduced violation runs again
    """

    requirement: str
    cases: int = 300
    restarts: int = 3
    max_failures: int = 5
    repetitions: int = 4

    def __post_init__(self) -> None:
        _check(
            {
                f"--cases {self.cases}: at least 20": self.cases >= 20,
                f"--restarts {self.restarts}: at least 1": self.restarts >= 1,
                f"--failures {self.max_failures}: at least 1": self.max_failures >= 1,
            }
        )


@dataclass(frozen=True)
class FoundFailure:
    """A reduced violation.

    - case: number of the reduced case; original_case: number of the case before the reduction
    - margin: margin of the reduced case
    - values: values of the dispersions that replace the campaign's parameters in the case, by path
    - distance: distance of these values from the medians, standard deviations; small distances are more likely
    - similar: number of violations with the same cause
    - repeated, repetitions: number of violations among the repetitions with new random streams and numbers `in-turn`
    - outcome: outcome of the reduced case
    """

    case: int
    original_case: int
    margin: Number
    values: dict[str, Any]
    distance: float
    similar: int
    repeated: int
    repetitions: int
    outcome: str


@dataclass(frozen=True)
class SearchResult:
    """Result of the study `search`: reduced violations, the most likely one first, and numbers of cases.

    - search_cases, cases: numbers of cases before the reduction, and in all
    - violations: number of violations among the cases before the reduction; min_margin: their smallest margin
    - first_violation: number of cases up to the first violation; None without a violation
    """

    failures: tuple[FoundFailure, ...]
    search_cases: int
    cases: int
    violations: int
    min_margin: Number
    first_violation: int | None
    margin_text: str
    reason: str = ""

    @property
    def exit_code(self) -> int:
        """Exit status of the command: 1 if violations were found."""
        return int(bool(self.violations))


SEARCH = StudyKind("search", "a search for violations (marsyard search)", SearchParameters, SearchResult)


@dataclass(frozen=True)
class BudgetParameters:
    """Parameters of the study `budget`.

    - requirement: id of the requirement whose metric is the error; without a bound, its margin is used
    - cases: number of base cases; each runs once per variant
    - sobol: base samples of Saltelli's design, a power of 2; 0: no indices
    - confidence: two-sided confidence of the intervals
    """

    requirement: str
    cases: int = 100
    sobol: int = 0
    confidence: float = 0.9

    def __post_init__(self) -> None:
        is_power = self.sobol == 0 or (self.sobol >= 16 and self.sobol & (self.sobol - 1) == 0)
        _check(
            {
                f"--cases {self.cases}: at least {2 * MIN_COMMON}": self.cases >= 2 * MIN_COMMON,
                f"--sobol {self.sobol}: allowed: 0, or a power of 2 from 16": is_power,
                f"--confidence {self.confidence}: allowed: 0.5 to 0.999": 0.5 <= self.confidence <= 0.999,
            }
        )


@dataclass(frozen=True)
class SobolIndex:
    """First-order and total Sobol index of a dispersion or the random streams, with half-widths of their intervals."""

    name: str
    first: Number
    first_width: Number
    total: Number
    total_width: Number


@dataclass(frozen=True)
class BudgetResult:
    """Result of the study `budget`.

    - quantity: metric or margin that is the error; centred: whether its mean square is taken about the mean
    - inactive: titles of the sources that act in no case of the campaign
    - budget: error budget; None for a campaign without sources, or with too few common cases
    - cases, violations: number of base cases, and of violations of the requirement among them with all sources
    - indices: Sobol indices, the largest total index first; index_samples: complete base samples
    - evaluated: number of cases in all
    - reason: why the result is incomplete; empty if it is complete
    """

    quantity: str
    centred: bool
    inactive: tuple[str, ...]
    budget: Budget | None
    cases: int
    violations: int
    indices: tuple[SobolIndex, ...]
    index_samples: int
    evaluated: int
    reason: str = ""

    @property
    def exit_code(self) -> int:
        """Exit status of the command."""
        return 0 if not self.reason else 3


BUDGET = StudyKind("budget", "an error budget (marsyard budget)", BudgetParameters, BudgetResult)


@dataclass(frozen=True)
class RobustVariant:
    """A variant of the cases of a run: values of parameters that replace those of the campaign, by path.

    - parameter: path of the parameter that is changed in steps; empty for a named variant
    - factors: factors of the sampled values of dispersed parameters, by path
    """

    name: str
    title: str
    values: dict[str, Any]
    parameter: str = ""
    factors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RobustParameters:
    """Parameters of the study `robust`.

    - variants: named variants, and steps of parameters in increasing distance from the assumed value
    - cases, weights: cases of the run that each variant repeats, and the number of its cases that each represents
    """

    variants: tuple[RobustVariant, ...]
    cases: tuple[int, ...]
    weights: tuple[float, ...]


@dataclass(frozen=True)
class RobustResult:
    """Result of the study `robust`: number of cases that were run."""

    cases: int

    @property
    def exit_code(self) -> int:
        """Exit status of the command."""
        return 0


#: Folder of the studies `robust` of a run, in the folder of the run.
ROBUST_FOLDER = "robust"
ROBUST = StudyKind("robust", "cases of other parameters (marsyard robust)", RobustParameters, RobustResult)


def _check(conditions: Mapping[str, bool]) -> None:
    """Raise CampaignError for the first condition that is not met; the keys are the messages."""
    for message, is_met in conditions.items():
        if not is_met:
            raise CampaignError(message)
