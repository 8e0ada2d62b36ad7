"""Columns common to several scenarios (conditions, provenance of the images, faults), and injection of faults."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated

import numpy as np
from jaxtyping import Float64, UInt16
from pydantic import Field

from marsyard.scenarios.interface import Scalar
from marsyard.sim.dynamics import State
from marsyard.sim.error_sources import DETECTOR, OPTICS
from marsyard.sim.image_statistics import local_contrast
from marsyard.sim.kernel_cache import processor_features
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.sensor import DetectorParameters


def sun_columns(direction: Float64[np.ndarray, "3"]) -> dict[str, Scalar]:
    """Return the sun's azimuth, clockwise from north, and elevation from its direction in world axes."""
    return {
        "sun_azimuth_deg": float(np.degrees(np.arctan2(direction[0], direction[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(np.clip(direction[2], -1.0, 1.0)))),
    }


def contrast_columns(image: UInt16[np.ndarray, "rows columns"], detector: DetectorParameters) -> dict[str, Scalar]:
    """Return the median of a delivered image's local contrast, and its 90 % quantile divided by its 10 % quantile.

    `local_contrast` defines the contrast; the quotient is NaN if the 10 % quantile is 0.
    """
    p10, median, p90 = local_contrast(np.maximum(image - detector.offset_dn, 0.0))
    return {"image_contrast": median, "image_patchiness": p90 / p10 if p10 > 0.0 else np.nan}


def off_nadir_deg(state: State) -> float:
    """Return the angle between the body's camera axis and nadir."""
    # the camera looks along -z of the body; the element is the cosine of the angle between the z axes of body and world
    return float(np.degrees(np.arccos(np.clip(state.attitude.as_matrix()[2, 2], -1.0, 1.0))))


def attitude_rate_deg_s(state: State) -> float:
    """Return the magnitude of the body rate."""
    return float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))


def hash_images(images: Iterable[UInt16[np.ndarray, "rows columns"]]) -> str:
    """Compute the SHA-256 of the counts of images."""
    return hashlib.sha256(b"".join(counts.tobytes() for counts in images)).hexdigest()


def image_columns(backend: Backend, image_hash: str) -> dict[str, Scalar]:
    """Return the provenance columns of images rendered by a backend."""
    return {
        "image_hash": image_hash,
        "gl_backend": backend,
        "gl_version": process_renderer(backend).description(),
        "processor_features": processor_features(),
    }


Images = Sequence[UInt16[np.ndarray, "rows columns"]]


class SizedFaults(Parameters):
    """Sizes of the faults by name; size 0 means no fault."""

    dust_discs: Annotated[
        int, OPTICS, Field(ge=0, le=1000, description="number of specks of dust on the camera window")
    ] = 0
    bad_pixels: Annotated[
        NonNegative, DETECTOR, Field(le=0.5, description="fraction of dead pixels, and fraction of hot pixels")
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


def corrupt_images(images: Images, repeated: int, black: int, lost_rows: float = 0.0) -> list[np.ndarray]:
    """Return images with transmission faults.

    - repeated: number, from 1, of the image that is replaced by the previous image; 0: none
    - black: number, from 1, of the image that is replaced by a black image; 0: none
    - lost_rows: fraction of the second image's rows that is lost, counted from the bottom
    """
    copies = [image.copy() for image in images]
    if repeated > 1:
        copies[repeated - 1] = copies[repeated - 2].copy()
    if black:
        copies[black - 1][:] = 0
    n_lost_rows = round(lost_rows * len(copies[1])) if lost_rows else 0
    if n_lost_rows:
        copies[1][-n_lost_rows:] = 0
    return copies
