"""The checks of a user's own parts: motions, instruments, scores (`marsyard.scenarios.parts`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.algorithms.interface import (
    SiteEstimate,
    SiteOutcome,
    TargetUpdate,
    TrackingState,
    VelocityEstimate,
    VelocityOutcome,
)
from marsyard.scenarios.conformance import inputs, trackers
from marsyard.scenarios.conformance.checks import (
    BreachError,
    Check,
    Suite,
    answer_print,
    seed_global_generators,
    timed,
)
from marsyard.scenarios.handover import fingerprint, handed_copy
from marsyard.scenarios.landing.relief import Footprints, Limits, Relief
from marsyard.scenarios.landing.truth import GroundTruth
from marsyard.scenarios.parts.instruments import InstrumentTruth, checked_readings
from marsyard.scenarios.parts.motions import DescentPlace, Poses, checked_poses
from marsyard.scenarios.parts.named import DYNAMICS, INSTRUMENT, KINDS, SCORE, Kind, checked_columns, installed
from marsyard.scenarios.parts.scores import (
    SCORED,
    ScoredCase,
    ScoredDescent,
    ScoredFlight,
    ScoredLanding,
    ScoredRun,
    ScoredSite,
    ScoredVelocity,
    score_of,
    taken_by,
)
from marsyard.sim.dynamics.recorded import RecordedMotion
from marsyard.sim.frames import rigid

_GRAVITY_M_S2 = 3.72
#: How steep the suite's ground is, and its normal.
_SLOPE = 0.05
_NORMAL = np.array([-_SLOPE, 0.0, 1.0]) / np.hypot(_SLOPE, 1.0)


def kind_of(spec: str) -> str | None:
    """The kind of part that a name is of, as far as it tells; None where it is none."""
    named = next((kind.name for kind in KINDS.values() if spec in installed(kind.group)), None)
    if named is not None or ":" not in spec:
        return named
    try:
        found = DYNAMICS.found(spec)
    except ValueError:
        return None
    for kind in (DYNAMICS, INSTRUMENT):
        if isinstance(found, type) and hasattr(found, kind.members[0]):
            return kind.name
    annotated = taken_by(found) if callable(found) and not isinstance(found, type) else SCORED
    return SCORE.name if annotated and annotated != SCORED else None


def check_part(kind: Kind, spec: str) -> None:
    """Raises ValueError where there is no part of this name and kind; the message says what is allowed."""
    if kind is SCORE:
        score_of(spec)
    else:
        kind.made(spec, {})


@dataclass(frozen=True)
class PartSuite(Suite):
    """The suite of one part of a kind, made with the options that its class has."""

    kind: Kind

    deterministic_advice = "draw from the generator that is handed over alone; keep nothing from case to case"
    answers = "answers a case"
    closed_to_truth = False

    @classmethod
    def of(cls, kind: Kind, spec: str, limit_s: float) -> PartSuite:
        """The suite of a name."""
        return cls(lambda: score_of(spec) if kind is SCORE else kind.made(spec, {}), spec, False, limit_s, kind)

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        form = "see docs/own-parts.md for what it is handed and what it gives"
        asked = "gives what its kind gives, of the right shapes, finite and in order"
        yield Check("answer", asked, form, self._answers)
        asked = "names the same columns in every case: identifiers, with numbers or truth values"
        yield Check("columns", asked, "give every column in every case; NaN where there is no number", self._columns)
        yield from self.common_checks()
        if self.kind is not SCORE:
            asked = "depends on its random stream where it states so, and else does not"
            advice = "set random to whether it draws, and draw from the generator that is handed over"
            yield Check("random", asked, advice, self._random)

    def _answers(self) -> str:
        return ", ".join(_told(self._asked(case)) for case in self.cases())

    def _columns(self) -> str:
        names = [tuple(_columns(self._asked(case, seed))) for case in self.cases() for seed in (1, 2)]
        if len(set(names)) > 1:
            raise BreachError(
                f"its columns change: {' / '.join(', '.join(one) or 'none' for one in dict.fromkeys(names))}"
            )
        return ", ".join(names[0]) or "none"

    def _change_inputs(self) -> str:
        for case in self.cases():
            mine = handed_copy(case, writable=True)
            before = fingerprint(mine)
            self._given(self.make(), mine, 1)
            if fingerprint(mine) != before:
                raise BreachError(f"the {type(case).__name__} that it was handed is not what it was before")
        return ""

    def _answer_again(self) -> str:
        kept = self.make()
        for case in self.cases():
            seed_global_generators(1)
            first = answer_print(self._asked(case))
            seed_global_generators(2)
            if answer_print(self._asked(case)) != first:
                raise BreachError("asked twice, it gives something else for the same case and stream")
            for other in self.cases():
                self._given(kept, handed_copy(other, writable=True), 2)
            if answer_print(self._checked(self._given(kept, handed_copy(case, writable=True), 1), case)) != first:
                raise BreachError("what it gives depends on the cases that it was asked before")
        return ""

    def _random(self) -> str:
        claimed = bool(self.make().random)
        case = self.cases()[0]
        differs = answer_print(self._asked(case, 1)) != answer_print(self._asked(case, 2))
        if claimed and not differs:
            raise BreachError("its random is true, but two streams give the same")
        if differs and not claimed:
            raise BreachError("its random is false, but two streams give something else")
        return "random" if claimed else "not random"

    def _taken_s(self) -> float:
        case = self.cases()[0]
        self._asked(case)
        return timed(lambda: self._asked(case))

    def cases(self) -> Sequence[Any]:
        """What the part is asked about."""
        if self.kind is DYNAMICS:
            return places()
        if self.kind is INSTRUMENT:
            return truths()
        return [case for case in scored_cases() if isinstance(case, taken_by(score_of(self.spec)))]

    def _given(self, part: Any, case: Any, seed: int) -> Any:
        """What a part gives, as it gives it."""
        rng = np.random.default_rng(seed)
        if self.kind is DYNAMICS:
            return part.fly(case, rng)
        return part.read(case, rng) if self.kind is INSTRUMENT else part(case)

    def _asked(self, case: Any, seed: int = 1) -> Any:
        return self._checked(self._given(self.make(), handed_copy(case, writable=True), seed), case)

    def _checked(self, given: object, case: Any) -> Any:
        """What a part gave, held against what its kind gives."""
        try:
            if self.kind is DYNAMICS:
                poses = checked_poses(self.spec, given, case)
                RecordedMotion(
                    poses.times_s, poses.positions_m, Rotation.from_quat(poses.quaternions_xyzw), case.gravity_m_s2
                )
                checked_columns(self.spec, poses.columns)
                return poses
            if self.kind is INSTRUMENT:
                readings = checked_readings(self.spec, given, self.make().quantity, case.times_s.size)
                checked_columns(self.spec, readings.columns)
                return readings
            return checked_columns(self.spec, given, texts=False)
        except ValueError as error:
            raise BreachError(str(error)) from error


def _columns(given: Any) -> Sequence[str]:
    return list(given if isinstance(given, dict) else given.columns)


def _told(given: Any) -> str:
    """What was given, in words."""
    if isinstance(given, dict):
        return " ".join(f"{name} {value:.4g}" for name, value in given.items())
    if isinstance(given, Poses):
        return f"{given.times_s.size} poses from {given.times_s[0]:.4g} to {given.times_s[-1]:.4g} s"
    return f"{given.times_s.size} readings"


def _ground_height(x: float, y: float) -> float:
    return _SLOPE * x


def _nearest_ground(
    apex: Float64[np.ndarray, "3"], axis: Float64[np.ndarray, "3"], half_width_rad: float, farthest_m: float
) -> float:
    """Distance to the nearest of the suite's plane within a cone."""
    away = float(apex @ _NORMAL)
    angle = max(float(np.arccos(np.clip(-axis @ _NORMAL, -1.0, 1.0))) - half_width_rad, 0.0)
    found = away / np.cos(angle) if angle < 0.5 * np.pi else np.inf
    return float(found) if found <= farthest_m else np.inf


