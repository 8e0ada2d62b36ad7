"""Conformance checks of user-defined parts: motions (kind `DYNAMICS`), instruments and scores.

Parts are described in `marsyard.scenarios.parts`.
"""

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
from marsyard.scenarios.conformance.checks import BreachError, Check, Suite, fingerprint
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.relief import Footprints, Limits, Relief
from marsyard.scenarios.parts import scores
from marsyard.scenarios.parts.instruments import InstrumentTruth, check_readings
from marsyard.scenarios.parts.motions import MotionInputs, Poses, check_poses
from marsyard.scenarios.parts.named import DYNAMICS, INSTRUMENT, KINDS, SCORE, PartKind, check_columns, list_installed
from marsyard.sim.dynamics.recorded import RecordedMotion
from marsyard.sim.frames import rigid

#: Gravity of the Moon, m/s^2.
_MOON_GRAVITY_M_S2 = 1.62
#: Slope of the suite's ground (rise towards the east divided by distance), and its unit normal.
_SLOPE = 0.05
_NORMAL = np.array([-_SLOPE, 0.0, 1.0]) / np.hypot(_SLOPE, 1.0)


def determine_kind(spec: str) -> str | None:
    """Determine the kind of a part by its entry point, the members of its class, or the annotation of its function.

    Returns None if these do not determine it: for example, any function could be a score, so one without annotation
    is not recognised as such.
    """
    name = next((kind.name for kind in KINDS.values() if spec in list_installed(kind.group)), None)
    if name is not None or ":" not in spec:
        return name
    try:
        part = import_object(spec)
    except (ImportError, ValueError):
        return None
    if isinstance(part, type):
        return next((kind.name for kind in (DYNAMICS, INSTRUMENT) if hasattr(part, kind.members[0])), None)
    if not callable(part):
        return None
    return SCORE.name if scores.annotated_cases(part) else None


@dataclass(frozen=True)
class PartSuite(Suite):
    """Conformance suite of one custom part of the kind `kind`, constructed with the default options of its class."""

    kind: PartKind

    deterministic_advice = "use only the generator in the arguments; keep no state between cases"
    time_verb = "answers a case"
    forbids_truth = False
    writable_inputs = True

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        advice = "see docs/custom-parts.md for inputs and outputs"
        requirement = "returns the output of its kind: arrays of the right shapes, finite values, increasing times"
        yield Check(
            "answer", requirement, advice, lambda: ", ".join(_describe(self._answer(case)) for case in self.cases())
        )
        requirement = "reports the same columns in every case: names are identifiers, values are numbers or booleans"
        yield Check(
            "columns", requirement, "report every column in every case; NaN for a missing number", self._check_columns
        )
        yield from self.common_checks()
        if self.kind is not SCORE:
            requirement = "depends on its random stream only if its attribute random is true"
            advice = "set random to true if it uses random numbers, and use only the generator in the arguments"
            yield Check("random", requirement, advice, self._check_random_attribute)

    def cases(self) -> Sequence[Any]:
        """See `Suite`."""
        if self.kind is not SCORE:
            return motion_cases() if self.kind is DYNAMICS else instrument_cases()
        accepted_types = scores.accepted_cases(scores.load_score(self.spec))
        return [case for case in scored_cases() if isinstance(case, accepted_types)]

    def _call(self, algorithm: Any, case: Any, seed: int) -> Any:
        rng = np.random.default_rng(seed)
        if self.kind is DYNAMICS:
            return algorithm.fly(case, rng)
        return algorithm.read(case, rng) if self.kind is INSTRUMENT else algorithm(case)

    def _check_answer(self, answer: Any, case: Any) -> Any:
        try:
            if self.kind is SCORE:
                return check_columns(self.spec, answer, texts=False)
            if self.kind is DYNAMICS:
                answer = check_poses(self.spec, answer, case)
                attitudes = Rotation.from_quat(answer.quaternions_xyzw)
                # raises ValueError if no motion can be interpolated between the poses
                RecordedMotion(answer.times_s, answer.positions_m, attitudes, case.gravity_m_s2)
            else:
                answer = check_readings(self.spec, answer, self.make().quantity, case.times_s.size)
            check_columns(self.spec, answer.columns)
        except ValueError as error:
            raise BreachError(str(error)) from error
        return answer

    def _check_columns(self) -> str:
        answers = [self._answer(case, seed) for case in self.cases() for seed in (1, 2)]
        columns = [tuple(answer if isinstance(answer, dict) else answer.columns) for answer in answers]
        if len(set(columns)) > 1:
            variants = " / ".join(", ".join(names) or "none" for names in dict.fromkeys(columns))
            raise BreachError(f"its columns change: {variants}")
        return ", ".join(columns[0]) or "none"

    def _check_random_attribute(self) -> str:
        is_random = bool(self.make().random)
        case = self.cases()[0]
        is_different = fingerprint(self._answer(case, 1)) != fingerprint(self._answer(case, 2))
        if is_random and not is_different:
            raise BreachError("its attribute random is true, but two streams give the same output")
        if is_different and not is_random:
            raise BreachError("its attribute random is false, but two streams give different outputs")
        return "random" if is_random else "not random"


