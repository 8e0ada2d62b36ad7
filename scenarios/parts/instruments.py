"""User-defined instruments: `[parameters.altimeter]` or `[parameters.attitude_source]` of a descent.

An instrument is a class with

- options: arguments of the constructor, each with a default value;
- ``quantity``: the measured quantity, ``"altitude"`` or ``"attitude"``;
- ``random``: whether the readings depend on the random stream;
- ``read(truth: InstrumentTruth, rng: numpy.random.Generator) -> InstrumentReadings``: returns all readings of one case.
  Errors common to all readings are therefore sampled once.
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
from marsyard.sim.sensor.altimeters import DOWN

#: Shape of one reading by measured quantity.
QUANTITIES: Mapping[str, tuple[int, ...]] = {"altitude": (), "attitude": (4,)}


@dataclass(frozen=True)
class InstrumentTruth:
    """True motion and ground as input of an instrument.

    World axes are east, north, up. In body axes the camera looks along -z, and its image columns increase along x.

    - times_s: requested times: true exposure times for an altimeter, time tags of the images for an attitude source.
      An instrument may measure at other times; the time tags of its readings are then those of the measurements.
    - motion: true motion; `motion.state(time_s)` returns pose, velocity, body rate and specific force at a time within
      `motion.span_s`
    - ground_height: function that returns the height of the ground (m) at world x and y (m)
    - nearest_ground: function that returns the distance (m) to the nearest ground in a cone, infinite without ground.
      Arguments: apex of the cone (m, world), axis (unit vector, world), half angle (rad), maximum range (m)
    """

    times_s: Float64[np.ndarray, "n"]
    motion: Trajectory
    ground_height: Callable[[float, float], float]
    nearest_ground: Callable[[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float, float], float]

    def altitude_m(self, time_s: float) -> float:
        """Return the true height above the ground directly below, metres."""
        position = self.motion.state(time_s).position_m
        return float(position[2]) - self.ground_height(float(position[0]), float(position[1]))

    def first_return_m(self, time_s: float, half_width_deg: float, max_range_m: float) -> float:
        """Return the true distance (m) to the nearest ground in a beam along the body's -z; infinite without ground."""
        state = self.motion.state(time_s)
        axis = np.asarray(state.attitude.apply(DOWN.copy()))
        return self.nearest_ground(state.position_m, axis, float(np.radians(half_width_deg)), max_range_m)


@dataclass(frozen=True)
class InstrumentReadings:
    """Readings of an instrument: one reading for each requested time.

    - times_s: time tags of the readings
    - values: altitudes (m; NaN without a reading), or quaternions (x, y, z, w) of rotations from body to world axes
    - columns: further result columns, such as sampled errors; the prefix `altimeter_` or `attitude_source_` is added to
      their names
    """

    times_s: Float[np.ndarray, "n"]
    values: Float[np.ndarray, "n *quantity"]
    columns: Mapping[str, Scalar] = field(default_factory=dict)


class _CustomInstrument(CustomPart):
    """A user-defined instrument; subclasses define the measured quantity."""

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
        """Return the checked readings of one case. Raises ValueError for invalid readings."""
        return check_readings(self.spec, self.create().read(truth, rng), self.quantity, truth.times_s.size)


class CustomAltimeter(_CustomInstrument):
    """A user-defined altimeter (see `marsyard.scenarios.parts.instruments`)."""

    quantity = "altitude"


class CustomAttitudeSource(_CustomInstrument):
    """A user-defined attitude source that replaces the attitudes of the inertial navigation."""

    quantity = "attitude"


def check_readings(spec: str, readings: object, quantity: str, count: int) -> InstrumentReadings:
    """Check an instrument's readings and return them as 64-bit arrays. Raises ValueError for invalid readings."""
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
