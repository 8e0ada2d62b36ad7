"""Faults of a case, by name and size: their columns, and their injection into the detector and the images.

The parameters of each scenario derive a table of their own from `SizedFaults`, with the faults of its images and
instruments.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from jaxtyping import UInt16
from pydantic import Field

from marsyard.scenarios.interface import Scalar
from marsyard.sim.error_sources import DETECTOR, OPTICS
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor import DetectorParameters

#: Path length for which the fault `haze` states an optical depth, m: about the height of the first image.
HAZE_PATH_M = 2000.0
Haze = Annotated[NonNegative, Field(le=10.0, description=f"optical depth of dusty air over {HAZE_PATH_M:g} m")]
#: Detector counts of the images of a case, in their order.
Images = Sequence[UInt16[np.ndarray, "rows columns"]]


class SizedFaults(Parameters):
    """Sizes of the faults by name; size 0 means no fault."""

    dust_discs: Annotated[
        int, OPTICS, Field(ge=0, le=1000, description="number of specks of dust on the camera window")
    ] = 0
    bad_pixels: Annotated[
        NonNegative,
        DETECTOR,
        Field(
            le=0.5,
            description="fraction of dead pixels, and fraction of hot pixels; in the cold MER cameras in effect dead "
            "pixels alone (hot ones add 6 to 13 of 4096 counts in the mean)",
        ),
    ] = 0.0

    @property
    def columns(self) -> dict[str, Scalar]:
        """The fault and its size; "none" and 0 without a fault, "several" and NaN with more than one fault.

        `fault_free` marks the cases without a fault, in which an algorithm must answer.
        """
        faults = [(name, float(size)) for name, size in self.model_dump().items() if size] or [("none", 0.0)]
        name, size = faults[0] if len(faults) == 1 else ("several", float("nan"))
        return {"fault": name, "fault_size": size, "fault_free": name == "none"}

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Return the changed parameters of the detector by table; an empty table changes nothing."""
        return {
            "optics": {"dust_discs": self.dust_discs} if self.dust_discs else {},
            "defects": {"dead_fraction": self.bad_pixels, "hot_fraction": self.bad_pixels} if self.bad_pixels else {},
        }


def add_detector_faults(faults: SizedFaults, detector: DetectorParameters) -> DetectorParameters:
    """Return a detector with the faults."""
    changes = {
        table: getattr(detector, table).model_copy(update=dict(values))
        for table, values in faults.detector_changes().items()
        if values
    }
    return detector.model_copy(update=changes)


def corrupt_images(
    images: Images, *, repeated: int, black: int, incomplete: int = 0, lost_rows: float = 0.0
) -> list[np.ndarray]:
    """Return images with transmission faults.

    - repeated: number, from 2, of the image that is replaced by the previous image; 0: none
    - black: number, from 1, of the image that is replaced by a black image; 0: none
    - incomplete: number, from 1, of the image that loses rows; 0: none
    - lost_rows: fraction of the rows of the incomplete image that is lost, from the bottom

    Raises ValueError for another number.
    """
    for name, number, first in (("repeated", repeated, 2), ("black", black, 1), ("incomplete", incomplete, 1)):
        if number and not first <= number <= len(images):
            raise ValueError(f"{name} is image {number}; allowed: {first} to {len(images)}, or 0 for none")
    copies = [image.copy() for image in images]
    if repeated:
        copies[repeated - 1] = copies[repeated - 2].copy()
    if black:
        copies[black - 1][:] = 0
    if incomplete:
        image = copies[incomplete - 1]
        image[len(image) - round(lost_rows * len(image)) :] = 0
    return copies
