"""User-defined scores: functions that compute result columns of a case, listed in the key `scores` of a campaign.

A score is a function ``score(case) -> Mapping[str, float | bool]``. It returns the same names in every case; NaN is a
missing number. Its values become result columns with the name of the function as prefix: `lateral_j` of the function
`energy` becomes `energy_lateral_j`. Requirements use numeric columns as metrics and boolean columns as populations. The
answer of each algorithm is scored, except after a crash of the algorithm.

The annotation of the argument defines the accepted kinds of cases: one class or a union of classes, with their
subclasses (`ScoredVelocity` includes `ScoredFlight`). A score without annotation must accept all kinds.
"""

from __future__ import annotations

import inspect
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import SiteEstimate, TargetUpdate, VelocityEstimate
from marsyard.scenarios.algorithm_labels import labels
from marsyard.scenarios.input_copies import hash_inputs
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.named import SCORE, check_columns
from marsyard.sim.dynamics import State, Trajectory
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements, RoverMeasurements
from marsyard.sim.parameters import Parameters

if TYPE_CHECKING:
    from marsyard.scenarios.landing.ground_truth import GroundTruth


@dataclass(frozen=True, kw_only=True)
class ScoredVelocity:
    """A velocity estimator's answer to images of a descent, simulated or real.

    - measurements: input of the estimator
    - answer: output of the estimator; `answer.velocity_m_s` is None after a refusal
    - true_velocity_m_s: true mean horizontal velocity (east, north) over the answer's span, by default the interval of
      the last two images; None if unknown
    """

    measurements: DescentMeasurements
    answer: VelocityEstimate
    true_velocity_m_s: Float[np.ndarray, "2"] | None


@dataclass(frozen=True, kw_only=True)
class ScoredFlight(ScoredVelocity):
    """A velocity estimator's answer in a simulated descent, or in a flight of the field test.

    - states: true states at the images
    - motion: true motion; `motion.state(time_s)` returns the state at a time within `motion.span_s`
    """

    states: tuple[State, ...]
    motion: Trajectory


@dataclass(frozen=True, kw_only=True)
class ScoredDescent(ScoredFlight):
    """A velocity estimator's answer in a simulated descent, with the touchdown.

    - at_firing: true state at the firing of the thrusters
    - touchdown_m_s: true horizontal touchdown velocity (east, north) of a landing steered with the answer
    """

    at_firing: State
    touchdown_m_s: Float[np.ndarray, "2"]


@dataclass(frozen=True, kw_only=True)
class ScoredSite:
    """A landing site estimator's answer to two images of the ground, simulated or real.

    - measurements: input of the estimator
    - answer: output of the estimator; `answer.site_world` is None without a site
    - true_poses: true poses of the body, in world axes, at the two images; None if unknown
    """

    measurements: LandingMeasurements
    answer: SiteEstimate
    true_poses: tuple[RigidTransform, RigidTransform] | None


@dataclass(frozen=True, kw_only=True)
class ScoredLanding(ScoredSite):
    """A landing site estimator's answer in a simulated flight.

    - states: true states at the two images
    - ground: true slope, roughness and safety of the ground
    """

    states: tuple[State, State]
    ground: GroundTruth


@dataclass(frozen=True)
class ScoredRun:
    """A tracker's answers at the stops of a rover's run.

    - outcome: outcome of the run, a name of `marsyard.scenarios.rover.run_state.RunOutcome`
    - target_world: the designated point, world axes, metres
    - world_from_rover: true pose of the rover at each stop
    - point_px: true full-frame pixel (u, v) of the designated point in the left camera at each stop; NaN if the camera
      cannot see the point
    - measurements, answers: input and output of the tracker at each stop
    """

    outcome: str
    target_world: Float[np.ndarray, "3"]
    world_from_rover: tuple[RigidTransform, ...]
    point_px: Float[np.ndarray, "stops 2"]
    measurements: tuple[RoverMeasurements, ...]
    answers: tuple[TargetUpdate, ...]


ScoredCase = ScoredVelocity | ScoredSite | ScoredRun
SCORED: tuple[type[Any], ...] = (ScoredVelocity, ScoredFlight, ScoredDescent, ScoredSite, ScoredLanding, ScoredRun)


def annotated_cases(score: Any) -> tuple[type[Any], ...] | None:
    """Return the kinds of cases that a score's annotation accepts, with subclasses; None without an annotation."""
    annotations = inspect.get_annotations(score if inspect.isroutine(score) else type(score).__call__)
    annotation_names = [str(kind) for name, kind in annotations.items() if name != "return"]
    if not annotation_names:
        return None
    classes = tuple(item for item in SCORED if any(item.__name__ in kind for kind in annotation_names))
    return tuple(item for item in SCORED if issubclass(item, classes))


def accepted_cases(score: Any) -> tuple[type[Any], ...]:
    """Return the kinds of cases that a score accepts: those of its annotation, all kinds without an annotation."""
    kinds = annotated_cases(score)
    return SCORED if kinds is None else kinds


def load_score(spec: str, kind: type[Any] | None = None) -> Any:
    """Import a score. Raises ValueError if it does not exist, is not a function, or does not accept a kind of case."""
    score = SCORE.load(spec)
    if isinstance(score, type) or not callable(score):
        kind_name = "class" if isinstance(score, type) else type(score).__name__
        raise ValueError(f"'{spec}' is not a valid score: it is a {kind_name}, not a function")
    try:
        inspect.signature(score).bind(None)
    except (TypeError, ValueError) as error:
        raise ValueError(f"'{spec}' is not a valid score: it must accept one argument, the case ({error})") from error
    case_types = accepted_cases(score)
    if kind is not None and kind not in case_types:
        names = ", ".join(item.__name__ for item in case_types) or "no case"
        raise ValueError(f"'{spec}' accepts {names}; allowed here: {kind.__name__}")
    return score


class CustomScores(Parameters):
    """Parameters of a scenario with user-defined scores; `scored` is the class of its cases as input of scores."""

    scored: ClassVar[type[Any]]

    scores: tuple[str, ...] = Field(default=(), description="custom scores: module:function, or names of entry points")

    @field_validator("scores")
    @classmethod
    def _check_scores(cls, specs: tuple[str, ...]) -> tuple[str, ...]:
        for index, spec in enumerate(specs):
            load_score(spec, cls.scored)
            if spec in specs[:index]:
                raise ValueError(f"the score '{spec}' is listed twice")
        return specs


def compute_scores(specs: Sequence[str], case: ScoredCase, existing_columns: Collection[str]) -> dict[str, Scalar]:
    """Return the columns of all scores of a case.

    Raises ValueError for an invalid or an existing column, and if a score changed the case: the truth and the images
    are those of the later scores, figures and algorithms.
    """
    row: dict[str, Scalar] = {}
    case_hash = hash_inputs(case) if specs else ""
    for spec, label in zip(specs, labels(specs), strict=True):
        columns = check_columns(spec, load_score(spec)(case), texts=False)
        if hash_inputs(case) != case_hash:
            raise ValueError(f"'{spec}' changed its case; allowed: reading it, and changing copies")
        for name, value in columns.items():
            column = f"{label}_{name}"
            if column in row or column in existing_columns:
                raise ValueError(f"'{spec}' returns the column {column}, which the row already contains")
            row[column] = value
    return row
