"""User-defined instruments: `[parameters.altimeter]` or `[parameters.attitude_source]` of a descent.

An instrument is a class with

- options, the arguments of its constructor, each with a default;
- ``quantity``, the measured quantity: ``"altitude"`` or ``"attitude"``;
- ``random``, whether its readings depend on the random stream;
- ``read(truth: InstrumentTruth, rng: numpy.random.Generator) -> InstrumentReadings``, all readings of one case, so that
  errors common to all readings are drawn once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Float, Float64
from pydantic import Field, model_validator

from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.motions import UNIT_TOLERANCE
from marsyard.scenarios.parts.named import INSTRUMENT, CustomPart
from marsyard.sim.dynamics import Trajectory
from marsyard.sim.sensor.ranging import DOWN

#: Quantities of instruments, and the shape of one reading.
QUANTITIES: Mapping[str, tuple[int, ...]] = {"altitude": (), "attitude": (4,)}


@dataclass(frozen=True)
class InstrumentTruth:
    """Truth for an instrument. World axes are east, north, up; the optical axis is the body's -z, columns along x.

    - times_s: requested times: true picture times for altitudes, time tags of the pictures for attitudes; an instrument
      that measures at other times returns the tags of those times
    - motion: true motion; `motion.state(time_s)` has pose, velocity, body rate, specific force within `motion.span_s`
    - ground_height: height of the ground at world x and y, metres
    - nearest_ground: distance to the nearest ground in a cone, infinite without ground, metres. Arguments: apex and
      axis of the cone (world), half-width (radians), and maximum range (metres)
    """

    times_s: Float64[np.ndarray, "n"]
    motion: Trajectory
    ground_height: Callable[[float, float], float]
    nearest_ground: Callable[[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float, float], float]

    def altitude_m(self, time_s: float) -> float:
        """True height above the ground directly below."""
        position = self.motion.state(time_s).position_m
        return float(position[2]) - self.ground_height(float(position[0]), float(position[1]))

    def first_return_m(self, time_s: float, half_width_deg: float, max_range_m: float) -> float:
        """True distance to the nearest ground in a beam along the body's -z; infinite without ground."""
        state = self.motion.state(time_s)
        axis = np.asarray(state.attitude.apply(DOWN.copy()))
        return self.nearest_ground(state.position_m, axis, float(np.radians(half_width_deg)), max_range_m)


@dataclass(frozen=True)
class InstrumentReadings:
    """Readings of an instrument, one for each requested time.

    - times_s: the instrument's time tags
    - values: altitudes, metres, NaN without a reading; or quaternions x, y, z, w from body to world axes
    - columns: further columns of the row, as `altimeter_NAME` or `attitude_source_NAME`, such as sampled errors
    """

    times_s: Float[np.ndarray, "n"]
    values: Float[np.ndarray, "n *quantity"]
    columns: Mapping[str, Scalar] = field(default_factory=dict)


class _CustomInstrument(CustomPart):
    kind = INSTRUMENT
    name_key = "instrument"
    quantity: ClassVar[str]

    instrument: Annotated[str, Field(description="custom instrument's class: module:Class, or an entry point's name")]

    @model_validator(mode="after")
    def _check_quantity(self) -> _CustomInstrument:
        quantity = self.create().quantity
        if quantity != self.quantity:
            raise ValueError(f"'{self.spec}' measures {quantity!r}; allowed here: {self.quantity!r}")
        return self

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        """Read and check one case. Raises ValueError for invalid readings."""
        return check_readings(self.spec, self.create().read(truth, rng), self.quantity, truth.times_s.size)


class CustomAltimeter(_CustomInstrument):
    """A user-defined altimeter (see `marsyard.scenarios.parts.instruments`)."""

    quantity = "altitude"


class CustomAttitudeSource(_CustomInstrument):
    """A user-defined instrument of attitudes at the pictures, instead of the inertial navigation."""

    quantity = "attitude"


def check_readings(spec: str, readings: object, quantity: str, count: int) -> InstrumentReadings:
    """Return an instrument's readings as 64-bit arrays. Raises ValueError for invalid readings."""
    if not isinstance(readings, InstrumentReadings):
        raise ValueError(
            f"'{spec}' returns a {type(readings).__name__}; allowed: marsyard.scenarios.parts.InstrumentReadings"
        )
    times, values = (np.array(item, dtype=np.float64) for item in (readings.times_s, readings.values))
    for name, array, shape in (("times_s", times, (count,)), ("values", values, (count, *QUANTITIES[quantity]))):
        if array.shape != shape:
            raise ValueError(f"'{spec}' returns {name} of shape {array.shape}; allowed: {shape}")
    if not np.all(np.isfinite(times)):
        raise ValueError(f"'{spec}' returns times_s that are not finite")
    if quantity == "altitude" and np.any(np.isinf(values)):
        raise ValueError(f"'{spec}' returns an infinite altitude; allowed: metres, or NaN for a missing altitude")
    lengths = np.linalg.norm(values, axis=-1) if quantity == "attitude" else np.ones(count)
    if not np.all(np.abs(lengths - 1.0) <= UNIT_TOLERANCE):
        raise ValueError(f"'{spec}' returns quaternions of length {lengths.tolist()}; allowed: 1")
    return InstrumentReadings(times, values, readings.columns)
