"""Navigation filter for localisation on a map: an error-state extended Kalman filter with delayed measurements.

Inertial increments propagate the state (`inertial_state`); positions, altitudes above ground and landmarks in images
update it (`state_updates`). Positions are relative to the map: the error of the map's registration is not contained in
the covariance.

The result of an image is available up to a second after its exposure. An update refers to the time tag of its
measurement: the filter goes back to the stored state before that time, and repeats all later increments and updates.
Hence the order in which measurements arrive has no effect on the result. The covariance is propagated in steps that end
at the times of a fixed grid and of updates; therefore the division of increments into calls has no effect either.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation import state_updates as updates
from marsyard.algorithms.localisation.inertial_state import (
    ERRORS,
    MOTION,
    ImuErrorModel,
    IncrementHistory,
    NavigationState,
    propagate_states,
)
from marsyard.algorithms.localisation.interface import InitialState
from marsyard.algorithms.localisation.state_updates import (
    GroundModel,
    LandmarkMeasurement,
    LandmarkResult,
    UpdateOutcome,
)
from marsyard.sim.measurements import ImuIncrements

Result = TypeVar("Result", UpdateOutcome, LandmarkResult)
#: Step of the time grid on which the covariance is propagated (assumed). At 0.5 rad/s a step of 0.1 s neglects
#: rotations of 0.05 rad in the small terms that `compute_transition` names.
_STEP_S = 0.1
#: Time for which states and increments are stored for delayed updates (assumed).
_MEMORY_S = 5.0
#: Maximum time of a measurement after the last increment, or of an increment's tag from the end of the previous ones; a
#: few sample intervals (assumed).
MAX_EXTRAPOLATION_S = 0.02
#: Minimum time between two tags: equal tags are separated by it, far below the tags' jitter.
_MIN_INTERVAL_S = 1e-9


@dataclass(frozen=True)
class _Checkpoint:
    """A stored state and the number of updates that it contains."""

    state: NavigationState
    updates: int


class EstimatedMotion(NamedTuple):
    """Motion of the body frame, and the covariance of its errors; the fields are those of `PositionEstimate`."""

    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    world_from_body: Rotation
    covariance: Float[np.ndarray, "9 9"]


class LocalisationFilter:
    """Error-state extended Kalman filter of 15 errors for map-relative localisation.

    Updates return a result with an outcome; a measurement that is rejected, not finite or outside the stored history
    does not change the state. A rejected update is stored: if an earlier measurement arrives later, it is tested again.
    """

    def __init__(self, state: NavigationState, gravity_m_s2: float, imu: ImuErrorModel) -> None:
        self._gravity_m_s2, self._imu = gravity_m_s2, imu
        self._start_s = state.time_s
        self._checkpoints = [_Checkpoint(state, 0)]
        self._history: IncrementHistory | None = None
        self._update_times_s: list[float] = []
        self._updates: list[Callable[[NavigationState], NavigationState]] = []

    @classmethod
    def from_initial(cls, initial: InitialState, imu: ImuErrorModel | None = None) -> LocalisationFilter:
        """Create the filter from a state of inertial navigation, with biases of zero; `imu`: errors of the unit."""
        imu = ImuErrorModel() if imu is None else imu
        covariance = np.zeros((ERRORS, ERRORS))
        covariance[MOTION, MOTION] = initial.covariance
        covariance[MOTION.stop :, MOTION.stop :] = np.diag(imu.initial_bias_variances)
        position, velocity = initial.position_m, initial.velocity_m_s
        zero, attitude = np.zeros(3), initial.world_from_body
        state = NavigationState(initial.time_s, position, velocity, attitude, zero, zero, covariance)
        return cls(state, initial.gravity_m_s2, imu)

    @property
    def time_s(self) -> float:
        """Time tag of the last increment; the initial time before the first."""
        return self._start_s if self._history is None else float(self._history.times_s[-1])

    @property
    def memory_start_s(self) -> float:
        """Time of the first stored state: measurements before it cannot be processed."""
        return self._checkpoints[0].state.time_s

    def propagate(self, increments: ImuIncrements) -> None:
        """Propagate by increments; their first boundary is the last one of the previous call.

        Raises ValueError if it is not, apart from jitter of the tags up to `MAX_EXTRAPOLATION_S`.
        """
        if len(increments.delta_angles_rad) == 0:
            return
        gap = float(increments.times_s[0]) - self.time_s
        if abs(gap) > MAX_EXTRAPOLATION_S:
            raise ValueError(f"increments begin {gap:+.6f} s from the end of the previous ones; allowed: consecutive")
        previous = self._history
        if previous is None:
            tags, angles = increments.times_s, increments.delta_angles_rad
            velocities = increments.delta_velocities_m_s
        else:
            tags = np.concatenate([previous.times_s, increments.times_s[1:]])
            angles = np.concatenate([previous.delta_angles_rad, increments.delta_angles_rad])
            velocities = np.concatenate([previous.delta_velocities_m_s, increments.delta_velocities_m_s])
        if np.diff(tags).min() < _MIN_INTERVAL_S:
            ramp = _MIN_INTERVAL_S * np.arange(len(tags))
            tags = np.maximum.accumulate(tags - ramp) + ramp
        self._history = IncrementHistory(tags, increments.period_s, angles, velocities)
        self._store_checkpoints()
        self._discard_old_states()

    def is_stored(self, time_s: float) -> bool:
        """Whether a time is in the stored history, so that a state exists and a measurement can be processed."""
        extrapolation = 0.0 if self._history is None else MAX_EXTRAPOLATION_S
        return self.memory_start_s <= time_s <= self.time_s + extrapolation

    def state_at(self, time_s: float) -> NavigationState:
        """Compute the state at a time in the stored history, including all updates up to that time.

        Raises ValueError for a time outside the history.
        """
        if not self.is_stored(time_s):
            allowed = f"{self.memory_start_s:.4f} s to {self.time_s:.4f} s"
            raise ValueError(f"time {time_s:.4f} s is outside of the stored history; allowed: {allowed}")
        return self._propagate_and_update(self._checkpoints[self._last_checkpoint_before(time_s)], time_s)[-1].state

    def estimate(self, time_s: float) -> EstimatedMotion:
        """Compute the motion at a time; ValueError as `state_at`."""
        state = self.state_at(time_s)
        covariance = state.covariance[MOTION, MOTION]
        return EstimatedMotion(state.position_m, state.velocity_m_s, state.world_from_body, covariance)

    def update_position(
        self, time_s: float, horizontal_position_m: Float[np.ndarray, "2"], covariance: Float[np.ndarray, "2 2"]
    ) -> UpdateOutcome:
        """Update by a horizontal position on the map (east, north), for example a coarse fix."""
        update = partial(updates.update_position, horizontal_position_m=horizontal_position_m, covariance=covariance)
        return self._update(time_s, update, UpdateOutcome.OUTSIDE_HISTORY)

    def update_altitude(
        self, time_s: float, altitude_m: float, ground_height: GroundModel, sd_m: float
    ) -> UpdateOutcome:
        """Update by an altitude above the ground below the body frame's origin.

        `ground_height` is the map's height at the estimated position with its slope (east, north), or a function that
        returns both for a position (x, y), NaN outside the map. `sd_m` contains the map's error of elevation. The slope
        is extrapolated linearly to the true position: while the horizontal position is uncertain by more than the
        slope's extent, use a slope of zero and the relief's standard deviation.
        """
        update = partial(updates.update_altitude, altitude_m=altitude_m, ground=ground_height, sd_m=sd_m)
        return self._update(time_s, update, UpdateOutcome.OUTSIDE_HISTORY)

    def update_landmarks(self, time_s: float, measurement: LandmarkMeasurement) -> LandmarkResult:
        """Update by landmarks in an image, with rejection of outliers (`state_updates.update_landmarks`)."""
        count = len(measurement.pixels)
        outside = LandmarkResult(UpdateOutcome.OUTSIDE_HISTORY, np.zeros(count, bool), np.full((count, 2), np.nan))
        return self._update(time_s, partial(updates.update_landmarks, measurement=measurement), outside)

    def _update(
        self, time_s: float, update: Callable[[NavigationState], tuple[NavigationState, Result]], outside: Result
    ) -> Result:
        """Apply an update at its time, then repeat all later increments and updates."""
        if not self.is_stored(time_s):
            return outside
        state, result = update(self.state_at(time_s))
        if result is UpdateOutcome.INVALID:
            return result
        index = bisect_right(self._update_times_s, time_s)
        self._update_times_s.insert(index, time_s)
        self._updates.insert(index, lambda prior: update(prior)[0])
        self._checkpoints = [checkpoint for checkpoint in self._checkpoints if checkpoint.state.time_s <= time_s]
        if time_s <= self.time_s:
            self._checkpoints.append(_Checkpoint(state, index + 1))
            self._store_checkpoints()
        return result

    def _last_checkpoint_before(self, time_s: float) -> int:
        """Return the index of the last checkpoint at or before a time."""
        return bisect_right([checkpoint.state.time_s for checkpoint in self._checkpoints], time_s) - 1

    def _store_checkpoints(self) -> None:
        """Store checkpoints up to the last time of the grid and the last update within the increments."""
        last = self._checkpoints[-1]
        pending = self._update_times_s[last.updates : bisect_right(self._update_times_s, self.time_s)]
        grid_time_s = self._start_s + _STEP_S * np.floor((self.time_s - self._start_s) / _STEP_S)
        end_s = max([float(grid_time_s), *pending])
        if end_s > last.state.time_s:
            self._checkpoints += self._propagate_and_update(last, end_s)

    def _propagate_and_update(self, checkpoint: _Checkpoint, end_s: float) -> list[_Checkpoint]:
        """Propagate from a checkpoint to a time and apply the updates up to it; return the new checkpoints.

        The last one is at the end time. If the given checkpoint already is, it is returned alone.
        """
        state, count = checkpoint.state, checkpoint.updates
        results = [checkpoint]
        for index in range(count, bisect_right(self._update_times_s, end_s)):
            for propagated in self._propagate(state, self._update_times_s[index]):
                results.append(_Checkpoint(propagated, index))
                state = propagated
            state = self._updates[index](state)
            results.append(_Checkpoint(state, index + 1))
        results += [_Checkpoint(propagated, results[-1].updates) for propagated in self._propagate(state, end_s)]
        return results[1:] if len(results) > 1 else results

    def _propagate(self, state: NavigationState, end_s: float) -> list[NavigationState]:
        """Propagate a state to the times of the grid before a time, and to that time."""
        if self._history is None or end_s <= state.time_s:
            return []
        first, last = ((time_s - self._start_s) / _STEP_S for time_s in (state.time_s, end_s))
        grid = self._start_s + _STEP_S * np.arange(np.floor(first), np.ceil(last) + 1.0)
        times = np.append(grid[(grid > state.time_s) & (grid < end_s)], end_s)
        return propagate_states(state, self._history, times, self._gravity_m_s2, self._imu)

    def _discard_old_states(self) -> None:
        """Remove states and increments that are older than the memory."""
        history = self._history
        first_s = max(self.time_s - _MEMORY_S, self.memory_start_s)
        self._checkpoints = self._checkpoints[self._last_checkpoint_before(first_s) :]
        if history is not None:
            interval = int(np.searchsorted(history.times_s, self.memory_start_s, side="right")) - 1
            start = min(max(interval, 0), len(history.delta_angles_rad) - 1)
            angles, velocities = history.delta_angles_rad[start:], history.delta_velocities_m_s[start:]
            self._history = IncrementHistory(history.times_s[start:], history.period_s, angles, velocities)
