"""Faults of a landing flight: each fault by its size, all off by default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from jaxtyping import Float64, Int64

from marsyard.scenarios.faults import SizedFaults
from marsyard.scenarios.landing.helicopter import HelicopterParameters
from marsyard.sim.parameters import bounded
from marsyard.sim.sensor.satellite_navigation import Outage


class Faults(SizedFaults):
    """Faults of a flight; lost pictures and receiver outages need a helicopter flight."""

    black_picture: Annotated[int, bounded(0, 2, "number of the black picture, 1 or 2; 0: none")] = 0
    repeated_picture: Annotated[int, bounded(0, 1, "1: the second picture is the first again")] = 0
    lost_rows: Annotated[float, bounded(0.0, 1.0, "part of the second picture's rows lost, from below")] = 0.0
    lost_pictures: Annotated[float, bounded(0.0, 1.0, "part of the pictures; two always arrive")] = 0.0
    laser_silent: Annotated[int, bounded(0, 1, "1: the altimeter gives no range, to the ground")] = 0
    laser_stuck: Annotated[float, bounded(0.0, 5.0, "excess of the stuck range over the height, as a fraction")] = 0.0
    gps_outage_s: Annotated[float, bounded(0.0, 300.0, "silence before the first picture; it lasts to the end")] = 0.0
    listed_bad_pixels: Annotated[float, bounded(0.0, 0.5, "`bad_pixels` that the camera lists and fills")] = 0.0
    vehicle_shadow_m: Annotated[float, bounded(0.0, 100.0, "diameter of the shadow's disc; raises the sun")] = 0.0

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Bad pixels are filled where the camera has a list of them."""
        fraction = max(self.bad_pixels, self.listed_bad_pixels)
        listed = fraction == self.listed_bad_pixels
        defects = {"dead_fraction": fraction, "hot_fraction": fraction, "listed": listed} if fraction else {}
        return {**super().detector_changes(), "defects": defects}


def faulty_sun_deg(faults: Faults, elevation_deg: float) -> float:
    """The sun's elevation; with an own shadow its zenith distance is a quarter, so that the shadow is in the picture.

    A nadir camera sees the shadow only if the sun's zenith distance is below half of its angle of view.
    """
    return 90.0 - 0.25 * (90.0 - elevation_deg) if faults.vehicle_shadow_m else elevation_deg


def faulty_helicopter(faults: Faults, helicopter: HelicopterParameters) -> HelicopterParameters:
    """The helicopter with its receiver's outage: from before the first picture until after the landing.

    The hover before is longer by the outage, so that the filter starts with the receiver as in other flights.
    """
    if not faults.gps_outage_s:
        return helicopter
    transit, rtk = helicopter.transit, helicopter.rtk
    outage = Outage(start_s=-faults.gps_outage_s, duration_s=faults.gps_outage_s + helicopter.received_s[1])
    return helicopter.model_copy(
        update={
            "transit": transit.model_copy(update={"hover_s": transit.hover_s + faults.gps_outage_s}),
            "rtk": rtk.model_copy(update={"outages": (*rtk.outages, outage)}),
        }
    )


def arrived_numbers(faults: Faults, count: int, rng: np.random.Generator) -> Int64[np.ndarray, "n"]:
    """Sorted numbers of a flight's pictures that arrive, at least two."""
    kept = max(2, count - round(faults.lost_pictures * count))
    return np.sort(rng.permutation(count)[:kept]).astype(np.int64)


def faulty_ranges(faults: Faults, ranges_m: Float64[np.ndarray, "n"], height_m: float) -> Float64[np.ndarray, "n"]:
    """The altimeter's ranges, or the stuck or missing value in their place."""
    stuck = stuck_range_m(faults, height_m)
    if stuck is None:
        return ranges_m
    return np.full_like(ranges_m, np.nan if np.isinf(stuck) else stuck)


def stuck_range_m(faults: Faults, height_m: float) -> float | None:
    """The stuck range of the altimeter, infinite if it is silent; None if it works."""
    if faults.laser_silent:
        return float("inf")
    return height_m * (1.0 + faults.laser_stuck) if faults.laser_stuck else None
