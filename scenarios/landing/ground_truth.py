"""Ground truth of a landing case: relief, and slope and roughness of the footprints on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.images import Pair
from marsyard.scenarios.landing.relief import SPACING_DIAMETERS, Footprints, Limits, Relief
from marsyard.scenarios.landing.world import LandingWorld

#: Spacing of the ground-truth grid divided by the diameter of a footprint: 0.2 m for a footprint of 2 m.
STEP_DIAMETERS = 0.1
#: Width of the margin of relief around the visible ground, in footprint diameters: touchdowns can lie outside it.
MARGIN_DIAMETERS = 1.5
#: True safety of the footprint around a pixel's ground point: safe, unsafe, or partly outside of an image.
SAFE, UNSAFE, UNKNOWN = 0, 1, 255
#: Minimum clearance of a position far from hazards, as a fraction of the largest clearance.
MIN_CLEARANCE_FRACTION = 0.5


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of a flight on a grid aligned with the horizontal axes of the first image."""

    relief: Relief
    limits: Limits
    positions: Float[np.ndarray, "rows columns 2"]  #: world x, y of the grid points
    footprints: Footprints  #: slope and roughness under a lander at each position
    covered: Bool[np.ndarray, "rows columns"]  #: whether both images show the whole footprint
    step_m: float

    @classmethod
    def from_images(cls, world: LandingWorld, flight: LandingFlight, pair: Pair, limits: Limits) -> GroundTruth:
        """Compute the ground truth of the area in the first image."""
        centre = flight.states[0].position_m
        # rows: unit vectors of the image's right and up directions on the ground
        right = flight.states[0].attitude.apply(np.array([1.0, 0.0, 0.0]))[:2]
        right = right / np.hypot(*right)
        axes = np.array([right, [-right[1], right[0]]])
        # outline of the ground in the image; every eighth pixel suffices
        ground_points = pair.frames[0].points_world(np.s_[::8, ::8])[..., :2].reshape(-1, 2)
        hull = cv2.convexHull(ground_points[np.all(np.isfinite(ground_points), axis=1)].astype(np.float32))
        outline = (hull[:, 0].astype(np.float64) - centre[:2]) @ axes.T
        step = STEP_DIAMETERS * limits.diameter_m
        low, high = (np.floor(limit / step) * step for limit in (outline.min(axis=0), outline.max(axis=0)))
        x, y = (np.arange(first, last + 0.5 * step, step) for first, last in zip(low, high, strict=True))
        local = np.stack(np.meshgrid(x, y), axis=-1)
        positions = np.asarray(centre[:2] + local @ axes)
        margin = MARGIN_DIAMETERS * limits.diameter_m
        flat_positions = positions.reshape(-1, 2)
        west_south, east_north = flat_positions.min(axis=0) - margin, flat_positions.max(axis=0) + margin
        spacing = SPACING_DIAMETERS * limits.diameter_m
        relief = Relief.from_ground(world.ground, west_south, east_north, spacing, world.meshes)
        heights = relief.average(positions, relief.spacing_m)
        # grid points on the ground; `visible`: whether both images show them
        points = np.concatenate([flat_positions, heights.reshape(-1, 1)], axis=1)
        visible = np.ones(len(points), dtype=bool)
        for image, state in zip(pair.images, flight.states, strict=True):
            pixels, in_front = image.camera.transform(state.world_from_body).project(points)
            with np.errstate(invalid="ignore"):
                visible &= in_front & np.all((pixels >= 0.0) & (pixels <= np.array(image.camera.size) - 1.0), axis=1)
        distance_to_invisible_m = distance_transform_edt(np.pad(visible.reshape(heights.shape), 1))[1:-1, 1:-1] * step
        # invisible ground can be nearer than the nearest grid point on it, by up to half the diagonal of a grid cell
        covered = distance_to_invisible_m >= 0.5 * limits.diameter_m + step / np.sqrt(2.0)
        return cls(relief, limits, positions, relief.footprints(positions, limits), covered, step)

    @property
    def safe(self) -> Bool[np.ndarray, "rows columns"]:
        """Safe positions whose whole footprint is in both images."""
        return np.asarray(self.covered & self.footprints.safe)

    @property
    def clearance_m(self) -> Float[np.ndarray, "rows columns"]:
        """Distance of each position from the nearest one that is not safe or whose footprint is not in both images.

        Positions that the images do not show count as hazards (paper, section III: borders "are considered hazards").
        """
        return np.asarray(distance_transform_edt(np.pad(self.safe, 1))[1:-1, 1:-1] * self.step_m)

    @property
    def safe_with_margin(self) -> Bool[np.ndarray, "rows columns"]:
        """Positions around which all positions within one footprint radius are also safe."""
        return np.asarray(self.clearance_m > 0.5 * self.limits.diameter_m)

    @property
    def visible_hazards(self) -> Bool[np.ndarray, "rows columns"]:
        """Unsafe positions whose whole footprint is in both images."""
        return np.asarray(self.covered & ~self.footprints.safe)

    def clearance_fraction(self, position: Float[np.ndarray, "2"]) -> float:
        """Divide the clearance at a position (x, y) by the largest one; 0 outside of the grid or if none is safe.

        The site of the paper's rule, on an exact map, has the fraction 1.
        """
        clearance_m = self.clearance_m.ravel()
        distances_m = np.hypot(*(self.positions.reshape(-1, 2) - position).T)
        nearest = int(np.argmin(distances_m))
        is_outside = distances_m[nearest] > self.step_m
        largest_m = float(clearance_m.max())
        return 0.0 if is_outside or largest_m == 0.0 else float(clearance_m[nearest]) / largest_m

    def has_hazard_near(self, position: Float[np.ndarray, "2"]) -> bool:
        """Whether both images show a hazard, and a position (x, y) is not far from hazards and border."""
        is_near = self.clearance_fraction(position) < MIN_CLEARANCE_FRACTION
        return bool(np.any(self.visible_hazards)) and is_near

    def distance_to_hazard_m(self, position: Float[np.ndarray, "2"]) -> float:
        """Compute the distance from a position (x, y) to the nearest unsafe grid position, in both images or not.

        Infinite if no position of the grid is unsafe.
        """
        unsafe = self.positions[~self.footprints.safe]
        return float(np.hypot(*(unsafe - position).T).min()) if len(unsafe) else float("inf")

    def classify_points(self, points: Float[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns"]:
        """Classify the footprint around each ground point (SAFE, UNSAFE, UNKNOWN) by the nearest grid position."""
        origin = self.positions[0, 0]
        axes = np.stack([self.positions[0, 1] - origin, self.positions[1, 0] - origin], axis=1)
        cells = np.linalg.solve(axes, (points[..., :2] - origin).reshape(-1, 2).T).T
        is_inside = np.asarray(np.isfinite(cells).all(axis=1))
        columns, rows = np.rint(np.where(is_inside[:, None], cells, -1.0)).astype(np.int64).T
        shape = self.covered.shape
        is_inside &= (rows >= 0) & (columns >= 0) & (rows < shape[0]) & (columns < shape[1])
        true_class = np.full(len(cells), UNKNOWN, dtype=np.uint8)
        indices = rows[is_inside], columns[is_inside]
        footprint_class = np.where(self.footprints.safe[indices], SAFE, UNSAFE)
        true_class[is_inside] = np.where(self.covered[indices], footprint_class, UNKNOWN)
        return true_class.reshape(points.shape[:2])

    def footprint_at(self, position: Float[np.ndarray, "2"]) -> Footprints | None:
        """Compute slope and roughness under a lander at any position (x, y); None outside the relief."""
        try:
            return self.relief.footprints(position[None], self.limits)
        except ValueError:
            return None
