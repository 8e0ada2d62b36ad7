"""Instruments of localisation: radar altimeter, clock of the images, and limits of the time tags' errors."""

import numpy as np

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.measurements import AltitudeMeasurement
from marsyard.sim.sensor import ClockParameters, RadarAltimeter, RadarParameters

#: Margin of the inertial increments before the first and after the last time tag of the other clocks, s: the time tags
#: of the inertial unit have an offset of 0.2 ms rms.
INERTIAL_MARGIN_S = 0.05
#: Radar altimeter: errors of the MER altimeter; a beam of 40 deg includes nadir at tilts up to 20 deg (assumed).
RADAR = RadarParameters(rate_hz=2.0, beam_deg=40.0, max_range_m=8000.0)

#: Largest error of a time tag of images and altitudes, s (assumed): the interval of the images of Mars 2020, taken at
#: up to 1 Hz. With a larger error an image has the time of another one.
MAX_TAG_ERROR_S = 1.0
#: Largest error in standard deviations: 6e-7 of the tags have a larger one.
_TAG_SIGMAS = 5.0

#: Clock of the image time tags, relative to the true time; that of the inertial unit is in `ImuParameters` (assumed).
IMAGE_CLOCK = ClockParameters(offset_sd_s=0.001, jitter_sd_s=0.0005)


def check_clock(name: str, clock: ClockParameters) -> None:
    """Check that the errors of a clock stay below `MAX_TAG_ERROR_S`. Raises ValueError with the key `name`."""
    largest_s = abs(clock.offset_s) + _TAG_SIGMAS * float(np.hypot(clock.offset_sd_s, clock.jitter_sd_s))
    if largest_s > MAX_TAG_ERROR_S:
        raise ValueError(
            f"time tags of {name} are wrong by up to {largest_s:.6g} s (|offset_s| and {_TAG_SIGMAS:.0f} standard "
            f"deviations); allowed: up to {MAX_TAG_ERROR_S:.6g} s"
        )


def measure_altitudes(
    radar: RadarAltimeter, flight: Trajectory, span_s: tuple[float, float], rng: np.random.Generator
) -> list[AltitudeMeasurement]:
    """Measure the altitude at all samples of the radar in a span of true times; missing readings are omitted.

    The altitude is the range to the nearest ground in the radar's beam.
    """
    readings = radar.measure(flight, radar.sampling.within(*span_s), rng)
    return [
        AltitudeMeasurement(float(value), float(tag))
        for value, tag in zip(readings.values, readings.times_s, strict=True)
        if np.isfinite(value)
    ]