def load_part(kind: PartKind, spec: str) -> Any:
    """Load a part with default options. Raises ValueError with the allowed names if there is no such part."""
    return scores.load_score(spec) if kind is SCORE else kind.create(spec, {})


def _describe(answer: Any) -> str:
    if isinstance(answer, dict):
        return " ".join(f"{name} {value:.4g}" for name, value in answer.items())
    if isinstance(answer, Poses):
        return f"{answer.times_s.size} poses from {answer.times_s[0]:.4g} to {answer.times_s[-1]:.4g} s"
    return f"{answer.times_s.size} readings"


def _ground_height(x: float, y: float) -> float:
    return _SLOPE * x


def _nearest_ground(
    apex: Float64[np.ndarray, "3"], axis: Float64[np.ndarray, "3"], half_width_rad: float, max_range_m: float
) -> float:
    """Compute the shortest distance from the apex of a cone to the plane inside the cone; infinite beyond the range."""
    angle = max(float(np.arccos(np.clip(-axis @ _NORMAL, -1.0, 1.0))) - half_width_rad, 0.0)
    distance = float(apex @ _NORMAL) / np.cos(angle) if angle < 0.5 * np.pi else np.inf
    return float(distance) if distance <= max_range_m else np.inf


@cache
def motion_cases() -> tuple[MotionInputs, ...]:
    """Create the inputs of motions: three images on Mars, and five images at shorter intervals on the Moon."""
    return (
        # ground, gravity, times of the images, start and end of the poses (s), firing height (m)
        MotionInputs(_ground_height, inputs.GRAVITY_M_S2, (0.0, 3.75, 7.5), -5.0, 8.0, 100.0),
        MotionInputs(_ground_height, _MOON_GRAVITY_M_S2, (0.0, 2.0, 4.0, 6.0, 8.0), -2.0, 8.5, 50.0),
    )


@cache
def swinging_fall() -> RecordedMotion:
    """Create the motion of a coning descent: 1900 m high at time 0, 75 m/s down, tilted by about 10 deg."""
    times = np.arange(-6.0, 22.0, 0.05)
    positions = np.column_stack([12.0 * times, -7.0 * times, 1900.0 - 75.0 * times])
    tilts = np.radians(10.0) * np.column_stack([np.sin(times), np.cos(times), 0.1 * times])
    return RecordedMotion(times, positions, Rotation.from_rotvec(tilts), inputs.GRAVITY_M_S2)


@cache
def instrument_cases() -> tuple[InstrumentTruth, ...]:
    """Create the inputs of instruments: two descents."""
    return tuple(
        InstrumentTruth(np.array(times), swinging_fall(), _ground_height, _nearest_ground)
        for times in ((0.0, 3.75, 7.5), (1.0, 2.0, 3.0, 4.0))
    )


