"""User-defined scores: `scores` of a campaign.

A score is a function ``score(case) -> Mapping[str, float | bool]``, with the same names in every case; NaN means no
number. Its values become columns prefixed with the function's name: `lateral_j` of `energy` becomes `energy_lateral_j`.
Requirements use them as metrics, or booleans as populations. The answer of each algorithm is scored, except after a
crash of the algorithm.

The annotation of the argument defines the accepted kinds of cases, one or a union of several; without annotation, the
score must accept all kinds. A kind includes its subclasses: `ScoredVelocity` includes `ScoredFlight`.
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
from marsyard.scenarios.estimators import labels
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.named import SCORE, check_columns
from marsyard.sim.dynamics import State, Trajectory
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements, RoverMeasurements
from marsyard.sim.parameters import Parameters

if TYPE_CHECKING:
    from marsyard.scenarios.landing.pictures import GroundTruth


@dataclass(frozen=True, kw_only=True)
class ScoredVelocity:
    """An estimator's answer to pictures of a descent, simulated or real.

    - measurements: the estimator's input
    - answer: its output; `answer.velocity_m_s` is None after a failure
    - true_velocity_m_s: true mean horizontal velocity (east, north) over the answer's span, by default the last
      interval; None if unknown
    """

    measurements: DescentMeasurements
    answer: VelocityEstimate
    true_velocity_m_s: Float[np.ndarray, "2"] | None


@dataclass(frozen=True, kw_only=True)
class ScoredFlight(ScoredVelocity):
    """`ScoredVelocity` with known true motion and states at the pictures: simulated descent, or field test flight."""

    states: tuple[State, ...]
    motion: Trajectory


@dataclass(frozen=True, kw_only=True)
class ScoredDescent(ScoredFlight):
    """A simulated descent down to the ground.

    - at_firing: true state at the firing of the thrusters
    - touchdown_m_s: true horizontal touchdown velocity, east and north, if the answer is used
    """

    at_firing: State
    touchdown_m_s: Float[np.ndarray, "2"]


@dataclass(frozen=True, kw_only=True)
class ScoredSite:
    """An estimator's answer to two pictures of the ground, simulated or real.

    - measurements: the estimator's input
    - answer: its output; `answer.site_world` is None without a site
    - true_poses: true poses of the body at the two pictures, in the world; None if unknown
    """

    measurements: LandingMeasurements
    answer: SiteEstimate
    true_poses: tuple[RigidTransform, RigidTransform] | None


@dataclass(frozen=True, kw_only=True)
class ScoredLanding(ScoredSite):
    """A simulated flight for a landing site: true states at the two pictures, and the true safety of the ground."""

    states: tuple[State, State]
    ground: GroundTruth


@dataclass(frozen=True)
class ScoredRun:
    """A rover's run with a tracker's answers, stop by stop.

    - outcome: end of the run, a name of `marsyard.scenarios.rover.stops.RunOutcome`
    - target_world: the designated point, metres
    - world_from_rover: true pose of the rover at each stop
    - point_px: true image of the designated point in the left camera at each stop, full-frame (u, v); NaN if hidden
    - measurements, answers: the tracker's input and output at each stop
    """

    outcome: str
    target_world: Float[np.ndarray, "3"]
    world_from_rover: tuple[RigidTransform, ...]
    point_px: Float[np.ndarray, "stops 2"]
    measurements: tuple[RoverMeasurements, ...]
    answers: tuple[TargetUpdate, ...]


ScoredCase = ScoredVelocity | ScoredSite | ScoredRun
SCORED: tuple[type[Any], ...] = (ScoredVelocity, ScoredFlight, ScoredDescent, ScoredSite, ScoredLanding, ScoredRun)


def accepted_cases(score: Any) -> tuple[type[Any], ...]:
    """Return the kinds of cases that a score's annotation accepts, with subclasses; all kinds without an annotation."""
    annotations = inspect.get_annotations(score if inspect.isroutine(score) else type(score).__call__)
    annotated = [str(kind) for name, kind in annotations.items() if name != "return"]
    classes = tuple(item for item in SCORED if any(item.__name__ in kind for kind in annotated))
    return tuple(item for item in SCORED if issubclass(item, classes)) if annotated else SCORED


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
    accepted = accepted_cases(score)
    if kind is not None and kind not in accepted:
        names = ", ".join(item.__name__ for item in accepted) or "no case"
        raise ValueError(f"'{spec}' accepts {names}; allowed here: {kind.__name__}")
    return score


class CustomScores(Parameters):
    """Parameters of a scenario with user-defined scores; `scored` is its kind of case."""

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


def compute_scores(specs: Sequence[str], case: ScoredCase, existing: Collection[str]) -> dict[str, Scalar]:
    """Return the columns of all scores of a case. Raises ValueError for an invalid or an existing column."""
    row: dict[str, Scalar] = {}
    for spec, label in zip(specs, labels(specs), strict=True):
        for name, value in check_columns(spec, load_score(spec)(case), texts=False).items():
            column = f"{label}_{name}"
            if column in row or column in existing:
                raise ValueError(f"'{spec}' returns the column {column}, which the row already contains")
            row[column] = value
    return row