@cache
def places() -> tuple[DescentPlace, ...]:
    """Two places of descents: three pictures over Mars, and five that come faster, over a lighter world."""
    return (
        DescentPlace(_ground_height, _GRAVITY_M_S2, (0.0, 3.75, 7.5), -5.0, 8.0, 100.0),
        DescentPlace(_ground_height, 1.62, (0.0, 2.0, 4.0, 6.0, 8.0), -2.0, 8.5, 50.0),
    )


@cache
def motion() -> RecordedMotion:
    """A swinging fall from 1900 m."""
    times = np.arange(-6.0, 22.0, 0.05)
    positions = np.column_stack([12.0 * times, -7.0 * times, 1900.0 - 75.0 * times])
    tilts = np.radians(10.0) * np.column_stack([np.sin(times), np.cos(times), 0.1 * times])
    return RecordedMotion(times, positions, Rotation.from_rotvec(tilts), _GRAVITY_M_S2)


@cache
def truths() -> tuple[InstrumentTruth, ...]:
    """Two descents as instruments are handed them."""
    return tuple(
        InstrumentTruth(np.array(times), motion(), _ground_height, _nearest_ground)
        for times in ((0.0, 3.75, 7.5), (1.0, 2.0, 3.0, 4.0))
    )


@cache
def scored_cases() -> tuple[ScoredCase, ...]:
    """Cases of all kinds, each with an answer and with an expected failure; of real ones truth is known, and is not."""
    velocities = (
        VelocityEstimate(VelocityOutcome.VALID, np.array([11.0, -7.5])),
        VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None),
    )
    sites = (
        SiteEstimate(SiteOutcome.SAFE_SITE, np.array([1.0, 2.0, 0.05])),
        SiteEstimate(SiteOutcome.NO_SAFE_SITE, None),
    )
    descents = [case for answer in velocities for case in _descents(answer)]
    landings = [case for answer in sites for case in _landings(answer)]
    return (*descents, *landings, _run(TrackingState.NORMAL), _run(TrackingState.FAILURE))


