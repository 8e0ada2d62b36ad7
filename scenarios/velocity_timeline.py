"""Timeline of a case of velocity estimation: paths, images with the tracks of DIMES, altitude, speed and attitude."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.dimes import DimesDetails
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.scenarios.timeline import (
    CameraPose,
    InertialData,
    Path,
    Series,
    SurfacePatch,
    TimedImage,
    TimedPoints,
    Timeline,
)
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion, State
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.terrain import Surface

#: Time between the poses of a path, s.
STEP_S = 0.1
#: Steps of the intersection of a ray with the ground; each reduces the error by a factor of at least two.
_INTERSECTION_STEPS = 20
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class VelocityCase:
    """The truth and the images of a case of velocity estimation.

    - patch: the ground, as seen from above
    - surface: the ground below rocks
    - motion: true motion at equal time steps, from the first image to the end of the case
    - states, images: true states at the images, and the delivered images
    - camera: true camera of the delivered images in body axes
    - mounting: rotation of the camera in the body
    - triple: indices of the images that DIMES received; None if there are too few
    - increments: measured inertial increments; None without an inertial unit of the vision system
    """

    patch: SurfacePatch
    surface: Surface
    motion: Motion
    states: Sequence[State]
    images: Sequence[UInt16[np.ndarray, "rows columns"]]
    bits: int
    camera: CameraModel
    mounting: RigidTransform
    triple: tuple[int, int, int] | None = (0, 1, 2)
    increments: ImuIncrements | None = None

    def timeline(self, estimate: VelocityEstimate | None, start: State | None) -> Timeline:
        """Create the timeline with an estimate.

        start: true state at the start of the estimate's time span; None for no estimated path
        """
        motion = self.motion
        paths = {"true": Path.from_motion(motion)}
        if estimate is not None and estimate.velocity_m_s is not None and start is not None:
            paths["estimated"] = self._estimated_path(estimate.velocity_m_s, start)
        details = estimate.details if estimate is not None and isinstance(estimate.details, DimesDetails) else None
        up = motion.attitudes.inv().apply(_UP)
        series = {
            "altitude, m": motion.positions_m[:, 2] - self.surface.height(*motion.positions_m.T[:2]),
            "horizontal speed, m/s": np.hypot(*motion.velocities_m_s.T[:2]),
            "descent rate, m/s": -motion.velocities_m_s[:, 2],
            "off nadir, deg": np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0))),
            "attitude rate, deg/s": np.degrees(np.linalg.norm(motion.body_rates_rad_s, axis=1)),
        }
        return Timeline(
            surfaces={"ground": self.patch},
            paths=paths,
            images=self._images(details),
            points={} if details is None else self._track_points(details),
            series={name: Series(motion.times_s, np.asarray(values)) for name, values in series.items()},
            inertial=None if self.increments is None else InertialData.from_increments(self.increments),
        )

    def _estimated_path(self, velocity_m_s: Float64[np.ndarray, "2"], start: State) -> Path:
        """Return the path with the estimated horizontal velocity from a true state on; height and attitude are true."""
        later = self.motion.times_s >= start.time_s
        times = self.motion.times_s[later]
        positions = self.motion.positions_m[later].copy()
        positions[:, :2] = start.position_m[:2] + np.outer(times - start.time_s, velocity_m_s)
        return Path(times, positions, self.motion.attitudes[later].as_quat())

    def _images(self, details: DimesDetails | None) -> list[TimedImage]:
        images = []
        for number, (state, counts) in enumerate(zip(self.states, self.images, strict=True)):
            marks = {} if details is None else self._marks(details, number)
            pose = CameraPose.from_camera(self.camera, state.world_from_body * self.mounting)
            images.append(TimedImage("descent camera", state.time_s, counts, self.bits, pose, marks))
        return images

    def _marks(self, details: DimesDetails, number: int) -> dict[str, Float64[np.ndarray, "_ 2"]]:
        """Return the pixels of templates and matches in an image; those of DIMES are in binned images."""
        triple = self.triple or ()  # without a triple, DIMES has no tracks
        marks: dict[str, list[Float64[np.ndarray, "2"]]] = {"templates": [], "matches": [], "rejected": []}
        for track in details.tracks:
            for image, pixel, name in (
                (triple[track.pair], track.template_pixel, "templates"),
                (triple[track.pair + 1], track.match_pixel, "matches"),
            ):
                if image == number:
                    marks[name if track.valid else "rejected"].append(self._image_pixel(details, track.pair, pixel))
        return {name: np.array(pixels).reshape(-1, 2) for name, pixels in marks.items()}

    def _track_points(self, details: DimesDetails) -> dict[str, TimedPoints]:
        """Return the points of the ground that the templates show, at the times of their images."""
        points = {}
        for is_valid, name in ((True, "valid templates"), (False, "rejected templates")):
            tracks = [track for track in details.tracks if track.valid == is_valid]
            states = [self.states[(self.triple or ())[track.pair]] for track in tracks]
            pixels = [self._image_pixel(details, track.pair, track.template_pixel) for track in tracks]
            positions = np.array([*map(self._ground_point, states, pixels)]).reshape(-1, 3)
            points[name] = TimedPoints(np.array([state.time_s for state in states], dtype=np.float64), positions)
        return points

    def _image_pixel(self, details: DimesDetails, pair: int, pixel: ArrayLike) -> Float64[np.ndarray, "2"]:
        """Convert a pixel of the binned images of DIMES to the delivered images."""
        scale = np.array(self.images[0].shape[::-1]) / np.array(details.pairs[pair].views[0].size)
        return np.asarray((np.asarray(pixel) + 0.5) * scale - 0.5)

    def _ground_point(self, state: State, pixel: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "3"]:
        """Intersect the true ray of a pixel with the ground, whose slopes are less steep than the ray."""
        pose, (origin, direction) = state.world_from_body * self.mounting, self.camera.rays(pixel)
        point, ray = pose.apply(np.array(origin)), pose.rotation.apply(direction)
        for _ in range(_INTERSECTION_STEPS):
            point = point + ray * (float(self.surface.height(*point[:2])) - point[2]) / ray[2]
        return np.asarray(point)
