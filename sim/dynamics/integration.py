"""The flight of the swing by SciPy's eighth-order Runge-Kutta method, DOP853; its equations are compiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.integrate import OdeSolution, solve_ivp

from marsyard.sim.dynamics.kernels.swing import Chain, WindField, interpolated, packed, slope

StateVector = Float64[np.ndarray, "22"]
#: What `solve_ivp` asks of an event.
Event = Callable[..., float]

#: Tolerances of the integration, with which finite differences of the flight reproduce its derivatives to 1e-6.
RELATIVE_TOLERANCE = 1e-9
ABSOLUTE_TOLERANCE = 1e-9


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
        Their terms: differences that SciPy's Horner scheme multiplies by x and 1 - x in turn, x the passed fraction.
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
        starts, lengths = np.array([[one.t_old, one.h] for one in pieces]).T.copy()
        return cls(
            span_s=(float(before.t_min), float(after.t_max)),
            knots_s=np.minimum(starts, starts + lengths),
            starts_s=starts,
            lengths_s=lengths,
            states=np.stack([one.y_old for one in pieces]),
            polynomials=np.stack([one.F for one in pieces]),
        )

    def at(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 22"]:
        """State vectors of the chain (`marsyard.sim.dynamics.kernels.swing`). Raises ValueError outside of the span."""
        first, last = self.span_s
        outside = times_s[(times_s < first) | (times_s > last)]
        if outside.size:
            raise ValueError(f"time {outside[0]:.6g} s is outside of the flight; allowed: {first:.6g} to {last:.6g} s")
        return np.asarray(
            interpolated(times_s, self.knots_s, self.starts_s, self.lengths_s, self.states, self.polynomials)
        )


def _solved(state: StateVector, end_s: float, ending: Event | None, chain: Chain, field: WindField) -> OdeSolution:
    """The flight from a state at time 0 until a time or, if that is sooner, until `ending` passes zero."""
    if ending is not None:
        ending.terminal = True  # type: ignore[attr-defined]
    solution = solve_ivp(
        slope,
        (0.0, end_s),
        state,
        method="DOP853",
        dense_output=True,
        rtol=RELATIVE_TOLERANCE,
        atol=ABSOLUTE_TOLERANCE,
        events=ending,
        args=packed(chain, field),
    )
    if solution.sol is None or not solution.success:
        raise ValueError(f"the descent cannot be followed beyond {solution.t[-1]:.6g} s: {solution.message}")
    return solution.sol