def _descents(answer: VelocityEstimate) -> Iterator[ScoredVelocity]:
    """Descents with this answer: simulated to the ground, simulated in the air, real with and without truth."""
    asked: dict[str, Any] = {"measurements": inputs.descent(), "answer": answer}
    true: dict[str, Any] = {"true_velocity_m_s": inputs.DESCENT_VELOCITY_M_S[:2].copy()}
    states = tuple(motion().state(3.75 * number) for number in range(3))
    flown: dict[str, Any] = {"states": states, "motion": motion()}
    firing = motion().state(20.0)
    yield ScoredDescent(**asked, **true, **flown, at_firing=firing, touchdown_m_s=np.array([3.0, -1.0]))
    yield ScoredFlight(**asked, **true, **flown)
    yield ScoredVelocity(**asked, **true)
    yield ScoredVelocity(**asked, true_velocity_m_s=None)


def _landings(answer: SiteEstimate) -> Iterator[ScoredSite]:
    """Flights for a site with this answer: simulated, real with and without truth."""
    asked: dict[str, Any] = {"measurements": inputs.landing(), "answer": answer}
    states = motion().state(0.0), motion().state(3.75)
    first, second = (rigid(state.attitude, state.position_m) for state in states)
    yield ScoredLanding(**asked, true_poses=(first, second), states=states, ground=_ground())
    yield ScoredSite(**asked, true_poses=(first, second))
    yield ScoredSite(**asked, true_poses=None)


def _ground() -> GroundTruth:
    """Level ground of 20 m, safe but for one place."""
    line = np.linspace(-4.0, 4.0, 9)
    places_m = np.stack(np.meshgrid(line, line), axis=-1)
    still = np.zeros(places_m.shape[:2])
    safe = np.ones(still.shape, dtype=bool)
    safe[0, 0] = False
    relief = Relief(np.zeros((200, 200)), -10.0, -10.0, 0.1)
    footprints = Footprints(still, still, still, safe)
    return GroundTruth(relief, Limits(2.0, 0.26, 0.2), places_m, footprints, np.ones(still.shape, dtype=bool), 1.0)


def _run(state: TrackingState) -> ScoredRun:
    """Two stops of a rover, the second with an answer of this state."""
    poses = (trackers.pose(0.0), trackers.pose(0.4))
    box = trackers._box_ahead()
    found = TargetUpdate(TrackingState.NORMAL, (), trackers.TARGET_M.copy())
    last = TargetUpdate(state, (), trackers.TARGET_M - 0.4 if state is TrackingState.NORMAL else None)
    return ScoredRun(
        outcome="COMPLETED" if last.found else "LOST",
        target_world=trackers.TARGET_M.copy(),
        world_from_rover=poses,
        point_px=np.array([[512.0, 400.0], [515.0, 398.0]]),
        measurements=tuple(trackers.taken(box, pose) for pose in poses),
        answers=(found, last),
    )
