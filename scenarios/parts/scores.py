"""Scores by functions of a user's own: `scores` of a campaign.

A function ``score(case) -> Mapping[str, float | bool]``, handed one case, gives numbers (NaN where there is none) or
truth values, the same names in every case. They become columns of the row, behind the function's name: `energy` that
gives `lateral_j` fills `energy_lateral_j`. Requirements take them as metrics, or truth values as populations. Each
algorithm's answer is scored; where an algorithm crashed there is no answer, and nothing is scored.

The annotation of its argument says which cases it takes, one kind or a union of several; without one it must take them
all. A kind is taken with those that hold more: who takes `ScoredVelocity` takes `ScoredFlight` and `ScoredDescent`.
"""

from __future__ import annotations

import inspect
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import SiteEstimate, TargetUpdate, VelocityEstimate
from marsyard.scenarios.estimators import labels
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.named import SCORE, checked_columns
from marsyard.sim.dynamics import State, Trajectory
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements, RoverMeasurements
from marsyard.sim.parameters import Parameters

if TYPE_CHECKING:
    from marsyard.scenarios.landing.truth import GroundTruth


@dataclass(frozen=True, kw_only=True)
class ScoredVelocity:
    """An answer to three pictures of a descent or more, wherever they are from: rendered, or really taken.

    Attributes
    ----------
    measurements
        What the estimator was handed.
    answer
        What it said; `answer.velocity_m_s` is None where it ended with a failure.
    true_velocity_m_s
        True horizontal velocity of what the answer is of, east and north: its span, by default the last interval; None
        where it is not known.
    """

    measurements: DescentMeasurements
    answer: VelocityEstimate
    true_velocity_m_s: Float[np.ndarray, "2"] | None


@dataclass(frozen=True, kw_only=True)
class ScoredFlight(ScoredVelocity):
    """The same of pictures whose true motion is known: of a simulated descent, or of the field test's helicopter.

    Attributes
    ----------
    states
        True states at the pictures, in their order.
    motion
        The true motion, all of it.
    """

    states: tuple[State, ...]
    motion: Trajectory


@dataclass(frozen=True, kw_only=True)
class ScoredDescent(ScoredFlight):
    """A simulated descent, down to the ground.

    Attributes
    ----------
    at_firing
        True state at the thrusters' firing.
    touchdown_m_s
        True horizontal velocity at the ground, east and north, the answer used.
    """

    at_firing: State
    touchdown_m_s: Float[np.ndarray, "2"]


@dataclass(frozen=True, kw_only=True)
class ScoredSite:
    """An answer to two pictures of the ground, rendered or really taken.

    Attributes
    ----------
    measurements
        What the estimator was handed.
    answer
        What it said; `answer.site_world` is None where it found no site.
    true_poses
        Of the body at the two pictures, in the world; None where they are not known.
    """

    measurements: LandingMeasurements
    answer: SiteEstimate
    true_poses: tuple[RigidTransform, RigidTransform] | None


@dataclass(frozen=True, kw_only=True)
class ScoredLanding(ScoredSite):
    """A simulated flight for a landing site.

    Attributes
    ----------
    states
        True states at the two pictures.
    ground
        The true ground: where a lander would stand safely (`marsyard.scenarios.landing.truth.GroundTruth`).
    """

    states: tuple[State, State]
    ground: GroundTruth


@dataclass(frozen=True)
class ScoredRun:
    """A rover's run with a tracker's answers, stop by stop.

    Attributes
    ----------
    outcome
        How the run ended: a name of `marsyard.scenarios.rover.stops.RunOutcome`.
    target_world
        The designated point, metres.
    world_from_rover
        True pose of the rover at each stop.
    point_px
        Where the left camera truly showed the designated point at each stop, full-frame (u, v); NaN where it did not.
    measurements, answers
        What the tracker was handed at each stop, and what it said.
    """

    outcome: str
    target_world: Float[np.ndarray, "3"]
    world_from_rover: tuple[RigidTransform, ...]
    point_px: Float[np.ndarray, "stops 2"]
    measurements: tuple[RoverMeasurements, ...]
    answers: tuple[TargetUpdate, ...]


ScoredCase = ScoredVelocity | ScoredSite | ScoredRun
SCORED: tuple[type[Any], ...] = (
    ScoredVelocity,
    ScoredFlight,
    ScoredDescent,
    ScoredSite,
    ScoredLanding,
    ScoredRun,
)


def taken_by(found: Any) -> tuple[type[Any], ...]:
    """The cases that a score takes, by its annotation, and with each what holds more; all where it has none."""
    if inspect.isroutine(found):
        annotations = inspect.get_annotations(found)
    else:
        annotations = inspect.get_annotations(type(found).__call__)
    stated = [str(kind) for name, kind in annotations.items() if name != "return"]
    named = tuple(one for one in SCORED if any(one.__name__ in kind for kind in stated))
    return tuple(one for one in SCORED if issubclass(one, named)) if stated else SCORED


def score_of(spec: str, kind: type[Any] | None = None) -> Any:
    """A score by its name.

    Raises
    ------
    ValueError
        Where there is none, it is no function, or takes no cases of a kind.
    """
    found = SCORE.found(spec)
    if isinstance(found, type) or not callable(found):
        what = "a class" if isinstance(found, type) else f"a {type(found).__name__}"
        raise ValueError(f"'{spec}' is no score: it is {what}, not a function")
    try:
        inspect.signature(found).bind(None)
    except (TypeError, ValueError) as error:
        raise ValueError(f"'{spec}' is no score: it does not take one argument, the case ({error})") from error
    taken = taken_by(found)
    if kind is not None and kind not in taken:
        names = ", ".join(one.__name__ for one in taken) or "no case"
        raise ValueError(f"'{spec}' scores {names}; allowed here: {kind.__name__}")
    return found


class OwnScores(Parameters):
    """What the parameters of scenarios hold whose cases a user's own scores can be asked about."""

    scored: ClassVar[type[Any]]

    scores: Annotated[
        tuple[str, ...],
        Field(description="own scores: module:function, or names of entry points; each fills columns of the row"),
    ] = ()

    @field_validator("scores")
    @classmethod
    def _scores_are_there(cls, specs: tuple[str, ...]) -> tuple[str, ...]:
        for place, spec in enumerate(specs):
            score_of(spec, cls.scored)
            if spec in specs[:place]:
                raise ValueError(f"the score '{spec}' is named twice")
        return specs


def scored(specs: Sequence[str], case: ScoredCase, taken: Collection[str]) -> dict[str, Scalar]:
    """What scores say of a case, as columns.

    Raises
    ------
    ValueError
        Where a score gives what cannot be a column, or one of those that are `taken`.
    """
    row: dict[str, Scalar] = {}
    for spec, label in zip(specs, labels(specs), strict=True):
        for name, value in checked_columns(spec, score_of(spec)(case), texts=False).items():
            column = f"{label}_{name}"
            if column in row or column in taken:
                raise ValueError(f"'{spec}' gives the column {column}, which the row has already")
            row[column] = value
    return row
