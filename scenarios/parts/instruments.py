"""An instrument by a class of a user's own: `[parameters.altimeter]` or `[parameters.attitude_source]` of a descent.

A class that has

- options, which it takes by name when it is made, each with a default;
- ``quantity``, what it measures: ``"altitude"`` or ``"attitude"``;
- ``random``, whether its readings depend on the random stream;
- ``read(truth: InstrumentTruth, rng: numpy.random.Generator) -> InstrumentReadings``, all readings of one case, so that
  errors which readings share are drawn once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Protocol

import numpy as np
from jaxtyping import Float, Float64
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.motions import UNIT_TOLERANCE
from marsyard.scenarios.parts.named import INSTRUMENT, OwnPart
from marsyard.sim.dynamics import Trajectory
from marsyard.sim.sensor.ranging import DOWN

#: Quantities that an instrument can measure, and the shape of one reading.
QUANTITIES: Mapping[str, tuple[int, ...]] = {"altitude": (), "attitude": (4,)}


@dataclass(frozen=True)
class InstrumentTruth:
    """What is true where an instrument measures.

    World axes are east, north, up; the body's camera looks along -z with its columns along x.

    Attributes
    ----------
    times_s
        When readings are asked for: of altitudes, true times of the pictures; of attitudes, the pictures' time tags. An
        instrument that measures at other times reads the motion at its own, and tags its readings so.
    motion
        The true motion: `motion.state(time_s)` gives pose, velocity, body rate and specific force, `motion.span_s` the
        times at which it is known.
    ground_height
        Height of the ground in the world, metres, by x and y in the world, metres.
    nearest_ground
        Distance to the nearest ground within a cone, metres, infinite where there is none: by the cone's apex and axis
        (world), its half-width (radians), and the farthest distance that is looked at (metres).
    """

    times_s: Float64[np.ndarray, "n"]
    motion: Trajectory
    ground_height: Callable[[float, float], float]
    nearest_ground: Callable[[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float, float], float]

    def altitude_m(self, time_s: float) -> float:
        """True height above the ground straight below, metres."""
        place = self.motion.state(time_s).position_m
        return float(place[2]) - self.ground_height(float(place[0]), float(place[1]))

    def first_return_m(self, time_s: float, half_width_deg: float, farthest_m: float) -> float:
        """True distance to the nearest ground in a beam along the body's -z, metres; infinite where there is none."""
        state = self.motion.state(time_s)
        axis = np.asarray(state.attitude.apply(DOWN.copy()))
        return self.nearest_ground(state.position_m, axis, float(np.radians(half_width_deg)), farthest_m)


@dataclass(frozen=True)
class InstrumentReadings:
    """What an instrument delivers: a reading for each time asked for.

    Attributes
    ----------
    times_s
        Its own time tags.
    values
        Altitudes, metres, not a number where it has none; or quaternions x, y, z, w from body to world axes.
    columns
        What else is to be told of the case in its row, as `altimeter_NAME` or `attitude_source_NAME`: the constant
        errors that were drawn, for one.
    """

    times_s: Float[np.ndarray, "n"]
    values: Float[np.ndarray, "n *quantity"]
    columns: Mapping[str, Scalar] = field(default_factory=dict)


class Instrument(Protocol):
    """An instrument of a user's own. `random`: whether the readings depend on the random stream."""

    quantity: str
    random: bool

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        """All readings of one case."""
        ...


class _OwnInstrument(OwnPart):
    """A table that names an instrument of a user's own."""

    kind = INSTRUMENT
    named_by = "instrument"
    quantity: ClassVar[str]

    instrument: Annotated[str, Field(description="an own instrument's class: module:Class, or an entry point's name")]

    @model_validator(mode="after")
    def _measures_what_is_asked(self) -> _OwnInstrument:
        measured = self.made().quantity
        if measured != self.quantity:
            raise ValueError(f"'{self.spec}' measures {measured!r}; allowed here: {self.quantity!r}")
        return self

    def read(self, truth: InstrumentTruth, rng: np.random.Generator) -> InstrumentReadings:
        """The readings of one case. Raises ValueError where they are not as they should be."""
        return checked_readings(self.spec, self.made().read(truth, rng), self.quantity, truth.times_s.size)


class OwnAltimeter(_OwnInstrument):
    """An altimeter of a user's own (see `marsyard.scenarios.parts.instruments`)."""

    quantity = "altitude"


class OwnAttitudeSource(_OwnInstrument):
    """Attitudes at the pictures from an instrument of a user's own, in place of the inertial navigation's."""

    quantity = "attitude"


def checked_readings(spec: str, readings: object, quantity: str, count: int) -> InstrumentReadings:
    """The readings that an instrument gave, as arrays of 64 bits. Raises ValueError where they are wrong."""
    if not isinstance(readings, InstrumentReadings):
        raise ValueError(
            f"'{spec}' reads a {type(readings).__name__}; allowed: marsyard.scenarios.parts.InstrumentReadings"
        )
    times, values = (np.array(one, dtype=np.float64) for one in (readings.times_s, readings.values))
    for name, given, allowed in (("times_s", times, (count,)), ("values", values, (count, *QUANTITIES[quantity]))):
        if given.shape != allowed:
            raise ValueError(f"'{spec}' gives {name} of shape {given.shape}; allowed: {allowed}")
    if not np.all(np.isfinite(times)):
        raise ValueError(f"'{spec}' gives times_s that are not finite")
    if quantity == "altitude" and np.any(np.isinf(values)):
        raise ValueError(f"'{spec}' gives an infinite altitude; allowed: metres, or NaN where there is none")
    lengths = np.linalg.norm(values, axis=-1) if quantity == "attitude" else np.ones(count)
    if not np.all(np.abs(lengths - 1.0) <= UNIT_TOLERANCE):
        raise ValueError(f"'{spec}' gives quaternions of length {lengths.tolist()}; allowed: 1")
    return InstrumentReadings(times, values, readings.columns)


def attitudes_of(readings: InstrumentReadings) -> Rotation:
    """Rotations from body to world axes."""
    return Rotation.from_quat(readings.values)
