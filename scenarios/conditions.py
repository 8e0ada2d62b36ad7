"""Columns of a case: conditions, provenance of the pictures, and the faults that a case may have."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated

import numpy as np
from jaxtyping import Float64, UInt16
from pydantic import Field

from marsyard.scenarios.interface import Scalar
from marsyard.sim.dynamics import State
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


def off_nadir_deg(state: State) -> float:
    """Return the angle between the body's camera axis and nadir."""
    return float(np.degrees(np.arccos(np.clip(state.attitude.as_matrix()[2, 2], -1.0, 1.0))))


def attitude_rate_deg_s(state: State) -> float:
    """Return the magnitude of the body rate."""
    return float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))


def hash_images(pictures: Iterable[UInt16[np.ndarray, "rows columns"]]) -> str:
    """Compute the SHA-256 of the counts of pictures."""
    return hashlib.sha256(b"".join(counts.tobytes() for counts in pictures)).hexdigest()


def picture_columns(backend: Backend, image_hash: str) -> dict[str, Scalar]:
    """Return the columns of pictures with this hash that a backend rendered."""
    return {
        "image_hash": image_hash,
        "gl_backend": backend,
        "gl_version": process_renderer(backend).description(),
        "processor_features": processor_features(),
    }


Pictures = Sequence[UInt16[np.ndarray, "rows columns"]]


class SizedFaults(Parameters):
    """Sizes of the faults by name; a size of 0 is no fault."""

    dust_discs: Annotated[int, Field(ge=0, le=1000, description="specks of dust on the lens")] = 0
    bad_pixels: Annotated[
        NonNegative, Field(le=0.5, description="share of pixels that are dead, and of those that are hot")
    ] = 0.0

    @property
    def columns(self) -> dict[str, Scalar]:
        """The fault and its size; "none" and 0 without a fault, "several" and NaN with more than one."""
        present = [(name, float(size)) for name, size in self.model_dump().items() if size] or [("none", 0.0)]
        name, size = present[0] if len(present) == 1 else ("several", float("nan"))
        return {"fault": name, "fault_size": size}

    def detector_changes(self) -> dict[str, Mapping[str, float | bool]]:
        """Return the changed parameters of the detector by its tables; empty tables change nothing."""
        return {
            "optics": {"dust_discs": self.dust_discs} if self.dust_discs else {},
            "defects": {"dead_fraction": self.bad_pixels, "hot_fraction": self.bad_pixels} if self.bad_pixels else {},
        }


def faulty_detector(faults: SizedFaults, detector: DetectorParameters) -> DetectorParameters:
    """Apply the faults to a detector."""
    changes = {
        table: getattr(detector, table).model_copy(update=dict(changed))
        for table, changed in faults.detector_changes().items()
        if changed
    }
    return detector.model_copy(update=changes)


def deliver(pictures: Pictures, repeated: int, black: int, lost_rows: float = 0.0) -> list[np.ndarray]:
    """Apply transmission faults to the pictures.

    - repeated: number, from 1, of the picture that is replaced by the one before it; 0: none
    - black: number of the picture that is delivered black; 0: none
    - lost_rows: fraction of the second picture's rows that is lost, from below
    """
    delivered = [one.copy() for one in pictures]
    if repeated > 1:
        delivered[repeated - 1] = delivered[repeated - 2].copy()
    if black:
        delivered[black - 1][:] = 0
    lost = round(lost_rows * len(delivered[1])) if lost_rows else 0
    if lost:
        delivered[1][-lost:] = 0
    return delivered
