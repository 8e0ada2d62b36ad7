"""Forms of velocities and landing sites in JSON: their outcomes and numbers, for programs and tables of answers."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, TypeVar

import numpy as np

from marsyard.algorithms.answers import check_site, check_velocity
from marsyard.algorithms.exchange.files import EXCHANGE_VERSION
from marsyard.algorithms.exchange.process import shorten
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import LandingMeasurements

#: Numbers of at least this magnitude count as infinite; JSON's integers have no limit.
_MAX_NUMBER = 1e300
Member = TypeVar("Member", bound=Enum)
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class ProgramDetails:
    """Standard error and wall-clock time of a program's answer."""

    stderr: str
    time_s: float


def answer_time_s(answer: object, processor_s: float) -> float:
    """Return the computation time: the processor time, or the wall-clock time of an external program's answer."""
    details = getattr(answer, "details", None)
    return details.time_s if isinstance(details, ProgramDetails) else processor_s


@dataclass(frozen=True, eq=False)
class AnswerForm(Generic[Answer]):
    """Form of a task's answers.

    - outcomes: allowed outcomes; the first has numbers
    - shapes: shape of the numbers of each key; () for a single number
    - create: creates and checks an answer from the keywords `outcome`, `details` and the keys of `shapes`, whose values
      are arrays, or None without numbers. Raises AlgorithmError.
    - get_numbers: returns the numbers of an answer by key
    - complete: adds inputs of the case that the numbers do not contain, such as the a-priori site, to an answer
    """

    outcomes: type[Enum]
    shapes: Mapping[str, tuple[int, ...]]
    create: Callable[..., Answer]
    get_numbers: Callable[[Answer, str], Any] = getattr
    complete: Callable[[Answer, Any], Answer] = lambda answer, _: answer

    def read(self, answer: Mapping[str, Any], details: ProgramDetails | None = None, *inputs: Any) -> Answer:
        """Decode an answer, and complete it with the inputs. Raises AlgorithmError (BAD_ANSWER)."""
        check_keys(answer, {"outcome", *self.shapes})
        outcome = read_member("outcome", answer.get("outcome"), self.outcomes)
        numbers = {key: read_numbers(answer, key, shape) for key, shape in self.shapes.items()}
        created = self.create(outcome=outcome, details=details, **numbers)
        return self.complete(created, *inputs) if inputs else created

    def encode(self, answer: Any) -> dict[str, Any]:
        """Encode an answer for JSON, without its details; None becomes the outcome null."""
        if answer is None:
            return {"outcome": None}
        numbers = {key: self.get_numbers(answer, key) for key in self.shapes}
        arrays = {key: np.asarray(value, float).tolist() for key, value in numbers.items() if value is not None}
        return {"outcome": answer.outcome.name, **arrays}


def check_keys(answer: Mapping[str, Any], allowed: set[str]) -> None:
    """Raise AlgorithmError (BAD_ANSWER) for another version of the exchange or an unknown key."""
    if type(answer.get("exchange")) is not int or answer["exchange"] != EXCHANGE_VERSION:
        raise bad_answer(f"the answer's exchange is {answer.get('exchange')!r}; allowed: {EXCHANGE_VERSION}")
    keys = allowed | {"exchange"}
    if unknown := sorted(set(answer) - keys):
        raise bad_answer(f"the answer has an unknown key '{unknown[0]}'; allowed: {', '.join(sorted(keys))}")


def read_member(label: str, name: object, enumeration: type[Member]) -> Member:
    """Look up a member of the `enumeration` by name; raises AlgorithmError (BAD_ANSWER). `label` is the key."""
    if not isinstance(name, str) or name not in enumeration.__members__:
        raise bad_answer(f"{label} is {name!r}; allowed: {', '.join(enumeration.__members__)}")
    return enumeration[name]


def read_numbers(answer: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Read an array from the answer; None if it is null or absent. Raises AlgorithmError (BAD_ANSWER)."""
    value = answer.get(name)
    if value is None:
        return None
    if not _has_shape(value, shape):
        value_text = shorten(json.dumps(value).encode())
        raise bad_answer(f"{name} is {value_text}; allowed: numbers in the shape {list(shape)}")
    return np.array(value, dtype=np.float64)


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value is a finite number (empty shape) or a nested list of finite numbers of this shape."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _MAX_NUMBER
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(item, shape[1:]) for item in value)


def _create_velocity(span_s: np.ndarray | None, **values: Any) -> VelocityEstimate:
    """Create a velocity estimate."""
    return check_velocity(VelocityEstimate(span_s=None if span_s is None else tuple(span_s.tolist()), **values))


def _create_site(**values: Any) -> SiteEstimate:
    """Create a site estimate; without convergence, the site can be missing."""
    estimate = SiteEstimate(**values)
    return check_site(estimate) if estimate.outcome.converged or estimate.site_world is not None else estimate


def _add_apriori_site(estimate: SiteEstimate, measurements: LandingMeasurements) -> SiteEstimate:
    """Return the estimate with the a-priori site if the algorithm did not converge."""
    if estimate.outcome.converged or estimate.site_world is not None:
        return estimate
    return SiteEstimate(estimate.outcome, measurements.apriori_site_world, estimate.details)


VELOCITY_FORM = AnswerForm(
    VelocityOutcome, {"velocity_m_s": (2,), "covariance_m2_s2": (2, 2), "span_s": (2,)}, _create_velocity
)
SITE_FORM = AnswerForm(SiteOutcome, {"site_world": (3,)}, _create_site, complete=_add_apriori_site)
