"""Faults of the landing scenario."""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from jaxtyping import Float64, Int64

from marsyard.scenarios.case_faults import SizedFaults
from marsyard.scenarios.landing.helicopter import LandingHelicopterParameters
from marsyard.sim.error_sources import DETECTOR
from marsyard.sim.parameters import bounded_field
from marsyard.sim.sensor.rtk import Outage


class LandingFaults(SizedFaults):
    """Faults of a landing case; lost images and receiver outages need a helicopter flight."""

    black_image: Annotated[int, bounded_field(0, 2, "number of the black image, 1 or 2; 0: none")] = 0
    repeated_image: Annotated[int, bounded_field(0, 1, "1: the second image is a copy of the first")] = 0
    lost_rows: Annotated[
        float, bounded_field(0.0, 1.0, "fraction of the rows of image 2 that is lost, from the bottom")
    ] = 0.0
    lost_images: Annotated[float, bounded_field(0.0, 1.0, "fraction of images lost; two always arrive")] = 0.0
    laser_silent: Annotated[
        int, bounded_field(0, 1, "1: the altimeter returns no range, at the images and in the landing")
    ] = 0
    laser_stuck: Annotated[float, bounded_field(0.0, 5.0, "relative excess of the stuck range; 0: no fault")] = 0.0
    gps_outage_s: Annotated[
        float, bounded_field(0.0, 300.0, "duration of the GPS outage before image 1; it lasts to the end")
    ] = 0.0
    listed_bad_pixels: Annotated[
        float,
        DETECTOR,
        bounded_field(0.0, 0.5, "fraction of bad pixels in the camera's list, which it fills by interpolation"),
    ] = 0.0
    vehicle_shadow_m: Annotated[
        float, bounded_field(0.0, 100.0, "diameter of the disc that casts the vehicle's shadow; also raises the sun")
    ] = 0.0

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Return the detector parameters that the faults change.

        The larger of the fractions of listed and unlisted bad pixels is used; the camera fills listed ones.
        """
        fraction = max(self.bad_pixels, self.listed_bad_pixels)
        is_listed = fraction == self.listed_bad_pixels
        defects = {"dead_fraction": fraction, "hot_fraction": fraction, "listed": is_listed} if fraction else {}
        return {**super().detector_changes(), "defects": defects}


def sun_elevation_with_shadow_deg(faults: LandingFaults, elevation_deg: float) -> float:
    """Return the sun's elevation; the vehicle shadow fault reduces its zenith distance to a quarter.

    A nadir camera sees the vehicle's shadow only if the sun's zenith distance is below half its field of view.
    """
    return 90.0 - 0.25 * (90.0 - elevation_deg) if faults.vehicle_shadow_m else elevation_deg


def add_receiver_outage(faults: LandingFaults, helicopter: LandingHelicopterParameters) -> LandingHelicopterParameters:
    """Add the outage of the GPS receiver, from before the first image until after the landing.

    The outage extends the initial hover, so that the filter is initialized with the receiver as in other flights.
    """
    if not faults.gps_outage_s:
        return helicopter
    transit, rtk = helicopter.transit, helicopter.rtk
    outage = Outage(start_s=-faults.gps_outage_s, duration_s=faults.gps_outage_s + helicopter.receiver_span_s[1])
    return helicopter.model_copy(
        update={
            "transit": transit.model_copy(update={"hover_s": transit.hover_s + faults.gps_outage_s}),
            "rtk": rtk.model_copy(update={"outages": (*rtk.outages, outage)}),
        }
    )


def draw_received_images(faults: LandingFaults, count: int, rng: np.random.Generator) -> Int64[np.ndarray, "n"]:
    """Draw the images of a flight that arrive, at least two; return their sorted indices."""
    received_count = max(2, count - round(faults.lost_images * count))
    return np.sort(rng.permutation(count)[:received_count]).astype(np.int64)


def add_range_faults(
    faults: LandingFaults, ranges_m: Float64[np.ndarray, "n"], height_m: float
) -> Float64[np.ndarray, "n"]:
    """Replace the altimeter's ranges by the stuck range, or by NaN, if the altimeter has a fault."""
    stuck_m = stuck_range_m(faults, height_m)
    if stuck_m is None:
        return ranges_m
    return np.full_like(ranges_m, np.nan if np.isinf(stuck_m) else stuck_m)


def stuck_range_m(faults: LandingFaults, height_m: float) -> float | None:
    """Return the stuck range of the altimeter: infinite if it returns no range, None if it has no fault."""
    if faults.laser_silent:
        return float("inf")
    return height_m * (1.0 + faults.laser_stuck) if faults.laser_stuck else None
