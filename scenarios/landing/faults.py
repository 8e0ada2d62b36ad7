"""What can go wrong in a flight: each fault by its size, all of them off by default.

A campaign of faults draws one a case: ``"faults" = { distribution = "choice", values = [{}, { dropout = 2 }, ...] }``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from jaxtyping import Float64, UInt16
from pydantic import BaseModel, ConfigDict, Field

from sim.sensor import DetectorParameters

Size = Annotated[float, Field(ge=0.0)]
Pictures = Sequence[UInt16[np.ndarray, "rows columns"]]


class Faults(BaseModel):
    """Faults of a flight. A size of 0 is no fault."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    black_picture: Annotated[int, Field(ge=0, le=2, description="picture that is delivered black, 1 or 2; 0: none")] = 0
    repeated_picture: Annotated[
        int, Field(ge=0, le=1, description="1: the first picture is delivered again in place of the second")
    ] = 0
    lost_rows: Annotated[
        Size, Field(le=1.0, description="share of the second picture's rows that is lost, from below")
    ] = 0.0
    laser_silent: Annotated[int, Field(ge=0, le=1, description="1: the altimeter gives no range")] = 0
    laser_stuck: Annotated[
        Size, Field(le=5.0, description="share by which a stuck altimeter's range is too long: it is from before")
    ] = 0.0
    gps_outage_s: Annotated[
        Size, Field(le=600.0, description="how long the receiver has been without fixes at the first picture, s")
    ] = 0.0
    bad_pixels: Annotated[
        Size, Field(le=0.5, description="share of pixels that are dead, and of those that are hot")
    ] = 0.0
    dust_discs: Annotated[int, Field(ge=0, le=1000, description="specks of dust on the lens")] = 0
    own_shadow_m: Annotated[Size, Field(le=100.0, description="diameter of the disc that casts the own shadow, m")] = (
        0.0
    )

    @property
    def name_and_size(self) -> tuple[str, float]:
        """The fault and its size; "none" and 0 without one, "several" and NaN where there are more."""
        present = [(name, float(size)) for name, size in self.model_dump().items() if size]
        if len(present) > 1:
            return "several", float("nan")
        return present[0] if present else ("none", 0.0)


def faulty_detector(faults: Faults, detector: DetectorParameters) -> DetectorParameters:
    """The detector with dust and bad pixels."""
    changes: dict[str, BaseModel] = {}
    if faults.dust_discs:
        changes["optics"] = detector.optics.model_copy(update={"dust_discs": faults.dust_discs})
    if faults.bad_pixels:
        bad = {"dead_share": faults.bad_pixels, "hot_share": faults.bad_pixels}
        changes["defects"] = detector.defects.model_copy(update=bad)
    return detector.model_copy(update=changes)


def delivered(faults: Faults, pictures: Pictures) -> list[UInt16[np.ndarray, "rows columns"]]:
    """The pictures as they arrive."""
    arrived = [one.copy() for one in pictures]
    if faults.repeated_picture:
        arrived[1] = arrived[0].copy()
    if faults.black_picture:
        arrived[faults.black_picture - 1][:] = 0
    lost = round(faults.lost_rows * len(arrived[1]))
    if lost:
        arrived[1][-lost:] = 0
    return arrived


def faulty_range(faults: Faults, range_m: float) -> float:
    """The altimeter's range, or what it gives instead."""
    return float("nan") if faults.laser_silent else range_m * (1.0 + faults.laser_stuck)


#: How an inertial unit of this class drifts without fixes: bias of its accelerometers, m/s2, as a tactical unit's.
OUTAGE_ACCELERATION_M_S2 = 0.01


def outage_errors(
    faults: Faults, interval_s: float, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """What an outage adds to the first pose's position and to the motion between the pictures, metres, drawn.

    A constant error of acceleration a makes a t^2 / 2 of position and a t of velocity.
    """
    acceleration = OUTAGE_ACCELERATION_M_S2 * rng.standard_normal(3)
    since = faults.gps_outage_s
    return 0.5 * since**2 * acceleration, since * interval_s * acceleration
