"""The flight of the swing by SciPy's eighth-order Runge-Kutta method, its arithmetic compiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.integrate import DOP853, DenseOutput, OdeSolution, solve_ivp

from marsyard.sim.dynamics.kernels.swing import Chain, WindField, interpolated, packed, slope, step, terms

StateVector = Float64[np.ndarray, "22"]
#: What `solve_ivp` asks of an event.
Event = Callable[..., float]

#: Tolerances of the integration, with which finite differences of the flight reproduce its derivatives to 1e-6.
RELATIVE_TOLERANCE = 1e-9
ABSOLUTE_TOLERANCE = 1e-9


class _Piece(DenseOutput):
    """The flight over one step: the state at its start, and the terms of SciPy's polynomial of seventh order."""

    def __init__(
        self, start_s: float, end_s: float, state: StateVector, polynomial: Float64[np.ndarray, "7 22"]
    ) -> None:
        super().__init__(start_s, end_s)
        self.state = state
        self.polynomial = polynomial

    def _call_impl(self, t: Any) -> Any:
        """States at times as SciPy asks for them to find events: one column each, or one state."""
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        start, length = np.array([self.t_old]), np.array([self.t - self.t_old])
        rows = interpolated(times, start, start, length, self.state[None], self.polynomial[None])
        return rows[0] if np.ndim(t) == 0 else rows.T


class _CompiledDop853(DOP853):
    """DOP853 whose steps, with SciPy's coefficients and SciPy's control of their length, are compiled functions."""

    def __init__(
        self,
        fun: Any,
        t0: float,
        y0: StateVector,
        t_bound: float,
        *,
        constants: Float64[np.ndarray, "n"],
        waves: Float64[np.ndarray, "m 7"],
        **options: Any,
    ) -> None:
        super().__init__(fun, t0, y0, t_bound, **options)
        self._constants = (constants, waves)
        self._before: StateVector = y0

    def _step_impl(self) -> tuple[bool, str | None]:
        self._before = np.asarray(self.y, dtype=np.float64)
        self.K_extended[0] = self.f
        before = self.t
        done, self.t, self.h_abs, self.y = step(
            before,
            self.y,
            self.h_abs * self.direction,
            self.t_bound,
            RELATIVE_TOLERANCE,
            ABSOLUTE_TOLERANCE,
            *self._constants,
            self.K_extended,
        )
        if not done:
            return False, self.TOO_SMALL_STEP
        self.h_previous = self.t - before
        self.f = self.K_extended[self.n_stages].copy()
        return True, None

    def _dense_output_impl(self) -> _Piece:
        polynomial = terms(self._before, self.y, self.h_previous, *self._constants, self.K_extended)
        return _Piece(self.t_old, self.t, self._before, polynomial)


@dataclass(frozen=True)
class Path:
    """The flight as polynomials, one for each step of the integration.

    Attributes
    ----------
    span_s
        First and last time at which it is known.
    knots_s
        Earliest time of each step, increasing.
    starts_s, lengths_s, states
        Time and state from which each step was taken, and its length, negative backwards.
    polynomials
        Their terms (`marsyard.sim.dynamics.kernels.swing.terms`).
    """

    span_s: tuple[float, float]
    knots_s: Float64[np.ndarray, "steps"]
    starts_s: Float64[np.ndarray, "steps"]
    lengths_s: Float64[np.ndarray, "steps"]
    states: Float64[np.ndarray, "steps 22"]
    polynomials: Float64[np.ndarray, "steps 7 22"]

    @classmethod
    def followed(
        cls, state: StateVector, lead_s: float, longest_s: float, ending: Event, chain: Chain, field: WindField
    ) -> Path:
        """The flight through a state at time 0: from `lead_s` before, until `ending` passes zero or `longest_s` after.

        Raises ValueError where it cannot be followed.
        """
        before = _solved(state, -lead_s, None, chain, field)
        after = _solved(state, longest_s, ending, chain, field)
        pieces = [*reversed(before.interpolants), *after.interpolants]
        starts, lengths = np.array([[one.t_old, one.t - one.t_old] for one in pieces]).T.copy()
        return cls(
            span_s=(float(before.t_min), float(after.t_max)),
            knots_s=np.minimum(starts, starts + lengths),
            starts_s=starts,
            lengths_s=lengths,
            states=np.stack([one.state for one in pieces]),
            polynomials=np.stack([one.polynomial for one in pieces]),
        )

    def at(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 22"]:
        """State vectors of the chain (`marsyard.sim.dynamics.kernels.swing`). Raises ValueError outside of the span."""
        first, last = self.span_s
        outside = times_s[(times_s < first) | (times_s > last)]
        if outside.size:
            raise ValueError(f"time {outside[0]:.6g} s is outside of the flight; allowed: {first:.6g} to {last:.6g} s")
        rows: Float64[np.ndarray, "n 22"] = interpolated(
            times_s, self.knots_s, self.starts_s, self.lengths_s, self.states, self.polynomials
        )
        return rows


def _solved(state: StateVector, end_s: float, ending: Event | None, chain: Chain, field: WindField) -> OdeSolution:
    """The flight from a state at time 0 until a time or, if that is sooner, until `ending` passes zero."""
    if ending is not None:
        ending.terminal = True  # type: ignore[attr-defined]
    constants, waves = packed(chain, field)
    of_method: dict[str, Any] = {"constants": constants, "waves": waves}
    solution = solve_ivp(
        slope,
        (0.0, end_s),
        state,
        method=_CompiledDop853,
        dense_output=True,
        rtol=RELATIVE_TOLERANCE,
        atol=ABSOLUTE_TOLERANCE,
        events=ending,
        args=(constants, waves),
        **of_method,
    )
    if solution.sol is None or not solution.success:
        raise ValueError(f"the descent cannot be followed beyond {solution.t[-1]:.6g} s: {solution.message}")
    return solution.sol
