"""Frames of camera models in PDS labels, and the transforms between them that a label contains.

A label names the frame of a camera model: the vehicle (rover or lander), the site (x north, y east, z down), the local
level frame (origin of the vehicle, axes of the site) or the Mars-fixed frame MCMF (origin in the centre of Mars, x on
the prime meridian, z north). Definitions of coordinate systems in the label connect frames. A frame has indices such as
site and drive; frames of different sites or drives are different frames.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.file_reading import Source
from marsyard.sim.frames import compose, rigid

SITE, LOCAL_LEVEL, MARS_FIXED = "SITE", "LOCAL_LEVEL", "MCMF"
#: Names of a vehicle's frame; that of the mechanical rover frame has another origin, so it is not one of them.
_VEHICLES = {"ROVER": "ROVER", "ROVER_NAV": "ROVER", "LANDER": "LANDER"}
_NAMES = _VEHICLES | {
    "SITE": SITE,
    "LOCAL_LEVEL": LOCAL_LEVEL,
    "MCMF": MARS_FIXED,
    "MARS_FIXED": MARS_FIXED,
    "IAU_MARS": MARS_FIXED,
}
#: Number of leading indices that identify a frame: the site, and the drive for frames that move with the vehicle.
_INDICES = {SITE: 1, MARS_FIXED: 0}
_ALLOWED = "ROVER, SITE, LOCAL_LEVEL or MCMF frames, or a label with the transform from this frame to one of them"
#: Tolerance on the length of a quaternion.
_QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class LabelFrame:
    """A frame of reference: normalised name (`SITE` for SITE_FRAME), and its indices (site, drive); () if unknown."""

    name: str
    indices: tuple[int, ...] = ()

    @classmethod
    def of(cls, name: str, indices: Sequence[int] = ()) -> LabelFrame:
        """Create the frame from the name and all indices in a label."""
        words = re.sub(r"[\s_-]+", "_", name.strip().upper()).removesuffix("_FRAME")
        words = _NAMES.get(words, words)
        return cls(words, tuple(indices)[: _INDICES.get(words, 2)])

    @property
    def is_vehicle(self) -> bool:
        """Whether the frame is that of a rover or lander."""
        return self.name in _VEHICLES.values()

    def matches(self, other: LabelFrame) -> bool:
        """Return whether both frames can be equal: names, and the indices that both contain."""
        common = min(len(self.indices), len(other.indices))
        return self.name == other.name and self.indices[:common] == other.indices[:common]

    def __str__(self) -> str:
        return f"{self.name}_FRAME" + (f" {self.indices}" if self.indices else "")


#: Frame of camera models whose label does not name one, and of files in other formats.
ROVER_FRAME = LabelFrame("ROVER")


@dataclass(frozen=True)
class CoordinateSystem:
    """Definition of a frame in a label: ``reference_from_frame.apply(points_frame)`` gives points in `reference`."""

    frame: LabelFrame
    reference: LabelFrame
    reference_from_frame: RigidTransform


@dataclass(frozen=True)
class FramedCamera:
    """A camera model and the frame of its vectors: a vehicle's, a site's, or the Mars-fixed frame."""

    camera: CameraModel
    frame: LabelFrame


def transform_from_label(
    offset: Sequence[float], quaternion_wxyz: Sequence[float], field: str, source: Source
) -> RigidTransform:
    """Create the transform of a definition from offset (m) and quaternion. Raises CameraFileError if one is invalid."""
    quaternion = np.array(quaternion_wxyz, dtype=np.float64)
    if not np.all(np.isfinite(offset)):
        raise source.error(field, f"the origin is {list(offset)}", "finite numbers")
    if not abs(float(np.linalg.norm(quaternion)) - 1.0) <= _QUATERNION_TOLERANCE:
        raise source.error(field, "is not of length 1", "a unit quaternion")
    # the label's quaternion is (w, x, y, z), SciPy's is (x, y, z, w)
    return rigid(Rotation.from_quat(quaternion[[1, 2, 3, 0]]), np.array(offset, dtype=np.float64))


def resolve_camera(
    camera: CameraModel, frame: LabelFrame, systems: Sequence[CoordinateSystem], field: str, source: Source
) -> FramedCamera:
    """Transform a label's camera to the vehicle's frame or, without that transform, to a site's or the Mars-fixed one.

    Raises CameraFileError if the label does not connect the camera's frame to one of these.
    """
    paths = _transforms_from(frame, systems)
    for is_target in (lambda target: target.is_vehicle, lambda target: target.name in (SITE, MARS_FIXED)):
        for target, target_from_frame in paths:
            if is_target(target):
                moved = camera if target_from_frame is None else camera.transform(target_from_frame)
                return FramedCamera(moved, target)
    raise source.error(field, f"{frame} has no known transform to the rover", _ALLOWED)


def find_pose(vehicle: LabelFrame, systems: Sequence[CoordinateSystem]) -> tuple[LabelFrame, RigidTransform] | None:
    """Find the vehicle's pose in a site's frame or else in the Mars-fixed frame; None if the label has none."""
    paths = _transforms_from(vehicle, systems)
    for name in (SITE, MARS_FIXED):
        for target, target_from_vehicle in paths:
            if target.name == name and target_from_vehicle is not None:
                return target, target_from_vehicle
    return None


def _transforms_from(
    start: LabelFrame, systems: Sequence[CoordinateSystem]
) -> list[tuple[LabelFrame, RigidTransform | None]]:
    """Return all frames connected to `start`, nearest first, with the transforms from it; None is the identity."""
    edges = [(system.frame, system.reference, system.reference_from_frame) for system in systems]
    edges += _implied_edges(systems)
    edges += [(target, source, transform.inv()) for source, target, transform in edges]
    paths: list[tuple[LabelFrame, RigidTransform | None]] = [(start, None)]
    for frame, frame_from_start in paths:  # grows while it is read: breadth first
        for source, target, target_from_source in edges:
            if frame.matches(source) and not any(known.matches(target) for known, _ in paths):
                step = target_from_source if frame_from_start is None else compose(target_from_source, frame_from_start)
                paths.append((target, step))
    return paths


def _implied_edges(systems: Sequence[CoordinateSystem]) -> list[tuple[LabelFrame, LabelFrame, RigidTransform]]:
    """Return the transforms from vehicles to the local level frame, which is defined by the vehicle's pose in a site.

    Its origin is the vehicle's and its axes are the site's. A definition in the label has priority.
    """
    if any(LOCAL_LEVEL in (system.frame.name, system.reference.name) for system in systems):
        return []
    return [
        (
            system.frame,
            LabelFrame(LOCAL_LEVEL, system.frame.indices),
            rigid(system.reference_from_frame.rotation, np.zeros(3)),
        )
        for system in systems
        if system.frame.is_vehicle and system.reference.name == SITE
    ]