@cache
def scored_cases() -> tuple[scores.ScoredCase, ...]:
    """Create the inputs of scores: each type of scored case, with an answer and with a failure.

    Measured cases (`ScoredVelocity`, `ScoredSite`) are also created without truth.
    """
    velocities = (
        VelocityEstimate(VelocityOutcome.VALID, np.array([11.0, -7.5])),
        VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None),
    )
    sites = (
        SiteEstimate(SiteOutcome.SAFE_SITE, np.array([1.0, 2.0, 0.05])),
        SiteEstimate(SiteOutcome.NO_SAFE_SITE, None),
    )
    states = (swinging_fall().state(0.0), swinging_fall().state(3.75), swinging_fall().state(7.5))
    poses = rigid(states[0].attitude, states[0].position_m), rigid(states[1].attitude, states[1].position_m)
    cases: list[scores.ScoredCase] = []
    for answer in velocities:
        without_truth: dict[str, Any] = {"measurements": inputs.descent(), "answer": answer}
        with_truth: dict[str, Any] = without_truth | {"true_velocity_m_s": inputs.DESCENT_VELOCITY_M_S[:2].copy()}
        with_motion: dict[str, Any] = with_truth | {"states": states, "motion": swinging_fall()}
        touchdown: dict[str, Any] = {"at_firing": swinging_fall().state(20.0), "touchdown_m_s": np.array([3.0, -1.0])}
        cases += [scores.ScoredDescent(**with_motion, **touchdown), scores.ScoredFlight(**with_motion)]
        cases += [scores.ScoredVelocity(**with_truth), scores.ScoredVelocity(**without_truth, true_velocity_m_s=None)]
    for site in sites:
        without_truth = {"measurements": inputs.landing(), "answer": site}
        with_truth = without_truth | {"true_poses": poses}
        landing = scores.ScoredLanding(**with_truth, states=states[:2], ground=_make_ground_truth())
        cases += [landing, scores.ScoredSite(**with_truth), scores.ScoredSite(**without_truth, true_poses=None)]
    return (*cases, _make_scored_run(TrackingState.NORMAL), _make_scored_run(TrackingState.FAILURE))


def _make_ground_truth() -> GroundTruth:
    """Create level ground of 20 m x 20 m with one unsafe position."""
    coordinates_m = np.linspace(-4.0, 4.0, 9)
    positions_m = np.stack(np.meshgrid(coordinates_m, coordinates_m), axis=-1)
    zeros = np.zeros(positions_m.shape[:2])
    is_safe = np.ones(zeros.shape, dtype=bool)
    is_safe[0, 0] = False
    relief = Relief(np.zeros((200, 200)), -10.0, -10.0, 0.1)
    footprints = Footprints(zeros, zeros, zeros, is_safe)
    # lander: diameter 2 m, slope up to 0.26 rad (15 deg), roughness up to 0.2 m
    return GroundTruth(relief, Limits(2.0, 0.26, 0.2), positions_m, footprints, np.ones(zeros.shape, dtype=bool), 1.0)


def _make_scored_run(state: TrackingState) -> scores.ScoredRun:
    """Create a rover's run with two stops; the answer at the second stop has this state."""
    poses = (trackers.pose(0.0), trackers.pose(0.4))
    first = TargetUpdate(TrackingState.NORMAL, (), trackers.TARGET_M.copy())
    last = TargetUpdate(state, (), trackers.TARGET_M - 0.4 if state is TrackingState.NORMAL else None)
    return scores.ScoredRun(
        outcome="COMPLETED" if last.tracked else "LOST",
        target_world=trackers.TARGET_M.copy(),
        world_from_rover=poses,
        point_px=np.array([[512.0, 400.0], [515.0, 398.0]]),
        measurements=tuple(trackers.take_images(trackers.aim_ahead(), pose) for pose in poses),
        answers=(first, last),
    )
