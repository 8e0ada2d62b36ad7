"""Timeline of a case: ground, trajectories, cameras with images, points and measured values, over space and time.

A scenario adds a timeline to the products of a case by `timeline_products`, and only while timelines are recorded
(`marsyard.scenarios.timeline_recording`): for replayed cases and for the case that the report shows. `marsyard replay`
exports it (`marsyard.reports.timeline`). Positions are in the world frame (east, north, up), times
are seconds on the clock of the simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.timeline_recording import is_recording_timelines
from marsyard.sim.camera import Cahvor, Cahvore, CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.measurements import ImuIncrements

#: Key of the timeline among the products of a case.
PRODUCT = "timeline"


def timeline_products(create: Callable[[], Timeline], *, is_tested: bool = True) -> dict[str, Any]:
    """Return the timeline as a product; empty, without a call of `create`, unless timelines are recorded.

    - is_tested: whether the products are those of the algorithm under test; other products are not stored

    An exception of `create` does not affect the case: its text is stored instead of the timeline.
    """
    if not is_recording_timelines() or not is_tested:
        return {}
    try:
        return {PRODUCT: create().to_products()}
    except Exception as error:  # an unusual answer must not change the result of the case
        return {PRODUCT: f"{type(error).__name__}: {error}"}


@dataclass(frozen=True)
class SurfacePatch:
    """A surface on a grid of points, which may be irregular.

    - points_m: corner points of the grid's cells, seen from above as in an image: rows run southwards if columns run
      eastwards; NaN for missing points
    - colours: grey values or RGB of the points
    """

    points_m: Float32[np.ndarray, "rows columns 3"]
    colours: UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"]


@dataclass(frozen=True)
class Path:
    """Poses of a body over time; `quaternions_xyzw` rotate from body to world axes."""

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    quaternions_xyzw: Float64[np.ndarray, "n 4"]

    @classmethod
    def from_motion(cls, motion: Motion) -> Path:
        """Create the path of a true motion."""
        return cls(motion.times_s, motion.positions_m, motion.attitudes.as_quat())

    @classmethod
    def from_poses(cls, times_s: Sequence[float], poses: Sequence[RigidTransform]) -> Path:
        """Create the path through poses (world from body)."""
        positions = np.array([pose.translation for pose in poses], dtype=np.float64).reshape(-1, 3)
        quaternions = np.array([pose.rotation.as_quat() for pose in poses], dtype=np.float64).reshape(-1, 4)
        return cls(np.array(times_s, dtype=np.float64), positions, quaternions)


@dataclass(frozen=True)
class CameraPose:
    """A camera at the time of an image; its axes are x right, y down, z along the optical axis.

    - quaternion_xyzw: rotation from camera to world axes
    - focal_px, centre_px: focal lengths and image centre, (columns, rows); the centre of the upper left pixel is (0, 0)
    - distortion: O in camera axes and R of a CAHVOR camera (6 numbers), followed by E and the linearity of a CAHVORE
      camera (10 numbers); empty without distortion
    - corner_rays: unit directions of the image's outer corners in camera axes, clockwise from the upper left one
    """

    position_m: Float64[np.ndarray, "3"]
    quaternion_xyzw: Float64[np.ndarray, "4"]
    focal_px: Float64[np.ndarray, "2"]
    centre_px: Float64[np.ndarray, "2"]
    distortion: Float64[np.ndarray, "_"]
    corner_rays: Float64[np.ndarray, "4 3"]

    @classmethod
    def from_camera(cls, camera: CameraModel, world_from_body: RigidTransform) -> CameraPose:
        """Create the pose of a camera that is fixed to a body."""
        axes = np.column_stack([camera.right, camera.down, camera.a])
        rotation = world_from_body.rotation * Rotation.from_matrix(axes)
        _, corner_directions = camera.corner_rays()
        distortion = np.empty(0)
        if isinstance(camera, Cahvor | Cahvore):
            distortion = np.concatenate([axes.T @ camera.o, camera.r])
        if isinstance(camera, Cahvore):
            distortion = np.concatenate([distortion, camera.e, [camera.linearity]])
        return cls(
            np.asarray(world_from_body.apply(camera.c.copy())),
            rotation.as_quat(),
            np.array(camera.focal_lengths, dtype=np.float64),
            np.array(camera.image_centre, dtype=np.float64),
            distortion,
            corner_directions @ axes,
        )


@dataclass(frozen=True)
class TimedImage:
    """An image with the pose of its camera.

    - camera: name of the camera
    - bits: number of bits of the counts
    - marks: pixels (column, row) of points in the image, by name; NaN for points without a pixel
    - boxes: left, upper, width and height of rectangles, pixels, by name
    """

    camera: str
    time_s: float
    counts: UInt16[np.ndarray, "rows columns"]
    bits: int
    pose: CameraPose
    marks: Mapping[str, Float64[np.ndarray, "_ 2"]] = field(default_factory=dict)
    boxes: Mapping[str, Float64[np.ndarray, "_ 4"]] = field(default_factory=dict)


@dataclass(frozen=True)
class TimedPoints:
    """Points in the world, each at its time; NaN for points that exist at all times."""

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]

    @classmethod
    def permanent(cls, positions_m: Float64[np.ndarray, "*batch 3"]) -> TimedPoints:
        """Create points that exist at all times."""
        positions = np.asarray(positions_m, dtype=np.float64).reshape(-1, 3)
        return cls(np.full(len(positions), np.nan), positions)


@dataclass(frozen=True)
class Ellipsoids:
    """Estimated positions with their covariances (m^2) over time."""

    times_s: Float64[np.ndarray, "n"]
    centres_m: Float64[np.ndarray, "n 3"]
    covariances_m2: Float64[np.ndarray, "n 3 3"]


@dataclass(frozen=True)
class Series:
    """A scalar over time; the unit is part of its name."""

    times_s: Float64[np.ndarray, "n"]
    values: Float64[np.ndarray, "n"]


@dataclass(frozen=True)
class InertialData:
    """Measurements of an inertial unit, body axes: means over the intervals that end at the times."""

    times_s: Float64[np.ndarray, "n"]
    rates_rad_s: Float64[np.ndarray, "n 3"]
    specific_forces_m_s2: Float64[np.ndarray, "n 3"]

    @classmethod
    def from_increments(cls, increments: ImuIncrements, offset_s: float = 0.0) -> InertialData:
        """Divide increments by the nominal period; subtract an offset from their time tags."""
        return cls(
            np.asarray(increments.times_s[1:], dtype=np.float64) - offset_s,
            np.asarray(increments.delta_angles_rad / increments.period_s, dtype=np.float64),
            np.asarray(increments.delta_velocities_m_s / increments.period_s, dtype=np.float64),
        )


#: Type of each table of named parts of a timeline.
_TABLES: Mapping[str, type] = {
    "surfaces": SurfacePatch, "paths": Path, "points": TimedPoints, "ellipsoids": Ellipsoids, "series": Series
}  # fmt: skip


@dataclass(frozen=True)
class Timeline:
    """A case in space and time; each table contains its parts by name.

    The surface `ground` is the true ground, the path `true` the true motion of the body that carries the cameras.
    """

    surfaces: Mapping[str, SurfacePatch]
    paths: Mapping[str, Path]
    images: Sequence[TimedImage]
    points: Mapping[str, TimedPoints] = field(default_factory=dict)
    ellipsoids: Mapping[str, Ellipsoids] = field(default_factory=dict)
    series: Mapping[str, Series] = field(default_factory=dict)
    inertial: InertialData | None = None

    def to_products(self) -> dict[str, Any]:
        """Convert to tables, lists and arrays, as products of a case."""
        return asdict(self)

    @classmethod
    def from_products(cls, products: Mapping[str, Any]) -> Timeline | None:
        """Read the timeline of a case from its products; None without one, or for one of another version."""
        stored = products.get(PRODUCT)
        if not isinstance(stored, Mapping):
            return None
        try:
            tables = {
                name: {key: part(**values) for key, values in stored[name].items()} for name, part in _TABLES.items()
            }
            images = [TimedImage(**{**image, "pose": CameraPose(**image["pose"])}) for image in stored["images"]]
            inertial = None if stored["inertial"] is None else InertialData(**stored["inertial"])
        except (LookupError, TypeError, AttributeError):
            return None
        return cls(**tables, images=images, inertial=inertial)
